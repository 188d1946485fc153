"""Translations of gathers and scatters to ONNX nodes, for indices that do not depend on the inputs.

They move numbers within each environment. The operation itself, applied to the positions of the numbers of two
environments, defines from where to where.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from mqe_jax.export.graph import Graph, Shape, Value, constant
from mqe_jax.export.operations import Rule, unsupported


def _sized(value: Any) -> Any:
    """Replaces symbolic dimensions in a shape by 2; returns other parameters as they are."""
    return tuple(2 if export.is_symbolic_dim(n) else n for n in value) if type(value) is tuple else value


def _positions(shape: Shape) -> jax.Array:
    """The position of each number of two environments' arrays."""
    shape = _sized(shape)
    return jnp.arange(math.prod(shape), dtype=jnp.int32).reshape(shape)


def _fixed(equation: Any, variables: Sequence[Any], inputs: Sequence[Value]) -> list[jax.Array]:
    """Returns indices, for two environments."""
    arrays = [x.array for x in inputs if x.array is not None]
    if len(arrays) < len(inputs):
        raise unsupported(equation, "with indices that depend on the inputs")
    return [jnp.broadcast_to(x, _sized(v.aval.shape)) for x, v in zip(arrays, variables, strict=True)]


def _batch_axis(equation: Any, shape: Shape) -> int:
    axes = [i for i, size in enumerate(shape) if export.is_symbolic_dim(size)]
    if len(axes) != 1:
        raise unsupported(equation, f"of shape {shape}; it must have one batch axis")
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
        raise unsupported(equation, "between environments")
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


def _gather(graph: Graph, equation: Any, x: Value, *indices: Value) -> Value:
    own, out_shape = equation.invars[0].aval.shape, equation.outvars[0].aval.shape
    fixed = _fixed(equation, equation.invars[1:], indices)
    params = {name: _sized(value) for name, value in equation.params.items()}
    sources = np.asarray(equation.primitive.bind(_positions(own), *fixed, **params))
    if np.any(sources < 0):
        raise unsupported(equation, "with indices out of bounds")
    rows = _rows(equation, sources, own, out_shape)
    return _picked(graph, equation, graph.full(x, own), rows, out_shape)


def _scatter(graph: Graph, equation: Any, x: Value, *others: Value) -> Value:
    name, shape, params = equation.primitive.name, equation.outvars[0].aval.shape, equation.params
    none = jnp.full(_sized(shape), -1, jnp.int32)
    update = 0 if name == "dynamic_update_slice" else 1
    new, own = others[update], equation.invars[1 + update]
    positions = _positions(own.aval.shape)
    if name == "dynamic_update_slice":
        sources = jax.lax.dynamic_update_slice(none, positions, _fixed(equation, equation.invars[2:], others[1:]))
    else:
        (indices,) = _fixed(equation, equation.invars[1:2], others[:1])
        sources = jax.lax.scatter(none, indices, positions, params["dimension_numbers"], mode=params["mode"])
        if np.sum(np.asarray(sources) >= 0) != positions.size:
            raise unsupported(equation, "with repeated indices or indices out of bounds")
    rows = _rows(equation, sources, own.aval.shape, shape)
    picked = _picked(graph, equation, graph.full(new, own.aval.shape), np.maximum(rows, 0), shape)
    picked = graph.op("Add", x, picked) if name == "scatter-add" else picked
    changed = constant(np.expand_dims(rows >= 0, _batch_axis(equation, shape)))
    return picked if np.all(rows >= 0) else graph.op("Where", changed, picked, x)


RULES: dict[str, Rule] = {
    **dict.fromkeys(("gather", "dynamic_slice"), _gather),
    **dict.fromkeys(("dynamic_update_slice", "scatter", "scatter-add"), _scatter),
}
