"""A builder of ONNX graphs over a symbolic batch axis N, with equal nodes and equal constants merged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import onnx
from jax import export
from onnx import TensorProto, helper, numpy_helper

from mqe_jax.errors import InputError

OPSET = 17
IR_VERSION = 9
BATCH = "N"

Shape = tuple[Any, ...]
"""Sizes of the axes: integers, and symbolic dimensions of `jax.export`."""


@dataclass(frozen=True, eq=False)
class Value:
    """A node's output, an input, or a constant."""

    shape: Shape
    """Shape in the graph: 1 where the JAX value is only broadcast along an axis."""
    name: str = ""
    """Name in the graph; empty for constants, which become part of the graph where a node uses them."""
    array: np.ndarray | None = None
    """Content of a constant."""


def constant(array: Any, dtype: Any = None) -> Value:
    """Returns a constant; a Python float is float32."""
    array = np.asarray(array, np.float32 if dtype is None and isinstance(array, float) else dtype)
    return Value(array.shape, array=array)


def is_static(shape: Shape) -> bool:
    """Returns whether a shape has no symbolic axis."""
    return not any(export.is_symbolic_dim(size) for size in shape)


def onnx_shape(shape: Shape) -> list[int]:
    """Returns a shape for ONNX's Reshape; InputError for several symbolic axes."""
    sizes = [-1 if export.is_symbolic_dim(size) else int(size) for size in shape]
    if sizes.count(-1) > 1:
        raise InputError(f"onnx: an array of shape {shape} is not allowed; it must have one batch axis")
    return sizes


class Graph:
    """Collects nodes, constants, inputs and outputs."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._nodes: list[Any] = []
        self._constants: list[Any] = []
        self._inputs: list[Any] = []
        self._outputs: list[Any] = []
        self._known: dict[Any, list[str]] = {}
        """Names by the content of a constant, or by a node's kind, inputs and attributes."""

    def input(self, name: str, shape: Shape) -> Value:
        """Declares a float32 input with the leading axis N."""
        self._inputs.append(_information(name, TensorProto.FLOAT, shape))
        return Value(shape, name)

    def output(self, name: str, value: Value, shape: Shape, dtype: Any) -> None:
        """Declares a value, broadcast to `shape`, as an output."""
        self._nodes.append(helper.make_node("Identity", [self._use(self.full(value, shape))], [name]))
        self._outputs.append(_information(name, helper.np_dtype_to_tensor_dtype(np.dtype(dtype)), shape))

    def op(self, kind: str, *inputs: Value, shape: Shape | None = None, **attributes: Any) -> Value:
        """Adds a node with one output of `shape`, by default of the inputs' shapes broadcast together."""
        shape = broadcast(*(x.shape for x in inputs)) if shape is None else shape
        return self.split_op(kind, [shape], *inputs, **attributes)[0]

    def split_op(self, kind: str, shapes: Sequence[Shape], *inputs: Value, **attributes: Any) -> list[Value]:
        """Adds a node with outputs of the given shapes."""
        used = [self._use(x) for x in inputs]
        key = (kind, *used, repr(attributes))
        if key not in self._known:
            self._known[key] = [f"{kind.lower()}_{len(self._known)}_{i}" for i in range(len(shapes))]
            self._nodes.append(helper.make_node(kind, used, self._known[key], **attributes))
        return [Value(shape, name) for shape, name in zip(shapes, self._known[key], strict=True)]

    def reshape(self, x: Value, shape: Shape) -> Value:
        """Reshapes a value; constants are reshaped at once."""
        if x.shape == shape:
            return x
        if x.array is not None and is_static(shape):
            return constant(x.array.reshape(shape))
        return self.op("Reshape", x, constant(onnx_shape(shape), np.int64), shape=shape)

    def transpose(self, x: Value, order: Sequence[int]) -> Value:
        """Permutes axes; constants are permuted at once."""
        order = [int(axis) for axis in order]
        if order == list(range(len(order))):
            return x
        if x.array is not None:
            return constant(x.array.transpose(order))
        return self.op("Transpose", x, shape=tuple(x.shape[axis] for axis in order), perm=order)

    def full(self, x: Value, shape: Shape) -> Value:
        """Broadcasts a value to `shape`, of equal rank; constants of a static shape at once."""
        if x.shape == shape:
            return x
        if x.array is not None and is_static(shape):
            return constant(np.broadcast_to(x.array, shape))
        sizes = [self.batch_size() if str(n) == BATCH else constant([int(n)], np.int64) for n in shape]
        return self.op("Expand", x, self.op("Concat", *sizes, shape=(len(sizes),), axis=0), shape=shape)

    def batch_size(self) -> Value:
        """Returns N as an array (1,)."""
        return self.op("Shape", Value((), self._inputs[0].name), shape=(1,), start=0, end=1)

    def model(self, properties: Mapping[str, str]) -> onnx.ModelProto:
        """Returns the checked model with its properties."""
        graph = helper.make_graph(self._nodes, self._name, self._inputs, self._outputs, self._constants)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="mqe_jax")
        model.ir_version = IR_VERSION
        helper.set_model_props(model, dict(properties))
        onnx.checker.check_model(model, full_check=True)
        return model

    def _use(self, x: Value) -> str:
        """Returns a value's name; constants are added to the graph.

        Float32 constants that float16 represents exactly are stored as float16, with a cast: half the size.
        """
        if x.array is None:
            return x.name
        array = np.ascontiguousarray(x.array).reshape(x.array.shape)
        key = (array.dtype.str, array.shape, array.tobytes())
        if key not in self._known:
            name = f"constant_{len(self._known)}"
            half = array.astype(np.float16) if array.dtype == np.float32 and array.size > 1000 else array
            exact = np.array_equal(half, array)
            self._constants.append(numpy_helper.from_array(half if exact else array, name))
            self._known[key] = [name]
            if exact and half is not array:
                self._known[key] = [self.op("Cast", Value(array.shape, name), to=TensorProto.FLOAT).name]
        return self._known[key][0]


def broadcast(*shapes: Shape) -> Shape:
    """Returns the shape of arrays broadcast together, as in NumPy, with symbolic axes."""
    rank = max(map(len, shapes), default=0)
    padded = [(1,) * (rank - len(shape)) + tuple(shape) for shape in shapes]
    return tuple(
        next((n for n in sizes if export.is_symbolic_dim(n) or n != 1), 1) for sizes in zip(*padded, strict=True)
    )


def _information(name: str, kind: int, shape: Shape) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, kind, [n if isinstance(n, int) else str(n) for n in shape])
