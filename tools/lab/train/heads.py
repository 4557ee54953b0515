"""Extracts SubSplat's heads or the backbone from a weight file.

    python3 tools/lab/train/heads.py heads WHOLE.safetensors HEADS.safetensors
    python3 tools/lab/train/heads.py backbone WHOLE.safetensors BACKBONE.safetensors

Tensors are copied unchanged. The heads keep the metadata. The backbone does not, because its configuration
differs.
"""

import json
import struct
import sys

PREFIX = "subsplat."


def main(part, whole, result):
    with open(whole, "rb") as file:
        (length,) = struct.unpack("<Q", file.read(8))
        header, body = json.loads(file.read(length)), file.read()
    out, data, meta = {}, b"", header.pop("__metadata__", {})
    if part == "heads":
        out["__metadata__"] = meta
    for name, entry in sorted(header.items()):
        if name.startswith(PREFIX) == (part == "heads"):
            begin, end = entry["data_offsets"]
            out[name] = entry | {"data_offsets": [len(data), len(data) + end - begin]}
            data += body[begin:end]
    if not data:
        raise SystemExit(f"{whole}: expected the {part}, got no such tensors")
    text = json.dumps(out).encode()
    text += b" " * (-len(text) % 8)
    with open(result, "wb") as file:
        file.write(struct.pack("<Q", len(text)) + text + data)


if len(sys.argv) != 4 or sys.argv[1] not in ("heads", "backbone"):
    raise SystemExit(__doc__)
main(*sys.argv[1:])
