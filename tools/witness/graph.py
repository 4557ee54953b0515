"""A small builder of ONNX graphs (opset 18), for reference networks.

    g = G("name")
    x = g.input("x", (2, 3, 8, 8))
    y = g.gelu(g.conv(x, "net.0", 16, kernel=3, pad=1))
    g.output("y", y[:, :4] * 2.0)
    g.save(path)

Every value has a static shape. The caller states the shape of a node that plain arithmetic does not give
(`g.op`). Weights are graph inputs, with the names and layout of PyTorch's state_dict ([out, in, ...]), so
that a graph holds no large data. Equal calls give equal bytes. Float tensors are f32; indices are int64.
"""

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

OPSET = 18
# Supported by onnxruntime 1.31. A fixed version gives the same bytes with other onnx releases.
IR_VERSION = 10
KINDS = {"float32": TensorProto.FLOAT, "int64": TensorProto.INT64, "bool": TensorProto.BOOL}


class Value:
    """A tensor of the graph: name, static shape, dtype ("float32", "int64", "bool")."""

    def __init__(self, g, name, shape, dtype="float32"):
        self.g, self.name, self.dtype = g, name, dtype
        self.shape = tuple(int(n) for n in shape)

    def __add__(self, o): return self.g.binary("Add", self, o)
    def __radd__(self, o): return self.g.binary("Add", o, self)
    def __sub__(self, o): return self.g.binary("Sub", self, o)
    def __rsub__(self, o): return self.g.binary("Sub", o, self)
    def __mul__(self, o): return self.g.binary("Mul", self, o)
    def __rmul__(self, o): return self.g.binary("Mul", o, self)
    def __truediv__(self, o): return self.g.binary("Div", self, o)
    def __rtruediv__(self, o): return self.g.binary("Div", o, self)
    def __pow__(self, o): return self.g.binary("Pow", self, o)
    def __matmul__(self, o): return self.g.matmul(self, o)
    def __neg__(self): return self.g.unary("Neg", self)
    def __gt__(self, o): return self.g.compare("Greater", self, o)
    def __lt__(self, o): return self.g.compare("Less", self, o)
    def __ge__(self, o): return self.g.compare("GreaterOrEqual", self, o)
    def __le__(self, o): return self.g.compare("LessOrEqual", self, o)

    def __and__(self, o): return self.g.op("And", [self, o], np.broadcast_shapes(self.shape, o.shape), "bool")

    def __getitem__(self, key): return self.g.slice(self, key)
    def reshape(self, *shape): return self.g.reshape(self, shape[0] if isinstance(shape[0], tuple) else shape)
    def transpose(self, *perm): return self.g.transpose(self, perm)
    def sum(self, axes, keep=False): return self.g.reduce("ReduceSum", self, axes, keep)
    def mean(self, axes, keep=False): return self.g.reduce("ReduceMean", self, axes, keep)
    def max(self, axes, keep=False): return self.g.reduce("ReduceMax", self, axes, keep)
    def min(self, axes, keep=False): return self.g.reduce("ReduceMin", self, axes, keep)


