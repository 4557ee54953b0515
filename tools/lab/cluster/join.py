#!/usr/bin/env python3
"""Joins the parts of an evaluation (`subsplat-lab eval --shard I/N -o OUT/partI`) to OUT/targets.csv.

    join.py OUT N

Prints the mean PSNR and SSIM of each method: over a case's targets first, then over cases. It exits with 1
and names the parts that are absent, unreadable or of another protocol; with nothing written then. A line
of a target that stands in two parts is an error. Needs Python alone.
"""

import csv
import json
import sys
from collections import defaultdict
from pathlib import Path

KEY = ("scene", "context", "target", "method")


def protocol(part: Path) -> dict:
    """What the scores of a part depend on, without its number."""
    found = json.loads((part / "eval.json").read_text())["protocol"]
    return {key: value for key, value in found.items() if key != "shard"}


def main(out: Path, count: int) -> int:
    parts = [out / f"part{i}" for i in range(count)]
    absent = [i for i, part in enumerate(parts) if not (part / "targets.csv").is_file()]
    if absent:
        numbers = ",".join(map(str, absent))
        print(f"error: no targets.csv of parts {numbers} of {count}: start them again", file=sys.stderr)
        return 1
    rows, bodies, head, first, origin = [], [], None, None, {}
    for i, part in enumerate(parts):
        own = protocol(part)
        first = first or own
        if own != first:
            other = sorted(key for key in own if own[key] != first.get(key))
            print(f"error: part {i} differs from part 0 in {', '.join(other)}", file=sys.stderr)
            return 1
        with open(part / "targets.csv", newline="", encoding="utf-8") as file:
            own_head = file.readline()
            body = file.read()
        head = head or own_head
        if own_head != head:
            print(f"error: part {i}: expected the columns {head!r}, found {own_head!r}", file=sys.stderr)
            return 1
        bodies.append(body)
        for row in csv.DictReader((head + body).splitlines()):
            key = tuple(row[name] for name in KEY)
            if key in origin:
                print(f"error: {' '.join(key)} stands in parts {origin[key]} and {i}", file=sys.stderr)
                return 1
            origin[key] = i
            rows.append(row)
    whole = out / "targets.csv"
    with open(f"{whole}.part", "w", newline="", encoding="utf-8") as file:
        file.writelines([head, *bodies])
    Path(f"{whole}.part").replace(whole)
    cases = defaultdict(list)
    for row in rows:
        cases[row["method"], row["scene"], row["context"]].append([float(row["psnr"]), float(row["ssim"])])
    methods = defaultdict(list)
    for (method, _, _), scores in cases.items():
        methods[method].append([sum(column) / len(scores) for column in zip(*scores)])
    print(f"{len(rows)} lines of {count} parts in {whole}")
    for method, scores in methods.items():
        psnr, ssim = (sum(column) / len(scores) for column in zip(*scores))
        print(f"{method}: {psnr:.2f} dB, {ssim:.4f}, {len(scores)} cases")
    return 0


if __name__ == "__main__":
    if len(sys.argv) != 3 or not sys.argv[2].isdecimal() or int(sys.argv[2]) < 1:
        sys.exit(__doc__)
    sys.exit(main(Path(sys.argv[1]), int(sys.argv[2])))
