"""A case: one graph, its inputs, and the outputs of onnxruntime.

`tests/goldens/witness/NAME.onnx` is the graph. `NAME.safetensors` is the golden: tensors `in.X` (inputs
without a formula), `aside.X` (additional values for the Rust test, such as cameras), `out.X` (every stride-th
element of the flattened output X), and one metadata entry `witness`, JSON: maker, versions, seed, weights
[[name, shape]], drawn [[name, shape, low, high]], outputs {name: {shape, stride}}, notes, graph_sha256.
Weights and drawn inputs come from formula.py.
"""

import hashlib
import json
import pathlib

import numpy as np
import onnx
import onnxruntime
from safetensors import safe_open
from safetensors.numpy import save_file

import formula
from graph import G

ROOT = pathlib.Path(__file__).resolve().parents[2]
FOLDER = ROOT / "tests" / "goldens" / "witness"
VERSIONS = {"numpy": np.__version__, "onnx": onnx.__version__, "onnxruntime": onnxruntime.__version__}


class Case:
    """A case under construction. A module's case function `case(c)` declares inputs, builds on `c.g`, and
    names outputs. The graph must not depend on the seed; inputs and weights do."""

    def __init__(self, name, seed=0):
        self.name, self.seed, self.g = name, seed, G(name)
        self.specs, self.stored, self.auxiliaries, self.strides = [], {}, {}, {}
        # JSON for the Rust test: the configuration that the graph implements.
        self.notes = {}

    def random_input(self, name, shape, low=-1.0, high=1.0):
        """Declares a graph input that is uniform in (low, high) by formula."""
        self.specs.append([name, list(shape), float(low), float(high)])
        return self.g.input(name, shape)

    def stored_input(self, name, array):
        """Declares a graph input whose values are stored in the golden."""
        self.stored[name] = np.ascontiguousarray(array, dtype=np.float32)
        return self.g.input(name, self.stored[name].shape)

    def auxiliary(self, name, array):
        """Stores values in the golden for the Rust test only."""
        self.auxiliaries[name] = np.ascontiguousarray(array, dtype=np.float32)
        return self.auxiliaries[name]

    def cameras(self, views, height, width, near=1.2, far=20.0, step=(0.5, 0.0, 0.0)):
        """Computes poses by formula: `aside.poses` [V, 4, 4] world_from_camera, `aside.intrinsics` [V, 4] fx
        fy cx cy in px, `aside.near_far` [V, 2] (within a sixth of `near`, a quarter of `far`). All three
        differ by view. The world is rotated by about half a radian against every camera, and the views by
        about a tenth against one another. Neighbouring cameras are `step` apart, with a tenth of noise.
        Returns the three arrays (f32)."""
        u = 2.0 * formula.uniform(self.seed, "cameras", 3 + 16 * views) - 1.0
        world, u = rotation_matrix(0.5 * np.sign(u[:3]) + 0.2 * u[:3]), u[3:].reshape(views, 16)
        poses, intrinsics, near_far = [], [], []
        for i in range(views):
            pose = np.eye(4)
            pose[:3, :3] = world @ rotation_matrix(0.1 * u[i, :3])
            pose[:3, 3] = world @ (i * np.array(step) + 0.1 * u[i, 3:6]) + 0.3
            poses.append(pose)
            fx, fy = width * (0.9 + 0.1 * u[i, 6]), width * (0.9 + 0.1 * u[i, 7])
            intrinsics.append([fx, fy, width * (0.5 + 0.04 * u[i, 8]), height * (0.5 + 0.04 * u[i, 9])])
            near_far.append([near * (1.0 + u[i, 10] / 6), far * (1.0 + 0.25 * u[i, 11])])
        return (self.auxiliary("poses", poses), self.auxiliary("intrinsics", intrinsics), self.auxiliary("near_far", near_far))

    def output(self, name, value, stride=1):
        """Declares an output, of which the golden holds every `stride`-th element."""
        self.g.output(name, value)
        self.strides[name] = stride

    # --- running --------------------------------------------------------------------

    def feeds(self):
        """Returns the values of all inputs and weights."""
        feeds = dict(self.stored)
        feeds |= {n: formula.uniform_input(self.seed, n, s, low, high) for n, s, low, high in self.specs}
        return feeds | {n: formula.weight(self.seed, n, v.shape) for n, v in self.g.weights.items()}

    def run(self, graph):
        """Runs the serialised graph in onnxruntime: {output: array}."""
        return run(graph, self.feeds())

    def write(self, folder, results, graph):
        """Writes the golden with the results of `run`."""
        tensors = {f"in.{n}": a for n, a in self.stored.items()}
        tensors |= {f"aside.{n}": a for n, a in self.auxiliaries.items()}
        for name, a in results.items():
            if not np.isfinite(a).all():
                raise SystemExit(f"{self.name}: output {name}: expected finite numbers")
            tensors[f"out.{name}"] = strided(a, self.strides[name])
        metadata = {
            "maker": f"tools/witness/make.py {self.name}",
            "versions": VERSIONS,
            "seed": self.seed,
            "weights": [[n, list(v.shape)] for n, v in self.g.weights.items()],
            "drawn": self.specs,
            "outputs": {n: {"shape": list(a.shape), "stride": self.strides[n]} for n, a in results.items()},
            "notes": self.notes,
            "graph_sha256": hashlib.sha256(graph).hexdigest(),
        }
        save_file(tensors, folder / f"{self.name}.safetensors", metadata={"witness": json.dumps(metadata)})


def rotation_matrix(v):
    """Returns the rotation matrix of the rotation vector v (radians), by Rodrigues' formula."""
    angle = np.linalg.norm(v)
    x, y, z = v / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k)


def strided(array, stride):
    """Returns every stride-th element of the flattened array."""
    return np.ascontiguousarray(array.reshape(-1)[::stride])


def run(graph, feeds):
    """Runs a graph without rewriting by onnxruntime, on one thread."""
    options = onnxruntime.SessionOptions()
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    names = [o.name for o in session.get_outputs()]
    return dict(zip(names, session.run(names, feeds)))


def read(path):
    """Returns (metadata, {name: array}) of a golden."""
    with safe_open(path, framework="numpy") as f:
        return json.loads(f.metadata()["witness"]), {k: f.get_tensor(k) for k in f.keys()}