class G:
    """A graph under construction."""
    def __init__(self, name):
        self.name = name
        self.nodes, self.constants, self.outputs = [], {}, {}
        self.inputs, self.weights = {}, {}

    # --- ends -----------------------------------------------------------------------

    def input(self, name, shape):
        assert name not in self.inputs and name not in self.weights, name
        self.inputs[name] = Value(self, name, shape)
        return self.inputs[name]

    def weight(self, name, shape):
        """Returns the parameter of a name; repeated calls return the same value."""
        shape = tuple(shape)
        have = self.weights.setdefault(name, Value(self, name, shape))
        assert have.shape == shape and name not in self.inputs, (name, have.shape, shape)
        return have

    def const(self, array, dtype=np.float32):
        a = np.ascontiguousarray(np.asarray(array, dtype=dtype))
        if a.shape == () and np.ndim(array) == 0:
            a = a.reshape(())
        key = (str(a.dtype), a.shape, a.tobytes())
        if key not in self.constants:
            self.constants[key] = (f"c{len(self.constants)}", a)
        return Value(self, self.constants[key][0], a.shape, str(a.dtype))

    def output(self, name, value):
        assert name not in {**self.outputs, **self.inputs, **self.weights}, name
        self.outputs[name] = self.op("Identity", [value], value.shape, value.dtype, out=name)

    # --- nodes ----------------------------------------------------------------------

    def value(self, x):
        return x if isinstance(x, Value) else self.const(x)

    def op(self, kind, inputs, shape, dtype="float32", out=None, **attributes):
        """Adds any ONNX operator with one output. The caller states `shape`, which `bytes` verifies."""
        out = out or f"v{len(self.nodes)}"
        names = ["" if i is None else self.value(i).name for i in inputs]
        self.nodes.append(helper.make_node(kind, names, [out], **attributes))
        return Value(self, out, shape, dtype)

    def unary(self, kind, x, **attributes):
        return self.op(kind, [x], x.shape, x.dtype, **attributes)

    def binary(self, kind, a, b):
        a, b = (self.const(v, np.int64) if not isinstance(v, Value) and isinstance(o, Value) and o.dtype == "int64"
                else self.value(v) for v, o in ((a, b), (b, a)))
        assert a.dtype == b.dtype, (kind, a.dtype, b.dtype)
        return self.op(kind, [a, b], np.broadcast_shapes(a.shape, b.shape), a.dtype)

    def compare(self, kind, a, b):
        a, b = self.value(a), self.value(b)
        return self.op(kind, [a, b], np.broadcast_shapes(a.shape, b.shape), "bool")

    def exp(self, x): return self.unary("Exp", x)
    def log(self, x): return self.unary("Log", x)
    def sqrt(self, x): return self.unary("Sqrt", x)
    def abs(self, x): return self.unary("Abs", x)
    def tanh(self, x): return self.unary("Tanh", x)
    def floor(self, x): return self.unary("Floor", x)
    def sigmoid(self, x): return self.unary("Sigmoid", x)
    def softplus(self, x): return self.unary("Softplus", x)
    def relu(self, x): return self.unary("Relu", x)
    def silu(self, x): return x * self.sigmoid(x)

    def gelu(self, x):
        """Exact form: x/2 * (1 + erf(x/sqrt 2))."""
        return x * 0.5 * (1.0 + self.unary("Erf", x * np.float32(np.sqrt(0.5))))

    def softmax(self, x, axis=-1): return self.unary("Softmax", x, axis=axis)
    def maximum(self, a, b): return self.binary("Max", a, b)
    def minimum(self, a, b): return self.binary("Min", a, b)
    def clamp(self, x, low, high): return self.minimum(self.maximum(x, low), high)

    def where(self, condition, a, b):
        a, b = self.value(a), self.value(b)
        shape = np.broadcast_shapes(condition.shape, a.shape, b.shape)
        return self.op("Where", [condition, a, b], shape, a.dtype)

    def cast(self, x, dtype):
        """Casts to "float32", "int64" or "bool"."""
        return self.op("Cast", [x], x.shape, dtype, to=KINDS[dtype])

    def reduce(self, kind, x, axes, keep=False):
        axes = sorted(a % len(x.shape) for a in ([axes] if isinstance(axes, int) else axes))
        shape = [1 if i in axes else n for i, n in enumerate(x.shape) if keep or i not in axes]
        return self.op(kind, [x, self.const(axes, np.int64)], shape, x.dtype, keepdims=int(keep))

    def reshape(self, x, shape):
        shape, size = list(shape), int(np.prod(x.shape))
        if -1 in shape:
            at = shape.index(-1)
            shape[at] = size // int(-np.prod(shape))
        assert np.prod(shape) == size, (x.shape, shape)
        return self.op("Reshape", [x, self.const(shape, np.int64)], shape, x.dtype)

    def transpose(self, x, perm):
        return self.op("Transpose", [x], [x.shape[p] for p in perm], x.dtype, perm=list(perm))

    def broadcast(self, x, shape):
        return self.op("Expand", [x, self.const(shape, np.int64)], shape, x.dtype)

    def concat(self, values, axis):
        values = [self.value(v) for v in values]
        axis %= len(values[0].shape)
        shape = list(values[0].shape)
        shape[axis] = sum(v.shape[axis] for v in values)
        for v in values:
            assert len(v.shape) == len(shape) and all(a == b for i, (a, b) in enumerate(zip(v.shape, shape)) if i != axis)
        return self.op("Concat", values, shape, values[0].dtype, axis=axis)

    def stack(self, values, axis):
        values = [self.value(v) for v in values]
        axis %= len(values[0].shape) + 1
        return self.concat([v.reshape(v.shape[:axis] + (1,) + v.shape[axis:]) for v in values], axis)

    def slice(self, x, key):
        """Applies numpy's basic slicing: integers, slices, `...`, None."""
        key = key if isinstance(key, tuple) else (key,)
        real = sum(k is not None and k is not Ellipsis for k in key)
        if Ellipsis not in key:
            key += (Ellipsis,)
        at = key.index(Ellipsis)
        key = key[:at] + (slice(None),) * (len(x.shape) - real) + key[at + 1:]
        starts, ends, axes, steps, mid, final, axis = [], [], [], [], [], [], 0
        for k in key:
            if k is None:
                final.append(1)
                continue
            n = x.shape[axis]
            if isinstance(k, int):
                assert -n <= k < n, (k, n)
                start, stop, step, count = k % n, k % n + 1, 1, 1
            else:
                start, stop, step = k.indices(n)
                assert step > 0, key
                count = len(range(start, stop, step))
                final.append(count)
            if (start, stop, step) != (0, n, 1):
                starts.append(start), ends.append(stop), axes.append(axis), steps.append(step)
            mid.append(count)
            axis += 1
        if axes:
            c = lambda v: self.const(v, np.int64)
            x = self.op("Slice", [x, c(starts), c(ends), c(axes), c(steps)], mid, x.dtype)
        return x if x.shape == tuple(final) else x.reshape(tuple(final))

    def gather(self, x, index, axis=0):
        """Applies numpy.take: `index` is int64, a value or an array."""
        index = index if isinstance(index, Value) else self.const(index, np.int64)
        axis %= len(x.shape)
        shape = x.shape[:axis] + index.shape + x.shape[axis + 1:]
        return self.op("Gather", [x, index], shape, x.dtype, axis=axis)

    def gather_elements(self, x, index, axis):
        """Applies torch.gather."""
        return self.op("GatherElements", [x, index], index.shape, x.dtype, axis=axis)

    def matmul(self, a, b):
        a, b = self.value(a), self.value(b)
        assert a.shape[-1] == b.shape[-2], (a.shape, b.shape)
        batch = np.broadcast_shapes(a.shape[:-2], b.shape[:-2])
        return self.op("MatMul", [a, b], batch + (a.shape[-2], b.shape[-1]))

    def roll(self, x, shift, axis):
        """Applies torch.roll: element i moves to (i + shift) mod n."""
        n = x.shape[axis]
        k = -shift % n
        if k == 0:
            return x
        cut = lambda a, b: x[(slice(None),) * axis + (slice(a, b),)]
        return self.concat([cut(k, n), cut(0, k)], axis)

    # --- layers ---------------------------------------------------------------------

    def linear(self, x, name, c_out, bias=True):
        """Returns x @ W^T + b over the last axis; W = NAME.weight [out, in]."""
        w = self.weight(f"{name}.weight", (c_out, x.shape[-1]))
        y = x @ w.transpose(1, 0)
        return y + self.weight(f"{name}.bias", (c_out,)) if bias else y

    def conv(self, x, name, c_out, kernel=3, stride=1, pad=None, bias=True):
        """Zero-padded NCHW convolution; the default of pad is kernel // 2."""
        pad = kernel // 2 if pad is None else pad
        n, c, h, w = x.shape
        weights = [self.weight(f"{name}.weight", (c_out, c, kernel, kernel))]
        if bias:
            weights.append(self.weight(f"{name}.bias", (c_out,)))
        size = [(s + 2 * pad - kernel) // stride + 1 for s in (h, w)]
        return self.op("Conv", [x] + weights, (n, c_out, *size), kernel_shape=[kernel] * 2,
                       strides=[stride] * 2, pads=[pad] * 4)

    def normalised(self, x, axes, eps=1e-5):
        """Returns (x - mean) / sqrt(var + eps) over `axes`, with biased variance, in two passes."""
        centred = x - x.mean(axes, keep=True)
        return centred / self.sqrt((centred * centred).mean(axes, keep=True) + eps)

    def instance_norm(self, x, eps=1e-5):
        return self.normalised(x, (2, 3), eps)

    def group_norm(self, x, name, groups, eps=1e-5):
        """[N, C, ...]; weight and bias [C]."""
        n, c = x.shape[:2]
        y = self.normalised(x.reshape(n, groups, -1), 2, eps).reshape(x.shape)
        row = lambda part: self.weight(f"{name}.{part}", (c,)).reshape((1, c) + (1,) * (len(x.shape) - 2))
        return y * row("weight") + row("bias")

    def layer_norm(self, x, name, eps=1e-5):
        c = x.shape[-1]
        y = self.normalised(x, -1, eps)
        return y * self.weight(f"{name}.weight", (c,)) + self.weight(f"{name}.bias", (c,))

    def resize_bilinear(self, x, height, width, align_corners=True):
        n, c = x.shape[:2]
        mode = "align_corners" if align_corners else "half_pixel"
        return self.op("Resize", [x, None, None, self.const((n, c, height, width), np.int64)], (n, c, height, width),
                       mode="linear", coordinate_transformation_mode=mode)

    def upsample_nearest(self, x, factor):
        n, c, h, w = x.shape
        x = self.broadcast(x.reshape(n, c, h, 1, w, 1), (n, c, h, factor, w, factor))
        return x.reshape(n, c, h * factor, w * factor)

    def mean_pool(self, x, factor):
        n, c, h, w = x.shape
        return self.op("AveragePool", [x], (n, c, h // factor, w // factor), kernel_shape=[factor] * 2,
                       strides=[factor] * 2)

    def grid_sample(self, x, grid, align_corners):
        """x [N, C, H, W], grid [N, h, w, 2] of (x, y) in [-1, 1]; zero padding."""
        n, c = x.shape[:2]
        return self.op("GridSample", [x, grid], (n, c, *grid.shape[1:3]), mode="bilinear", padding_mode="zeros",
                       align_corners=int(align_corners))

    # --- files ----------------------------------------------------------------------

    def model(self):
        """Returns the graph as an ONNX model."""
        info = lambda v: helper.make_tensor_value_info(v.name, KINDS[v.dtype], v.shape)
        graph = helper.make_graph(
            self.nodes, self.name, [info(v) for v in [*self.inputs.values(), *self.weights.values()]],
            [info(v) for v in self.outputs.values()],
            [numpy_helper.from_array(a, name) for name, a in self.constants.values()])
        return helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION,
                                 producer_name="subsplat tools/witness")

    def bytes(self):
        """Checks and serialises the graph."""
        model = self.model()
        # Strict: the shapes of the builder must equal those that ONNX infers.
        onnx.checker.check_model(onnx.shape_inference.infer_shapes(model, check_type=True, strict_mode=True))
        return model.SerializeToString(deterministic=True)

    def save(self, path):
        path.write_bytes(self.bytes())
