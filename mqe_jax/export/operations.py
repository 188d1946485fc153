"""Translations of JAX's operations to ONNX nodes, by the name of the operation.

A rule `(graph, equation, *inputs) -> outputs` gets inputs that may be broadcast (see `Value.shape`) and may return
such outputs. Indices of gathers and scatters must not depend on the inputs of the function.
"""

from __future__ import annotations

import functools
import math
import string
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from onnx import helper

from mqe_jax.errors import InputError
from mqe_jax.export.graph import Graph, Shape, Value, constant

Rule = Callable[..., Value | Sequence[Value]]
RULES: dict[str, Rule] = {}

_ELEMENTWISE = {
    **{name: name.capitalize() for name in ("abs", "acos", "acosh", "add", "asin", "asinh", "atan", "atanh", "ceil")},
    **{name: name.capitalize() for name in ("cos", "cosh", "div", "erf", "exp", "floor", "log", "max", "min", "mul")},
    **{name: name.capitalize() for name in ("neg", "pow", "sign", "sin", "sinh", "sqrt", "sub", "tan", "tanh")},
    **{"and": "And", "eq": "Equal", "ge": "GreaterOrEqual", "gt": "Greater", "le": "LessOrEqual", "lt": "Less"},
    **{"logistic": "Sigmoid", "not": "Not", "or": "Or", "xor": "Xor"},
}
_BITWISE = ("and", "or", "xor", "not")

