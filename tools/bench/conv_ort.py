"""Runs single convolutions in onnxruntime, for benches/conv.rs.

Commands and answers are JSON lines on stdin and stdout:
  {"x": [path, dims], "w": …, "b": …, "y": …, "stride": s, "padding": p, "threads": n}
      builds the graph and returns {"error": largest difference from y over its largest value}
  {}  runs it for WARM_S and once more, and returns {"seconds": t} of the last run
Files hold little-endian f32. Needs the environment of tools/witness/setup.sh.
"""

import json
import sys
import time

import numpy as np
import onnxruntime as ort
from onnx import TensorProto, helper, numpy_helper

# Pause between runs, s: onnxruntime's threads spin for a while after each run.
PAUSE_S = 0.02
# Duration of the warm-up, s, as in benches/common.
WARM_S = 0.03


def tensor(entry):
    """Reads a tensor from its path and dimensions."""
    path, dims = entry
    return np.fromfile(path, dtype="<f4").reshape(dims)


def build(command):
    """Builds session, inputs and expected output of a command."""
    x, w, b = (tensor(command[name]) for name in "xwb")
    rank = w.ndim - 2
    node = helper.make_node(
        "Conv",
        ["x", "w", "b"],
        ["y"],
        kernel_shape=w.shape[2:],
        strides=[command["stride"]] * rank,
        pads=[command["padding"]] * (2 * rank),
    )
    graph = helper.make_graph(
        [node],
        "conv",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, x.shape)],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, None)],
        [numpy_helper.from_array(w, "w"), numpy_helper.from_array(b, "b")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 9
    options = ort.SessionOptions()
    options.intra_op_num_threads = command["threads"]
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_ALL
    session = ort.InferenceSession(
        model.SerializeToString(), options, providers=["CPUExecutionProvider"]
    )
    return session, {"x": x}, tensor(command["y"])


def main():
    session = feeds = None
    for line in sys.stdin:
        command = json.loads(line)
        if command:
            session, feeds, want = build(command)
            got = session.run(None, feeds)[0]
            answer = {"error": float(np.abs(got - want).max() / np.abs(want).max())}
        else:
            start = time.perf_counter()
            while time.perf_counter() - start < WARM_S:
                session.run(None, feeds)
            start = time.perf_counter()
            session.run(None, feeds)
            answer = {"seconds": time.perf_counter() - start}
            time.sleep(PAUSE_S)
        print(json.dumps(answer), flush=True)


main()
