"""Networks of the contract of ``smooth --learned``, a few kB each: one that is fitted to walks, and some that lie."""

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

RATE, SAMPLES = 200, 200
FREQUENCIES = (1.0, 1.4, 1.8, 2.2, 2.7, 3.5)  # [Hz] of the gait
IR = 10  # of ONNX's format: older runtimes read it
OPSET = 17


def basis():
    """Cosines and sines of the gait's frequencies under a Hann window ``(200, 2 f)``."""
    t = np.arange(SAMPLES) / RATE
    window = np.hanning(SAMPLES + 2)[1:-1]
    waves = [wave(2 * np.pi * f * t) for wave in (np.cos, np.sin) for f in FREQUENCIES]
    waves = np.array(waves) * window
    return ((waves - waves.mean(axis=1, keepdims=True)) / window.sum()).T.astype(np.float32)


def features(windows):
    """Level vectors ``(n, 2, k)`` of windows ``(n, 6, 200)``, which turn with the frame: a fitted sum is a velocity.

    They are the level acceleration in phase with the vertical one and a quarter behind, at each frequency, times sizes
    of the motion.
    """
    f = len(FREQUENCIES)
    a = windows[:, 3:] @ basis()
    c, s = a[..., :f], a[..., f:]
    up_c, up_s = c[:, 2:], s[:, 2:]
    size = np.sqrt(np.sum(up_c**2 + up_s**2, axis=-1, keepdims=True) + 1e-3)
    level = np.sqrt(np.sum(c[:, :2] ** 2 + s[:, :2] ** 2, axis=(1, 2), keepdims=True) + 1e-3)
    phase = [(c[:, :2] * up_c + s[:, :2] * up_s) / size, (s[:, :2] * up_c - c[:, :2] * up_s) / size]
    vectors = np.concatenate(phase, axis=-1) / level
    return np.concatenate([vectors, vectors * size, vectors * level, vectors * np.sqrt(size)], axis=-1)


def fitted(windows, velocity, ridge=1e-2):
    """Weights ``(k,)`` of `features` that fit velocities ``(n, 2)``, by ridge regression."""
    columns = features(windows).reshape(-1, 8 * len(FREQUENCIES))
    scale = columns.std(axis=0)
    A = columns / scale
    return np.linalg.solve(A.T @ A + ridge * len(A) * np.eye(A.shape[1]), A.T @ velocity.ravel()) / scale


def write_network(path, weights, sigma=None, turn=0.0, scale=1.0, offset=(0.0, 0.0)):
    """Write the network of `features` and weights as ONNX; sigma: that it states [m/s]; the rest: how it lies."""
    f, k = len(FREQUENCIES), 8 * len(FREQUENCIES)
    rows = {
        "basis": basis(),
        "small": np.float32(1e-3),
        "weights": np.asarray(weights, dtype=np.float32).reshape(k, 1),
        "turn": (scale * np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])).astype(np.float32),
        "offset": np.asarray(offset, dtype=np.float32).reshape(1, 2),
        "log_sigma": np.full((1, 2), np.log(sigma or 1.0), dtype=np.float32),
        "0": np.array([0]), "2": np.array([2]), "3": np.array([3]), "5": np.array([5]), "6": np.array([6]),
        "f": np.array([f]), "2f": np.array([2 * f]), "c": np.array([1]), "t": np.array([2]), "flat": np.array([-1, 2]),
        "zero": np.zeros((1, 2), dtype=np.float32),
    }  # fmt: skip
    nodes = []

    def op(kind, *inputs, **attributes):
        name = f"{kind}{len(nodes)}"
        nodes.append(helper.make_node(kind, inputs, [name], **attributes))
        return name

    def energy(c, s, axes):
        square = op("Add", op("Mul", c, c), op("Mul", s, s))
        return op("Sqrt", op("Add", op("ReduceSum", square, axes), "small"))

    rows["last"], rows["both"] = np.array([-1]), np.array([1, 2])
    a = op("MatMul", op("Slice", "samples", "3", "6", "c"), "basis")
    xy, z = op("Slice", a, "0", "2", "c"), op("Slice", a, "2", "3", "c")
    (c, s), (up_c, up_s) = (
        [op("Slice", of, first, after, "t") for first, after in (("0", "f"), ("f", "2f"))] for of in (xy, z)
    )
    size, level = energy(up_c, up_s, "last"), energy(c, s, "both")
    ahead = op("Div", op("Add", op("Mul", c, up_c), op("Mul", s, up_s)), size)
    behind = op("Div", op("Sub", op("Mul", s, up_c), op("Mul", c, up_s)), size)
    vectors = op("Div", op("Concat", ahead, behind, axis=-1), level)
    sizes = [size, level, op("Sqrt", size)]
    every = op("Concat", vectors, *(op("Mul", vectors, of) for of in sizes), axis=-1)
    velocity = op("Reshape", op("MatMul", every, "weights"), "flat")
    velocity = op("Add", op("MatMul", velocity, "turn"), "offset")
    outputs = [velocity]
    if sigma is not None:
        outputs.append(op("Add", op("Mul", velocity, "zero"), "log_sigma"))
    for name, made in zip(("velocity", "log"), outputs, strict=False):
        nodes.append(helper.make_node("Identity", [made], [name]))
    save(path, nodes, rows, ["velocity", "log"][: len(outputs)])
    return path


def save(path, nodes, rows, outputs, shape=("N", 6, SAMPLES), made=("N", 2)):
    """Write a model with one input ``samples``."""
    value = helper.make_tensor_value_info
    graph = helper.make_graph(
        nodes,
        "walker",
        [value("samples", TensorProto.FLOAT, shape)],
        [value(name, TensorProto.FLOAT, made) for name in outputs],
        [numpy_helper.from_array(np.asarray(values), name) for name, values in rows.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR)
    onnx.checker.check_model(model)
    onnx.save(model, path)
