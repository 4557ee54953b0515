"""Writes the graphs and goldens of all cases, or of the named ones.

    python tools/witness/make.py [NAMES...]
"""

import sys

from golden import FOLDER, Case
from modules import CASES


def main(names):
    FOLDER.mkdir(parents=True, exist_ok=True)
    unknown = [n for n in names if n not in CASES]
    if unknown:
        raise SystemExit(f"unknown cases: {unknown}; expected some of {list(CASES)}")
    for name in names or CASES:
        case = Case(name)
        CASES[name](case)
        graph = case.g.bytes()
        results = case.run(graph)
        (FOLDER / f"{name}.onnx").write_bytes(graph)
        case.write(FOLDER, results, graph)
        for output, a in results.items():
            print(f"{name}.{output} {a.shape} rms {float((a.astype('f8') ** 2).mean() ** 0.5):.4g} max {abs(a).max():.4g}")


main(sys.argv[1:])
