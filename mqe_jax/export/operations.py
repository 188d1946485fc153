"""Translations of JAX's operations to ONNX nodes, by the name of the operation.

A rule `(graph, equation, *inputs) -> outputs` returns values that may be only broadcast along an axis (see
`Value.shape`). Gathers and scatters are in `indexing`.
"""

from __future__ import annotations

import math
import string
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from onnx import helper

from mqe_jax.errors import InputError
from mqe_jax.export.graph import BATCH, Graph, Shape, Value, constant

Rule = Callable[..., Value | Sequence[Value]]
RULES: dict[str, Rule] = {}

_NODES = {
    **{name: name.capitalize() for name in ("abs", "acos", "acosh", "add", "asin", "asinh", "atan", "atanh", "ceil")},
    **{name: name.capitalize() for name in ("cos", "cosh", "div", "erf", "exp", "floor", "log", "max", "min", "mul")},
    **{name: name.capitalize() for name in ("neg", "pow", "sign", "sin", "sinh", "sqrt", "sub", "tan", "tanh")},
    **{"and": "And", "eq": "Equal", "ge": "GreaterOrEqual", "gt": "Greater", "le": "LessOrEqual", "lt": "Less"},
    **{"logistic": "Sigmoid", "not": "Not", "or": "Or", "xor": "Xor"},
}
"""Elementwise operations that are one node."""

_COMPOSED: dict[str, Callable[..., Value]] = {
    "clamp": lambda g, low, x, high: g.op("Min", g.op("Max", x, low), high),
    "copy": lambda g, x: x,
    "erfc": lambda g, x: g.op("Sub", constant(1.0), g.op("Erf", x)),
    "expm1": lambda g, x: g.op("Sub", g.op("Exp", x), constant(1.0)),
    "is_finite": lambda g, x: g.op("Not", g.op("Or", g.op("IsInf", x), g.op("IsNaN", x))),
    "log1p": lambda g, x: g.op("Log", g.op("Add", constant(1.0), x)),
    "ne": lambda g, x, y: g.op("Not", g.op("Equal", x, y)),
    "rem": lambda g, x, y: g.op("Mod", x, y, fmod=1),
    "rsqrt": lambda g, x: g.op("Reciprocal", g.op("Sqrt", x)),
    "square": lambda g, x: g.op("Mul", x, x),
    "stop_gradient": lambda g, x: x,
}
"""Other elementwise operations."""


def unsupported(equation: Any, reason: str) -> InputError:
    """Returns the error for an operation that is translated in other cases only."""
    return InputError(f"onnx: the JAX operation {equation.primitive.name!r} has no translation {reason}")


def repeated(function: Rule) -> Rule:
    """Returns a rule for inputs that may be only broadcast; `function` gets them repeated to their JAX shapes."""

    def apply(graph: Graph, equation: Any, *inputs: Value) -> Value | Sequence[Value]:
        shapes = [variable.aval.shape for variable in equation.invars]
        return function(graph, equation, *(graph.full(x, shape) for x, shape in zip(inputs, shapes, strict=True)))

    return apply


def _rule(*names: str) -> Callable[[Rule], Rule]:
    """Registers a function of repeated inputs as the rule of operations."""

    def register(function: Rule) -> Rule:
        RULES.update(dict.fromkeys(names, repeated(function)))
        return function

    return register


def _elementwise(*names: str) -> Callable[[Rule], Rule]:
    """Registers a function of inputs that may be only broadcast as the rule of operations."""

    def register(function: Rule) -> Rule:
        RULES.update(dict.fromkeys(names, function))
        return function

    return register


def _shape(equation: Any) -> Shape:
    return equation.outvars[0].aval.shape


def _cast(graph: Graph, x: Value, dtype: Any) -> Value:
    return graph.op("Cast", x, to=helper.np_dtype_to_tensor_dtype(np.dtype(dtype)))


# -- elementwise -----------------------------------------------------------------------------------------------------


@_elementwise(*_NODES)
def _node(graph: Graph, equation: Any, *inputs: Value) -> Value:
    name = equation.primitive.name
    if name in ("and", "not", "or", "xor") and equation.outvars[0].aval.dtype != bool:
        raise unsupported(equation, "for integers")
    return graph.op(_NODES[name], *inputs)


@_elementwise(*_COMPOSED)
def _composed(graph: Graph, equation: Any, *inputs: Value) -> Value:
    return _COMPOSED[equation.primitive.name](graph, *inputs)


@_elementwise("integer_pow")
def _integer_pow(graph: Graph, equation: Any, x: Value) -> Value:
    return graph.op("Pow", x, constant(equation.params["y"], equation.invars[0].aval.dtype))


