"""The graph builder in double precision: the same calls, f32 inputs and weights, f64 intermediate values, f32
outputs."""

import numpy as np
from onnx import TensorProto

from graph import G, Value

# Operators of opset 18 that onnxruntime's CPU provider implements in f32 only.
F32_ONLY = ("AveragePool", "Conv", "ConvTranspose", "Erf", "GridSample", "Resize")


class Precise(G):
    """A graph whose values have the label "float32" and the type f64. Inputs of f32-only operators are
    cast."""

    def cast_to(self, x, kind):
        return self.op("Cast", [x], x.shape, to=kind)

    def input(self, name, shape):
        return self.cast_to(super().input(name, shape), TensorProto.DOUBLE)

    def weight(self, name, shape):
        return self.cast_to(super().weight(name, shape), TensorProto.DOUBLE)

    def const(self, array, dtype=np.float32):
        if np.dtype(dtype) != np.float32:
            return super().const(array, dtype)
        v = super().const(array, np.float64)
        return Value(self, v.name, v.shape)

    def output(self, name, value):
        super().output(name, self.cast_to(value, TensorProto.FLOAT))

    def op(self, kind, inputs, shape, dtype="float32", out=None, **attributes):
        if kind not in F32_ONLY:
            return super().op(kind, inputs, shape, dtype, out, **attributes)
        inputs = [i if i is None or i.dtype == "int64" else self.cast_to(i, TensorProto.FLOAT) for i in inputs]
        return self.cast_to(super().op(kind, inputs, shape, dtype, **attributes), TensorProto.DOUBLE)
