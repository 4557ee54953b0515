"""Writes tests/goldens/torch: small files of torch.save, and expected.json with what they hold.

Needs PyTorch (2.6.0 wrote the committed ones, NumPy 2.2.6 beside it):
    python tools/make_torch_fixtures.py tests/goldens/torch
expected.json: {file: {dotted path: [dtype, shape, requires_grad, hex of the contiguous elements]}}
and, where a value is no tensor, {path: value}.
"""

import collections
import json
import sys
from pathlib import Path

import numpy
import torch

OUT = Path(sys.argv[1])
DTYPES = ["float64", "float32", "float16", "bfloat16", "int64", "int32", "int16", "int8", "uint8", "bool"]
expected = {}


def bits(t):
    t = t.detach().contiguous()
    return t.view(torch.uint8).numpy().tobytes().hex() if t.dim() else t.reshape(1).view(torch.uint8).numpy().tobytes().hex()


def walk(value, path, found):
    if isinstance(value, torch.Tensor):
        found[path] = [str(value.dtype)[6:], list(value.shape), value.requires_grad, bits(value)]
    elif isinstance(value, dict):
        for k, v in value.items():
            walk(v, f"{path}.{k}" if path else str(k), found)
    elif isinstance(value, (list, tuple, collections.deque)):
        for i, v in enumerate(value):
            walk(v, f"{path}.{i}" if path else str(i), found)
    elif value is None or isinstance(value, (bool, int, float, str)):
        found[path] = value if not isinstance(value, int) or abs(value) < 2**62 else str(value)


def save(name, value, **how):
    torch.save(value, OUT / name, **how)
    found = {}
    walk(value, "", found)
    expected[name] = found


def ramp(dtype, n):
    values = torch.arange(n) * 3 - 7
    if dtype == "bool":
        return values % 2 == 0
    return (values if dtype != "uint8" else values + 7).to(getattr(torch, dtype)) * (1 if "int" in dtype else 0.37)


class Callback:
    def __init__(self):
        self.best = torch.ones(2)
        self.deque = collections.deque([1, 2], maxlen=4)


old = {"_use_new_zipfile_serialization": False}
torch.manual_seed(7)

dtypes = {d: ramp(d, 6).reshape(2, 3) for d in DTYPES}
save("dtypes.pt", dtypes)
save("dtypes_legacy.pt", dtypes, **old)

base = torch.randn(4, 6)
views = {
    "base": base,
    "shared": base,
    "transposed": base.t(),
    "sliced": base[1:3, ::2],
    "column": base[:, 3],
    "expanded": base[:, :1].expand(4, 5),
    "permuted": torch.arange(24).reshape(2, 3, 4).permute(2, 0, 1),
    "diagonal": base.diagonal(),
    "unfolded": torch.arange(8, dtype=torch.int16).unfold(0, 4, 2),
    "ones": base[2:3, 1:2],
    "scalar": torch.tensor(2.5),
    "empty": torch.zeros(0, 3),
    "none_of_some": base[4:],
}
save("views.pt", views)
save("views_legacy.pt", views, **old)

torch_module = torch.nn.Sequential(torch.nn.Conv2d(1, 2, 3), torch.nn.BatchNorm2d(2))
for protocol in (2, 3, 4, 5):
    mixed = {
        "state_dict": torch_module.state_dict(),
        "parameter": torch.nn.Parameter(torch.randn(3)),
        "default": collections.defaultdict(list, a=[1, 2]),
        "deque": collections.deque([torch.ones(1), 2.5]),
        "ordered": collections.OrderedDict(x=1, y="ü\n"),
        "tuple": (None, True, False, -1, 255, 65535, -(2**31), 2**40, -0.5),
        "set": {3},
        "frozen": frozenset(["f"]),
        "bytes": b"\x00\xff",
        "array": bytearray(b"ab"),
        "big": 2**80,
        "size": torch.Size([2, 3]),
        "device": torch.device("cpu"),
        "dtype": torch.float16,
        "numpy": numpy.float64(1.5),
        "callback": Callback(),
        "optimizer": {"state": {0: {"step": torch.tensor(3.0)}}, "param_groups": [{"lr": 1e-3, "params": [0]}]},
    }
    attributed = torch.nn.Parameter(torch.randn(2), requires_grad=False)
    attributed.note = "kept apart"
    mixed["attributed"] = attributed
    plain = torch.randn(2)
    plain.note = 5
    mixed["plain"] = plain
    save(f"protocol{protocol}.pt", mixed, pickle_protocol=protocol)
    if protocol in (2, 4):
        save(f"protocol{protocol}_legacy.pt", mixed, pickle_protocol=protocol, **old)

torch.serialization.set_crc32_options(False)
save("no_checksum.pt", {"model": torch_module.state_dict()})
torch.serialization.set_crc32_options(True)

# Tensors that are refused, each by what it is.
torch.save(
    {
        "complex": torch.zeros(2, dtype=torch.complex64),
        "quantized": torch.quantize_per_tensor(torch.zeros(2), 0.1, 0, torch.quint8),
        "sparse": torch.eye(2).to_sparse(),
        "uint16": torch.zeros(2, dtype=torch.uint16),
        "float8": torch.zeros(2, dtype=torch.float8_e4m3fn),
        "meta": torch.zeros(2, device="meta"),
        "negated": torch._neg_view(torch.ones(2)),
        "storage": torch.zeros(2).untyped_storage(),
        "good": torch.arange(3.0),
    },
    OUT / "refused.pt",
)

scripted = torch.jit.script(torch.nn.Linear(1, 1))
scripted.save(str(OUT / "torchscript.pt"))

(OUT / "expected.json").write_text(json.dumps(expected, indent=0, sort_keys=True) + "\n")
print(f"PyTorch {torch.__version__}, NumPy {numpy.__version__}: {len(expected) + 2} files")