@_elementwise("round")
def _round(graph: Graph, equation: Any, x: Value) -> Value:
    if equation.params["rounding_method"] != jax.lax.RoundingMethod.TO_NEAREST_EVEN:
        raise unsupported(equation, "for halves away from zero")
    return graph.op("Round", x)


@_elementwise("atan2")
def _atan2(graph: Graph, equation: Any, y: Value, x: Value) -> Value:
    """Negative zeros are taken as zeros."""
    zero = constant(0.0)
    angle = graph.op("Atan", graph.op("Div", y, graph.op("Abs", x)))
    half_turn = graph.op("Where", graph.op("Less", y, zero), constant(-math.pi), constant(math.pi))
    angle = graph.op("Where", graph.op("Less", x, zero), graph.op("Sub", half_turn, angle), angle)
    origin = graph.op("And", graph.op("Equal", x, zero), graph.op("Equal", y, zero))
    return graph.op("Where", origin, zero, angle)


@_elementwise("convert_element_type")
def _convert(graph: Graph, equation: Any, x: Value) -> Value:
    dtype = np.dtype(equation.params["new_dtype"])
    if x.array is not None:
        return constant(x.array, dtype)
    return x if dtype == equation.invars[0].aval.dtype else _cast(graph, x, dtype)


@_elementwise("select_n")
def _select(graph: Graph, equation: Any, which: Value, *cases: Value) -> Value:
    if which.array is not None and np.all(which.array == which.array.flat[0]):
        return cases[int(which.array.flat[0])]
    if equation.invars[0].aval.dtype != bool:
        chosen = cases[-1]
        for i, case in reversed(list(enumerate(cases[:-1]))):
            chosen = graph.op("Where", graph.op("LessOrEqual", which, constant(i, np.int32)), case, chosen)
        return chosen
    if equation.outvars[0].aval.dtype != bool:
        return graph.op("Where", which, cases[1], cases[0])
    no, yes = graph.op("And", graph.op("Not", which), cases[0]), graph.op("And", which, cases[1])
    return graph.op("Or", no, yes)  # onnxruntime has no Where of bool


# -- shapes ----------------------------------------------------------------------------------------------------------


@_elementwise("dim_as_value")
def _batch_size(graph: Graph, equation: Any) -> Value:
    if str(equation.params["dim"]) != BATCH:
        raise unsupported(equation, f"for {equation.params['dim']}")
    return _cast(graph, graph.reshape(graph.batch_size(), ()), equation.outvars[0].aval.dtype)


@_elementwise("broadcast_in_dim")
def _broadcast_in_dim(graph: Graph, equation: Any, x: Value) -> Value:
    """Only inserts axes of size 1; rules that need repeated values repeat them."""
    shape: list[Any] = [1] * len(equation.params["shape"])
    for axis, size in zip(equation.params["broadcast_dimensions"], x.shape, strict=True):
        shape[axis] = size
    return graph.reshape(x, tuple(shape))


@_elementwise("transpose")
def _transpose(graph: Graph, equation: Any, x: Value) -> Value:
    return graph.transpose(x, equation.params["permutation"])


@_rule("reshape", "squeeze")
def _reshape(graph: Graph, equation: Any, x: Value) -> Value:
    return graph.reshape(x, _shape(equation))


@_rule("concatenate")
def _concatenate(graph: Graph, equation: Any, *inputs: Value) -> Value:
    return graph.op("Concat", *inputs, shape=_shape(equation), axis=int(equation.params["dimension"]))


@_rule("stack")
def _stack(graph: Graph, equation: Any, *inputs: Value) -> Value:
    return stacked(graph, inputs, _shape(equation), int(equation.params["axis"]))


def stacked(graph: Graph, rows: Sequence[Value], shape: Shape, axis: int) -> Value:
    """Stacks values along a new axis to `shape`."""
    before, after = shape[:axis], shape[axis + 1 :]
    parts = [graph.reshape(graph.full(row, (*before, *after)), (*before, 1, *after)) for row in rows]
    return parts[0] if len(parts) == 1 else graph.op("Concat", *parts, shape=shape, axis=axis)


@_rule("split")
def _split(graph: Graph, equation: Any, x: Value) -> list[Value]:
    shapes = [variable.aval.shape for variable in equation.outvars]
    sizes = constant([int(n) for n in equation.params["sizes"]], np.int64)
    return graph.split_op("Split", shapes, x, sizes, axis=int(equation.params["axis"]))


def _sliced(graph: Graph, x: Value, shape: Shape, cuts: Sequence[tuple[int, int, int, int]]) -> Value:
    """Slices along axes: (axis, start, end, step) each."""
    if not cuts:
        return x
    axis, start, end, step = (constant(column, np.int64) for column in zip(*cuts, strict=True))
    return graph.op("Slice", x, start, end, axis, step, shape=shape)


