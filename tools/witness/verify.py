"""Verifies that the committed goldens equal onnxruntime's outputs of the committed graphs, and that the
graphs equal the definitions in modules/.

    python tools/witness/verify.py [NAMES...]
    python tools/witness/verify.py --fresh DIR    random inputs, weights and cameras for
                                                  the cases of FRESH; writes DIR/NAME.*

Differences are reported, and the exit status is 1. On one machine all values are equal to the bit. Processors
with other vector units sum in another order, so that elements may differ by TOLERANCE (LOOSER for some cases)
of the output's largest magnitude.
"""

import hashlib
import os
import pathlib
import sys

import numpy as np

from golden import FOLDER, Case, read, run, strided
import formula
from modules import CASES

TOLERANCE = 1e-5
# Five times the difference of onnxruntime with and without its graph rewriting: 1/disparity at
# large distances (2e-5), and the occlusion gate's differences of depth (1.5e-4).
LOOSER = {"depth": 1e-4, "backbone": 1e-4, "whole_paper": 1e-4, "whole_tuned": 8e-4}
FRESH = ("whole_paper", "whole_tuned")


def check(name):
    """Returns the differences of one case, one line each."""
    path, bad = FOLDER / f"{name}.safetensors", []
    if not path.exists() or not (FOLDER / f"{name}.onnx").exists():
        return [f"{name}: golden or graph is missing; run make.py"]
    graph = (FOLDER / f"{name}.onnx").read_bytes()
    metadata, tensors = read(path)
    if hashlib.sha256(graph).hexdigest() != metadata["graph_sha256"]:
        bad.append(f"{name}.onnx: its hash differs from the one in the golden")
    case = Case(name, metadata["seed"])
    CASES[name](case)
    if case.g.bytes() != graph:
        bad.append(f"{name}.onnx: modules/ builds another graph; run make.py")
    for n, shape in metadata["weights"]:
        if n not in case.g.weights or list(case.g.weights[n].shape) != shape:
            bad.append(f"{name}: weight {n} {shape} is not in the graph")
    if metadata.get("notes", {}) != case.notes:
        bad.append(f"{name}: notes: expected {case.notes}, got {metadata.get('notes')}")
    # The inputs that the golden records, not those of the current definition.
    feeds = {k[3:]: v for k, v in tensors.items() if k.startswith("in.")}
    feeds |= {n: formula.uniform_input(metadata["seed"], n, s, low, high) for n, s, low, high in metadata["drawn"]}
    feeds |= {n: formula.weight(metadata["seed"], n, s) for n, s in metadata["weights"]}
    for prefix, made in (("in.", case.stored), ("aside.", case.auxiliaries)):
        have = {k for k in tensors if k.startswith(prefix)}
        if have != {prefix + n for n in made}:
            bad.append(f"{name}: tensors {prefix}*: expected {sorted(made)}, got {sorted(have)}")
        for n in made:
            bad += differences(f"{name}: {prefix}{n}", tensors.get(prefix + n), made[n], TOLERANCE)
    results = run(graph, feeds)
    if set(results) != set(metadata["outputs"]):
        bad.append(f"{name}: outputs: expected {sorted(results)}, got {sorted(metadata['outputs'])}")
    for n, a in results.items():
        held = metadata["outputs"].get(n, {"stride": 1})
        if held.get("shape") != list(a.shape) or held["stride"] != case.strides[n]:
            bad.append(f"{name}: output {n}: shape or stride differs from the definition")
        tolerance = LOOSER.get(name, TOLERANCE)
        bad += differences(f"{name}: out.{n}", tensors.get(f"out.{n}"), strided(a, held["stride"]), tolerance)
    return bad


def differences(name, have, want, tolerance):
    """Returns a message if the arrays differ in shape, type or value."""
    if have is None or have.shape != want.shape or have.dtype != want.dtype:
        return [f"{name}: expected {want.dtype} {want.shape}, got {'nothing' if have is None else (have.dtype, have.shape)}"]
    have, want = have.astype(np.float64), want.astype(np.float64)
    far, size = np.abs(have - want), np.abs(want).max(initial=0.0)
    if want.size and not far.max() <= tolerance * size:
        at = int(far.argmax())
        return [f"{name}: element {at} is {have.flat[at]:.9g}, expected {want.flat[at]:.9g}; largest is {size:.3g}"]
    return []


def write_random_cases(folder):
    """Writes the cases of FRESH for a random seed."""
    folder.mkdir(parents=True, exist_ok=True)
    seed = int.from_bytes(os.urandom(6), "big")
    print(f"fresh: seed {seed}")
    for name in FRESH:
        case = Case(name, seed)
        CASES[name](case)
        graph = (FOLDER / f"{name}.onnx").read_bytes()
        if case.g.bytes() != graph:
            raise SystemExit(f"{name}.onnx: modules/ builds another graph for seed {seed}")
        case.write(folder, case.run(graph), graph)
        print(f"fresh: wrote {name}")


def main(arguments):
    if arguments[:1] == ["--fresh"]:
        return write_random_cases(pathlib.Path(arguments[1]))
    bad = []
    for name in arguments or CASES:
        found = check(name)
        print(f"{name}: {'differs' if found else 'same'}")
        bad += found
    if not arguments:
        stray = {p.stem for p in FOLDER.iterdir() if p.suffix in (".onnx", ".safetensors")} - set(CASES)
        bad += [f"{n}: no definition exists" for n in sorted(stray)]
    if bad:
        raise SystemExit("\n".join(bad))


main(sys.argv[1:])
