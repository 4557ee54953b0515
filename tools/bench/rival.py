"""Times onnxruntime for `cargo bench --bench network -- --onnxruntime` (benches/network.rs calls this
script).

    python tools/bench/rival.py network SIDE FOLDER RUNS THREADS
    python tools/bench/rival.py ops FOLDER RUNS THREADS

`network`: MVSplat's backbone of the released size for two SIDE x SIDE pictures, in f32. The graph comes from
the witness's modules, with the operators of an exporter (LayerNormalization, InstanceNormalization) and
constant weights, so that onnxruntime may fold and pack them. Writes FOLDER/SIDE.safetensors: inputs, weights
(w.NAME), outputs (out.NAME).

`ops`: single operators on the inputs in FOLDER/ops.safetensors (NAME.INPUT). Writes their results to
FOLDER/ops_out.safetensors.

Prints one line of JSON: by name, the times of RUNS runs in seconds (of 50 where they are short) after two
warm-up runs, and the process's peak memory in bytes. CPU provider, all optimisations."""

import json
import pathlib
import resource
import sys
import time

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "witness"))

import numpy as np
import onnx
import onnxruntime
from onnx import helper, numpy_helper
from safetensors.numpy import load_file, save_file

from golden import Case
from graph import G
from modules.cnn import cnn
from modules.depth import predict
from modules.sweep import geometry
from modules.transformer import transformer
import formula

RELEASED = {"depth_candidates": 128, "costvolume_channels": 128, "costvolume_levels": 3, "refine_channels": 32,
            "refine_levels": 5}


class Exported(G):
    """Graph builder with normalisations as single operators."""

    def instance_norm(self, x, eps=1e-5):
        c = x.shape[1]
        return self.op("InstanceNormalization", [x, np.ones(c), np.zeros(c)], x.shape, epsilon=eps)

    def group_norm(self, x, name, groups, eps=1e-5):
        n, c = x.shape[:2]
        y = self.op("InstanceNormalization", [x.reshape(n, groups, -1), np.ones(groups), np.zeros(groups)],
                    (n, groups, int(np.prod(x.shape[1:])) // groups), epsilon=eps).reshape(x.shape)
        row = lambda part: self.weight(f"{name}.{part}", (c,)).reshape((1, c) + (1,) * (len(x.shape) - 2))
        return y * row("weight") + row("bias")

    def layer_norm(self, x, name, eps=1e-5):
        sides = [self.weight(f"{name}.{part}", (x.shape[-1],)) for part in ("weight", "bias")]
        return self.op("LayerNormalization", [x, *sides], x.shape, epsilon=eps)


def session(model, threads):
    """Creates an optimised session."""
    options = onnxruntime.SessionOptions()
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_ALL
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    return onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])


# A run shorter than QUICK seconds is repeated MANY times.
QUICK, MANY = 0.02, 50


def time_runs(run, runs):
    """Returns the result of a run and the seconds of `runs` further runs."""
    result = run()
    start = time.perf_counter()
    run()
    if time.perf_counter() - start < QUICK:
        runs = max(runs, MANY)
    seconds = []
    for _ in range(runs):
        start = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - start)
    return result, seconds


def network(side, folder, runs, threads):
    """Times the backbone and writes its tensors."""
    case = Case(f"bench{side}", 0)
    g = case.g = Exported(case.name)
    geo = geometry(case, 2, side, side, near=1.2, far=60.0)
    images = case.random_input("images", (2, 3, side, side), 0.0, 1.0)
    half, quarter = cnn(g, images, (64, 96, 128))
    out = predict(g, images, quarter, transformer(g, quarter, 6), geo, RELEASED)
    names = ("raw", "disparity", "densities")
    for name in names:
        g.output(name, out[name])
    weights = {n: formula.weight(0, n, v.shape) for n, v in g.weights.items()}
    feeds = dict(case.stored) | {n: formula.uniform_input(0, n, s, low, high) for n, s, low, high in case.specs}
    feeds = {n: a for n, a in feeds.items() if n in g.inputs}
    model = g.model()
    keep = [i for i in model.graph.input if i.name not in weights]
    del model.graph.input[:]
    model.graph.input.extend(keep)
    model.graph.initializer.extend(numpy_helper.from_array(a, n) for n, a in weights.items())
    run = session(model, threads)
    used = {i.name for i in run.get_inputs()}
    feeds = {n: a for n, a in feeds.items() if n in used}
    result, seconds = time_runs(lambda: run.run(list(names), feeds), runs)
    tensors = {f"w.{n}": a for n, a in weights.items()} | {f"out.{n}": a for n, a in zip(names, result)}
    tensors |= {"images": feeds["images"]} | case.auxiliaries
    save_file({n: np.ascontiguousarray(a) for n, a in tensors.items()}, folder / f"{side}.safetensors")
    return {f"backbone{side}": seconds}