@_rule("slice")
def _slice(graph: Graph, equation: Any, x: Value) -> Value:
    params, shape = equation.params, _shape(equation)
    rows = zip(params["start_indices"], params["limit_indices"], params["strides"] or (1,) * len(shape), strict=True)
    cuts = [(i, int(a), int(b), int(s)) for i, (a, b, s) in enumerate(rows) if x.shape[i] != shape[i]]
    return _sliced(graph, x, shape, cuts)


@_rule("rev")
def _rev(graph: Graph, equation: Any, x: Value) -> Value:
    cuts = [(int(axis), -1, np.iinfo(np.int64).min, -1) for axis in equation.params["dimensions"]]
    return _sliced(graph, x, _shape(equation), cuts)


def item(graph: Graph, x: Value, i: int) -> Value:
    """Returns x[i] of a value that may be only broadcast."""
    if x.array is not None:
        return constant(x.array[min(i, len(x.array) - 1)])
    if x.shape[0] != 1:
        x = _sliced(graph, x, (1, *x.shape[1:]), [(0, i, i + 1, 1)])
    return graph.reshape(x, x.shape[1:])


@_rule("tile")
def _tile(graph: Graph, equation: Any, x: Value) -> Value:
    reps = constant([int(n) for n in equation.params["reps"]], np.int64)
    return graph.op("Tile", x, reps, shape=_shape(equation))


@_rule("pad")
def _pad(graph: Graph, equation: Any, x: Value, filling: Value) -> Value:
    low, high, interior = zip(*equation.params["padding_config"], strict=True)
    if any(interior):
        raise unsupported(equation, "with interior padding")
    return graph.op("Pad", x, constant([*low, *high], np.int64), filling, shape=_shape(equation))


# -- reductions and products -----------------------------------------------------------------------------------------


def _axes(equation: Any) -> list[int]:
    return [int(axis) for axis in equation.params["axes"]]


@_rule("reduce_sum")
def _reduce_sum(graph: Graph, equation: Any, x: Value) -> Value:
    return graph.op("ReduceSum", x, constant(_axes(equation), np.int64), shape=_shape(equation), keepdims=0)


@_rule("reduce_max", "reduce_min", "reduce_prod")
def _reduce(graph: Graph, equation: Any, x: Value) -> Value:
    kind = equation.primitive.name.removeprefix("reduce_").capitalize()
    return graph.op(f"Reduce{kind}", x, shape=_shape(equation), axes=_axes(equation), keepdims=0)


@_rule("reduce_and", "reduce_or")
def _reduce_bool(graph: Graph, equation: Any, x: Value) -> Value:
    kind = {"reduce_and": "ReduceMin", "reduce_or": "ReduceMax"}[equation.primitive.name]
    whole = graph.op(kind, _cast(graph, x, np.int32), shape=_shape(equation), axes=_axes(equation), keepdims=0)
    return _cast(graph, whole, bool)


@_rule("argmax", "argmin")
def _arg(graph: Graph, equation: Any, x: Value) -> Value:
    kind = {"argmax": "ArgMax", "argmin": "ArgMin"}[equation.primitive.name]
    x = _cast(graph, x, np.int32) if equation.invars[0].aval.dtype == bool else x
    index = graph.op(kind, x, shape=_shape(equation), axis=_axes(equation)[0], keepdims=0)
    return _cast(graph, index, equation.params["index_dtype"])


@_rule("dot_general")
def _dot_general(graph: Graph, equation: Any, x: Value, y: Value) -> Value:
    """A MatMul of matrices or of batches of matrices, else an Einsum."""
    (x_sum, y_sum), (x_batch, y_batch) = equation.params["dimension_numbers"]
    x_free = [i for i in range(len(x.shape)) if i not in (*x_sum, *x_batch)]
    y_free = [i for i in range(len(y.shape)) if i not in (*y_sum, *y_batch)]
    if len(x_sum) == len(y_free) == 1 and (len(x_free) == 1 or (x_free and not x_batch)):
        x = graph.transpose(x, (*x_batch, *x_free, *x_sum))
        return graph.op("MatMul", x, graph.transpose(y, (*y_batch, *y_sum, *y_free)), shape=_shape(equation))
    x_names = string.ascii_lowercase[: len(x.shape)]
    y_names = list(string.ascii_uppercase[: len(y.shape)])
    for i, j in zip((*x_sum, *x_batch), (*y_sum, *y_batch), strict=True):
        y_names[j] = x_names[i]
    out = [*(x_names[i] for i in (*x_batch, *x_free)), *(y_names[i] for i in y_free)]
    names = f"{x_names},{''.join(y_names)}->{''.join(out)}"
    return graph.op("Einsum", x, y, shape=_shape(equation), equation=names)