_COMPOSED: dict[str, Callable[..., Value]] = {
    "clamp": lambda g, low, x, high: g.op("Min", g.op("Max", x, low), high),
    "copy": lambda g, x: x,
    "copy_p": lambda g, x: x,
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


def rule(*names: str) -> Callable[[Rule], Rule]:
    """Registers a function as the rule of operations."""

    def register(function: Rule) -> Rule:
        RULES.update(dict.fromkeys(names, function))
        return function

    return register


def _unsupported(equation: Any, reason: str) -> InputError:
    return InputError(f"onnx: the JAX operation {equation.primitive.name!r} has no translation {reason}")


def _elementwise(name: str, graph: Graph, equation: Any, *inputs: Value) -> Value:
    if name in _BITWISE and equation.outvars[0].aval.dtype != bool:
        raise _unsupported(equation, "for integers")
    return graph.op(_ELEMENTWISE[name], *inputs)


RULES.update({name: functools.partial(_elementwise, name) for name in _ELEMENTWISE})
RULES.update(
    {name: lambda graph, equation, *x, make=make: make(graph, *x) for name, make in _COMPOSED.items()}
)


@rule("integer_pow")
def _integer_pow(graph: Graph, equation: Any, x: Value) -> Value:
    return graph.op("Pow", x, constant(equation.params["y"], equation.invars[0].aval.dtype))


@rule("round")
def _round(graph: Graph, equation: Any, x: Value) -> Value:
    if equation.params["rounding_method"] != jax.lax.RoundingMethod.TO_NEAREST_EVEN:
        raise _unsupported(equation, "for halves away from zero")
    return graph.op("Round", x)


@rule("atan2")
def _atan2(graph: Graph, equation: Any, y: Value, x: Value) -> Value:
    """Signed zeros are not distinguished: (0, x < 0) gives pi."""
    zero, pi = constant(0.0), constant(math.pi)
    angle = graph.op("Atan", graph.op("Div", y, x))
    half_turn = graph.op("Where", graph.op("Less", y, zero), graph.op("Neg", pi), pi)
    angle = graph.op("Where", graph.op("Less", x, zero), graph.op("Add", angle, half_turn), angle)
    origin = graph.op("And", graph.op("Equal", x, zero), graph.op("Equal", y, zero))
    return graph.op("Where", origin, zero, angle)


@rule("convert_element_type")
def _convert(graph: Graph, equation: Any, x: Value) -> Value:
    dtype = np.dtype(equation.params["new_dtype"])
    if x.array is not None:
        return constant(x.array, dtype)
    if dtype == equation.invars[0].aval.dtype:
        return x
    return graph.op("Cast", x, to=helper.np_dtype_to_tensor_dtype(dtype))


@rule("select_n")
def _select(graph: Graph, equation: Any, which: Value, *cases: Value) -> Value:
    if which.array is not None and which.array.size and np.all(which.array == which.array.flat[0]):
        return cases[int(which.array.flat[0])]
    if equation.invars[0].aval.dtype == bool:
        return graph.op("Where", which, cases[1], cases[0])
    chosen = cases[-1]
    for i, case in reversed(list(enumerate(cases[:-1]))):
        chosen = graph.op("Where", graph.op("LessOrEqual", which, constant(i, np.int32)), case, chosen)
    return chosen


# -- shapes ----------------------------------------------------------------------------------------------------------


def _full(graph: Graph, equation: Any, inputs: Sequence[Value]) -> list[Value]:
    """Returns an equation's inputs, none of them only broadcast."""
    return [graph.full(x, v.aval.shape) for x, v in zip(inputs, equation.invars, strict=True)]


@rule("broadcast_in_dim")
def _broadcast_in_dim(graph: Graph, equation: Any, x: Value) -> Value:
    """Only inserts axes of size 1; the operations that need the values repeated do it."""
    shape: list[Any] = [1] * len(equation.params["shape"])
    for axis, size in zip(equation.params["broadcast_dimensions"], x.shape, strict=True):
        shape[axis] = size
    return graph.reshape(x, tuple(shape))


@rule("reshape", "squeeze", "expand_dims")
def _reshape(graph: Graph, equation: Any, x: Value) -> Value:
    return graph.reshape(*_full(graph, equation, [x]), equation.outvars[0].aval.shape)


@rule("transpose")
def _transpose(graph: Graph, equation: Any, x: Value) -> Value:
    return graph.transpose(x, equation.params["permutation"])


@rule("concatenate")
def _concatenate(graph: Graph, equation: Any, *inputs: Value) -> Value:
    axis, shape = int(equation.params["dimension"]), equation.outvars[0].aval.shape
    return graph.op("Concat", *_full(graph, equation, inputs), shape=shape, axis=axis)


def stacked(graph: Graph, rows: Sequence[Value], shape: Shape, axis: int) -> Value:
    """Stacks values along a new axis to `shape`."""
    own = (*shape[:axis], *shape[axis + 1 :])
    one = (*shape[:axis], 1, *shape[axis + 1 :])
    parts = [graph.reshape(graph.full(row, own), one) for row in rows]
    return parts[0] if len(parts) == 1 else graph.op("Concat", *parts, shape=shape, axis=axis)


@rule("stack")
def _stack(graph: Graph, equation: Any, *inputs: Value) -> Value:
    return stacked(graph, inputs, equation.outvars[0].aval.shape, int(equation.params["axis"]))


@rule("split")
def _split(graph: Graph, equation: Any, x: Value) -> list[Value]:
    shapes = [v.aval.shape for v in equation.outvars]
    sizes = constant([int(n) for n in equation.params["sizes"]], np.int64)
    return graph.split_op("Split", shapes, *_full(graph, equation, [x]), sizes, axis=int(equation.params["axis"]))


def _sliced(graph: Graph, x: Value, shape: Shape, cuts: Sequence[tuple[int, int, int, int]]) -> Value:
    """Slices along axes: (axis, start, end, step) each."""
    if not cuts:
        return x
    axis, start, end, step = (constant(column, np.int64) for column in zip(*cuts, strict=True))
    return graph.op("Slice", x, start, end, axis, step, shape=shape)


@rule("slice")
def _slice(graph: Graph, equation: Any, x: Value) -> Value:
    params, own, shape = equation.params, equation.invars[0].aval.shape, equation.outvars[0].aval.shape
    steps = params["strides"] or (1,) * len(own)
    rows = enumerate(zip(params["start_indices"], params["limit_indices"], steps, strict=True))
    cuts = [(axis, int(a), int(b), int(s)) for axis, (a, b, s) in rows if own[axis] != shape[axis]]
    return _sliced(graph, *_full(graph, equation, [x]), shape, cuts)


def item(graph: Graph, x: Value, shape: Shape, i: int) -> Value:
    """Returns x[i] of a value broadcast to `shape`."""
    if x.array is not None:
        return constant(x.array[min(i, len(x.array) - 1)])
    if x.shape[0] != 1:
        x = _sliced(graph, x, (1, *x.shape[1:]), [(0, i, i + 1, 1)])
    return graph.reshape(x, x.shape[1:])


@rule("rev")
def _rev(graph: Graph, equation: Any, x: Value) -> Value:
    first = np.iinfo(np.int64).min
    cuts = [(int(axis), -1, first, -1) for axis in equation.params["dimensions"]]
    return _sliced(graph, *_full(graph, equation, [x]), equation.outvars[0].aval.shape, cuts)


@rule("tile")
def _tile(graph: Graph, equation: Any, x: Value) -> Value:
    reps = constant([int(n) for n in equation.params["reps"]], np.int64)
    return graph.op("Tile", *_full(graph, equation, [x]), reps, shape=equation.outvars[0].aval.shape)


@rule("pad")
def _pad(graph: Graph, equation: Any, x: Value, filling: Value) -> Value:
    low, high, interior = zip(*equation.params["padding_config"], strict=True)
    if any(interior):
        raise _unsupported(equation, "with interior padding")
    x, filling = _full(graph, equation, [x, filling])
    return graph.op("Pad", x, constant([*low, *high], np.int64), filling, shape=equation.outvars[0].aval.shape)


# -- reductions and products -----------------------------------------------------------------------------------------


def _axes(equation: Any) -> list[int]:
    return [int(axis) for axis in equation.params["axes"]]


@rule("reduce_sum")
def _reduce_sum(graph: Graph, equation: Any, x: Value) -> Value:
    (x,), shape = _full(graph, equation, [x]), equation.outvars[0].aval.shape
    return graph.op("ReduceSum", x, constant(_axes(equation), np.int64), shape=shape, keepdims=0)


@rule("reduce_max", "reduce_min", "reduce_prod", "reduce_and", "reduce_or")
def _reduce(graph: Graph, equation: Any, x: Value) -> Value:
    (x,), shape, name = _full(graph, equation, [x]), equation.outvars[0].aval.shape, equation.primitive.name
    kinds = {"max": "Max", "min": "Min", "prod": "Prod", "and": "Min", "or": "Max"}
    kind = f"Reduce{kinds[name.removeprefix('reduce_')]}"
    cast = lambda x, dtype: graph.op("Cast", x, to=helper.np_dtype_to_tensor_dtype(np.dtype(dtype)))  # noqa: E731
    if equation.outvars[0].aval.dtype == bool:
        return cast(graph.op(kind, cast(x, np.int32), shape=shape, axes=_axes(equation), keepdims=0), bool)
    return graph.op(kind, x, shape=shape, axes=_axes(equation), keepdims=0)


@rule("argmax", "argmin")
def _arg(graph: Graph, equation: Any, x: Value) -> Value:
    (x,), (axis,) = _full(graph, equation, [x]), _axes(equation)
    kind = {"argmax": "ArgMax", "argmin": "ArgMin"}[equation.primitive.name]
    index = graph.op(kind, x, shape=equation.outvars[0].aval.shape, axis=axis, keepdims=0)
    return graph.op("Cast", index, to=helper.np_dtype_to_tensor_dtype(np.dtype(equation.params["index_dtype"])))


@rule("dot_general")
def _dot_general(graph: Graph, equation: Any, x: Value, y: Value) -> Value:
    """A MatMul of matrices or batches of matrices, else an Einsum."""
    (x_sum, y_sum), (x_batch, y_batch) = equation.params["dimension_numbers"]
    x, y = _full(graph, equation, [x, y])
    shape = equation.outvars[0].aval.shape
    x_free = [i for i in range(len(x.shape)) if i not in (*x_sum, *x_batch)]
    y_free = [i for i in range(len(y.shape)) if i not in (*y_sum, *y_batch)]
    if len(x_sum) == len(y_free) == 1 and (len(x_free) == 1 or (x_free and not x_batch)):
        x = graph.transpose(x, (*x_batch, *x_free, *x_sum))
        return graph.op("MatMul", x, graph.transpose(y, (*y_batch, *y_sum, *y_free)), shape=shape)
    letters = iter(string.ascii_lowercase)
    x_names = [next(letters) for _ in x.shape]
    y_names = [next(letters) for _ in y.shape]
    for i, j in zip((*x_sum, *x_batch), (*y_sum, *y_batch), strict=True):
        y_names[j] = x_names[i]
    out = [*(x_names[i] for i in (*x_batch, *x_free)), *(y_names[i] for i in y_free)]
    return graph.op("Einsum", x, y, shape=shape, equation=f"{''.join(x_names)},{''.join(y_names)}->{''.join(out)}")


# -- gathers and scatters --------------------------------------------------------------------------------------------
# With fixed indices these move numbers within an environment. The operation itself, applied to the positions of the
# numbers of two environments, says from where to where.


def _sized(value: Any) -> Any:
    """Replaces symbolic dimensions in (tuples of) sizes by 2."""
    if isinstance(value, tuple) and type(value) is tuple:
        return tuple(map(_sized, value))
    return 2 if export.is_symbolic_dim(value) else value


def _positions(shape: Shape) -> jax.Array:
    """The position of each number of two environments' arrays."""
    shape = _sized(shape)
    return jnp.arange(math.prod(shape), dtype=jnp.int32).reshape(shape)


def _fixed(equation: Any, variables: Sequence[Any], inputs: Sequence[Value]) -> list[jax.Array]:
    """Returns indices, for two environments."""
    if any(x.array is None for x in inputs):
        raise _unsupported(equation, "with indices that depend on the inputs")
    return [jnp.broadcast_to(x.array, _sized(v.aval.shape)) for x, v in zip(inputs, variables, strict=True)]


def _batch_axis(equation: Any, shape: Shape) -> int:
    axes = [i for i, size in enumerate(shape) if export.is_symbolic_dim(size)]
    if len(axes) != 1:
        raise _unsupported(equation, f"of shape {shape}; it must have one batch axis")
    return axes[0]


def _rows(equation: Any, sources: Any, shape: Shape, out_shape: Shape) -> np.ndarray:
    """Returns positions in the source within one environment, -1 for none: `out_shape` without its batch axis.

    Args:
        equation: of a gather or scatter.
        sources: positions in both environments of a source of `shape`, -1 for none, for two environments.
        shape: of the source.
        out_shape: of the result.
    """
    axis, out_axis = _batch_axis(equation, shape), _batch_axis(equation, out_shape)
    own = np.moveaxis(np.asarray(_positions(shape)), axis, 0).reshape(2, -1)
    place = np.full(own.size + 1, -1)
    place[own] = np.arange(own.size).reshape(own.shape)
    first, second = np.moveaxis(place[np.asarray(sources)], out_axis, 0)
    if np.any(np.where(first < 0, -1, first + own.shape[1]) != second):
        raise _unsupported(equation, "between environments")
    return first


def _picked(graph: Graph, equation: Any, x: Value, rows: np.ndarray, out_shape: Shape) -> Value:
    """Returns the numbers of x at positions `rows`, of `out_shape`."""
    axis, out_axis = _batch_axis(equation, x.shape), _batch_axis(equation, out_shape)
    batch, rest = x.shape[axis], [n for i, n in enumerate(x.shape) if i != axis]
    if any(n != 1 for n in x.shape[:axis]):
        x = graph.transpose(x, (axis, *(i for i in range(len(x.shape)) if i != axis)))
    if not np.array_equal(rows.reshape(-1), np.arange(math.prod(rest))):
        x = graph.reshape(x, (batch, math.prod(rest)))
        x = graph.op("Gather", x, constant(rows.reshape(-1), np.int64), shape=(batch, rows.size), axis=1)
    moved = (batch, *rows.shape)
    if any(n != 1 for n in out_shape[:out_axis]):
        order = [*range(1, out_axis + 1), 0, *range(out_axis + 1, len(moved))]
        return graph.transpose(graph.reshape(x, moved), order)
    return graph.reshape(x, out_shape)


@rule("gather", "dynamic_slice")
def _gather(graph: Graph, equation: Any, x: Value, *indices: Value) -> Value:
    own, out_shape = equation.invars[0].aval.shape, equation.outvars[0].aval.shape
    fixed = _fixed(equation, equation.invars[1:], indices)
    params = {name: _sized(value) for name, value in equation.params.items()}
    sources = np.asarray(equation.primitive.bind(_positions(own), *fixed, **params))
    if np.any(sources < 0):
        raise _unsupported(equation, "with indices out of bounds")
    rows = _rows(equation, sources, own, out_shape)
    return _picked(graph, equation, graph.full(x, own), rows, out_shape)


@rule("dynamic_update_slice", "scatter", "scatter-add", "scatter_add")
def _scatter(graph: Graph, equation: Any, x: Value, *others: Value) -> Value:
    name, shape = equation.primitive.name.replace("_", "-"), equation.outvars[0].aval.shape
    none = jnp.full(_sized(shape), -1, jnp.int32)
    new, own = (others[0], equation.invars[1]) if name.startswith("dynamic") else (others[1], equation.invars[2])
    positions = _positions(own.aval.shape)
    if name == "dynamic-update-slice":
        sources = jax.lax.dynamic_update_slice(none, positions, _fixed(equation, equation.invars[2:], others[1:]))
    else:
        (indices,), p = _fixed(equation, equation.invars[1:2], others[:1]), equation.params
        sources = jax.lax.scatter(none, indices, positions, p["dimension_numbers"], mode=p["mode"])
        if np.sum(np.asarray(sources) >= 0) != positions.size:
            raise _unsupported(equation, "with repeated indices or indices out of bounds")
    rows = _rows(equation, sources, own.aval.shape, shape)
    picked = _picked(graph, equation, graph.full(new, own.aval.shape), np.maximum(rows, 0), shape)
    picked = graph.op("Add", x, picked) if name == "scatter-add" else picked
    changed = constant(np.expand_dims(rows >= 0, _batch_axis(equation, shape)))
    return picked if np.all(rows >= 0) else graph.op("Where", changed, picked, x)
