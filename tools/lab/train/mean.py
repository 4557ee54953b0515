"""Computes the weighted mean of weight files, as used for a shipped backbone.

    python3 tools/lab/train/mean.py OUT.safetensors FIRST.safetensors=0.3333 SECOND.safetensors=0.6667

Names, shapes and configuration are the first file's. A tensor that another file lacks is taken from the first
file. Needs numpy (`tools/witness/setup.sh` makes an environment with it).
"""

import json
import struct
import sys

import numpy as np

DTYPES = {"F32": np.float32, "F16": np.float16}


def load(path):
    with open(path, "rb") as file:
        data = file.read()
    (length,) = struct.unpack("<Q", data[:8])
    header, body = json.loads(data[8 : 8 + length]), data[8 + length :]
    meta = header.pop("__metadata__", {})
    tensors = {}
    for name, entry in header.items():
        begin, end = entry["data_offsets"]
        values = np.frombuffer(body[begin:end], DTYPES[entry["dtype"]])
        tensors[name] = values.reshape(entry["shape"]).astype(np.float32)
    return tensors, meta


def save(path, tensors, meta):
    header, parts, at = {"__metadata__": meta}, [], 0
    for name in sorted(tensors):
        data = np.ascontiguousarray(tensors[name], np.float32)
        header[name] = {
            "dtype": "F32",
            "shape": list(data.shape),
            "data_offsets": [at, at + data.nbytes],
        }
        at += data.nbytes
        parts.append(data.tobytes())
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    with open(path, "wb") as file:
        file.write(struct.pack("<Q", len(text)) + text + b"".join(parts))


def main(out, *terms):
    shares = [(path, float(share)) for path, share in (term.rsplit("=", 1) for term in terms)]
    if not shares or abs(sum(share for _, share in shares) - 1.0) > 1e-3:
        sys.exit(f"expected FILE=SHARE with shares that add up to 1, got {' '.join(terms)}")
    first, meta = load(shares[0][0])
    total = {name: np.zeros_like(values) for name, values in first.items()}
    for path, share in shares:
        tensors, _ = load(path)
        for name in total:
            values = tensors.get(name, first[name])
            if values.shape != total[name].shape:
                sys.exit(f"{path}: {name}: expected {total[name].shape}, got {values.shape}")
            total[name] += np.float32(share) * values
    save(out, total, meta)


if __name__ == "__main__":
    main(*sys.argv[1:])
