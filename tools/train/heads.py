"""Extracts SubSplat's heads or the backbone from a weight file, or makes heads for x2 serve any K.

    python3 tools/train/heads.py heads WHOLE.safetensors HEADS.safetensors
    python3 tools/train/heads.py backbone WHOLE.safetensors BACKBONE.safetensors
    python3 tools/train/heads.py polynomial WHOLE.safetensors RESULT.safetensors

Tensors are copied unchanged. The heads keep the metadata. The backbone does not, because its configuration
differs. `polynomial` turns heads of the form `mlp2` for x2 into the form `polynomial`, f32, which gives the
same children at x2. Of its terms, 1, x, y and xy come from the four children; the others are zero.
"""

import json
import struct
import sys

PREFIX = "subsplat."


# Numbers of a record that each head gives.
OUTPUTS = {"subsplat.geo.lin1": 9, "subsplat.app.lin1": 2}
TERMS = 18
# Terms by their place, and the sign of each for the children at x2, row by row of the pixel.
SIGNS = {0: (1, 1, 1, 1), 1: (-1, 1, -1, 1), 3: (-1, -1, 1, 1), 4: (1, -1, -1, 1)}


def read(path):
    with open(path, "rb") as file:
        (length,) = struct.unpack("<Q", file.read(8))
        return json.loads(file.read(length)), file.read()


def write(path, header, data):
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    with open(path, "wb") as file:
        file.write(struct.pack("<Q", len(text)) + text + data)


def polynomial(whole, result):
    header, body = read(whole)
    meta = header.pop("__metadata__", {})
    config = json.loads(meta["subsplat.config"])
    if (config["spgr"]["head"], config["upscale"]) != ("mlp2", 2):
        raise SystemExit(f"{whole}: expected heads `mlp2` for x2, got {config['spgr']['head']} for x{config['upscale']}")
    config["spgr"]["head"] = "polynomial"
    out, data = {"__metadata__": meta | {"subsplat.config": json.dumps(config)}}, b""
    for name, entry in sorted(header.items()):
        begin, end = entry["data_offsets"]
        code = {"F16": "e", "F32": "f"}[entry["dtype"]]
        count = (end - begin) // struct.calcsize(code)
        values, shape = list(struct.unpack(f"<{count}{code}", body[begin:end])), entry["shape"]
        outputs = OUTPUTS.get(name.rsplit(".", 1)[0])
        if outputs:
            # Rows: child by child; then term by term.
            size = outputs * (count // shape[0])
            children = [values[i * size : (i + 1) * size] for i in range(4)]
            values = [0.0] * (TERMS * size)
            for term, signs in SIGNS.items():
                mean = [sum(s * v for s, v in zip(signs, column)) / 4 for column in zip(*children)]
                values[term * size : (term + 1) * size] = mean
            shape = [TERMS * outputs] + shape[1:]
        packed = struct.pack(f"<{len(values)}f", *values)
        out[name] = {"dtype": "F32", "shape": shape, "data_offsets": [len(data), len(data) + len(packed)]}
        data += packed
    write(result, out, data)


def main(part, whole, result):
    if part == "polynomial":
        return polynomial(whole, result)
    header, body = read(whole)
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
    write(result, out, data)


if len(sys.argv) != 4 or sys.argv[1] not in ("heads", "backbone", "polynomial"):
    raise SystemExit(__doc__)
main(*sys.argv[1:])