def operators(inputs):
    """Returns {name: (graph, feeds)}; the first word of a name is the operator."""
    cases = {}
    for key, array in inputs.items():
        name, which = key.rsplit(".", 1)
        cases.setdefault(name, {})[which] = array
    made = {}
    for name, feeds in cases.items():
        g = Exported(name)
        v = {n: g.input(n, a.shape) for n, a in feeds.items()}
        kind = name.split()[0]
        x = v["x"] if "x" in v else None
        channels = lambda n: v[n].reshape((1, -1) + (1,) * (len(x.shape) - 2))
        if kind in ("gelu", "silu", "relu", "softmax"):
            y = getattr(g, kind)(x)
        elif kind == "instance_norm_relu":
            y = g.relu(g.instance_norm(x))
        elif kind == "group_norm_silu":
            n, c = x.shape[:2]
            y = g.op("InstanceNormalization", [x.reshape(n, 8, -1), np.ones(8), np.zeros(8)],
                     (n, 8, int(np.prod(x.shape[1:])) // 8), epsilon=1e-5).reshape(x.shape)
            y = g.silu(y * channels("w") + channels("b"))
        elif kind == "layer_norm":
            y = g.op("LayerNormalization", [x, v["w"], v["b"]], x.shape, epsilon=1e-5)
        elif kind == "linear":
            y = x @ v["w"].transpose(1, 0)
        elif kind == "attention":
            y = g.softmax(v["q"] @ v["k"].transpose(0, 2, 1) * (1 / np.sqrt(v["q"].shape[-1]))) @ v["v"]
        elif kind == "bilinear":
            y = g.resize_bilinear(x, 4 * x.shape[2], 4 * x.shape[3])
        elif kind == "bilinear_gelu":
            y = g.gelu(g.resize_bilinear(x, 4 * x.shape[2], 4 * x.shape[3]))
        elif kind == "nearest":
            n, c, h, w = x.shape
            y = g.op("Resize", [x, None, None, g.const((n, c, 2 * h, 2 * w), np.int64)], (n, c, 2 * h, 2 * w),
                     mode="nearest", coordinate_transformation_mode="asymmetric", nearest_mode="floor")
        elif kind == "add":
            y = x + v["y"]
        elif kind == "cat":
            y = g.concat([x, v["y"]], 1)
        else:
            raise SystemExit(f"ops: unknown operator {kind}")
        g.output("out", y)
        made[name] = (g.model(), feeds)
    return made


def ops(folder, runs, threads):
    """Times the operators and writes their results."""
    results, seconds = {}, {}
    for name, (model, feeds) in operators(load_file(folder / "ops.safetensors")).items():
        run = session(model, threads)
        result, seconds[name] = time_runs(lambda: run.run(["out"], feeds), runs)
        results[name] = result[0]
    save_file({n: np.ascontiguousarray(a) for n, a in results.items()}, folder / "ops_out.safetensors")
    return seconds


def main(arguments):
    if arguments[:1] == ["network"] and len(arguments) == 5:
        seconds = network(int(arguments[1]), pathlib.Path(arguments[2]), int(arguments[3]), int(arguments[4]))
    elif arguments[:1] == ["ops"] and len(arguments) == 4:
        seconds = ops(pathlib.Path(arguments[1]), int(arguments[2]), int(arguments[3]))
    else:
        raise SystemExit(__doc__)
    peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(json.dumps({"seconds": seconds, "peak_bytes": peak, "onnxruntime": onnxruntime.__version__}))


main(sys.argv[1:])
