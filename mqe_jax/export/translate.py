"""Translates a JAX function to an ONNX graph: its jaxpr, equation by equation, over a symbolic batch axis.

Equations that do not depend on the inputs are evaluated at once, those without effect on the outputs omitted, calls
inlined and scans unrolled. The rules of `operations` and `indexing` translate the others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import onnx
from jax import export
from jax.extend.core import Jaxpr, Literal

from mqe_jax.errors import InputError
from mqe_jax.export import indexing, operations
from mqe_jax.export.graph import BATCH, Graph, Value, constant, is_static

Function = Callable[[Mapping[str, Any]], Mapping[str, jax.Array]]
"""A function of arrays by name (N, ...) that returns arrays by name."""
RULES = operations.RULES | indexing.RULES

_CALLS = ("jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call", "checkpoint", "remat2")
_NEVER_EVALUATED = ("broadcast_in_dim", "dim_as_value")  # their rules do without repeated constants and without N


def translate(
    function: Function, inputs: Mapping[str, Sequence[int]], name: str, properties: Mapping[str, str] | None = None
) -> onnx.ModelProto:
    """Returns the graph of a function of float32 arrays.

    Args:
        function: traceable by JAX; arrays that it closes over become constants.
        inputs: shapes of its inputs by name, without the leading batch axis N.
        name: of the graph.
        properties: metadata of the model.

    Raises:
        InputError: for an operation without a translation; the message names it.
    """
    (batch,) = export.symbolic_shape(BATCH)
    specs = {key: jax.ShapeDtypeStruct((batch, *shape), jnp.float32) for key, shape in inputs.items()}
    closed, outputs = jax.make_jaxpr(function, return_shape=True)(specs)
    graph = Graph(name)
    given = {key: graph.input(key, spec.shape) for key, spec in specs.items()}
    results = _run(graph, *_inner(closed), jax.tree.leaves(given))
    for key, value in jax.tree.unflatten(jax.tree.structure(outputs), results).items():
        graph.output(key, value, outputs[key].shape, outputs[key].dtype)
    return graph.model(properties or {})


def _run(graph: Graph, jaxpr: Jaxpr, constants: Sequence[Value], inputs: Sequence[Value]) -> list[Value]:
    """Adds the nodes of a jaxpr; returns its outputs."""
    known: dict[Any, Value] = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*constants, *inputs), strict=True))

    def read(variable: Any) -> Value:
        if not isinstance(variable, Literal):
            return known[variable]
        kind: Any = variable.aval
        return constant(variable.val, kind.dtype)

    for equation in _needed(jaxpr):
        outputs = _equation(graph, equation, [read(variable) for variable in equation.invars])
        known.update(zip(equation.outvars, outputs, strict=True))
    return [read(variable) for variable in jaxpr.outvars]


def _needed(jaxpr: Jaxpr) -> list[Any]:
    """Returns the equations that the outputs depend on."""
    needed, kept = {v for v in jaxpr.outvars if not isinstance(v, Literal)}, []
    for equation in reversed(jaxpr.eqns):
        if needed.intersection(equation.outvars):
            kept.append(equation)
            needed.update(v for v in equation.invars if not isinstance(v, Literal))
    return kept[::-1]


def _equation(graph: Graph, equation: Any, inputs: list[Value]) -> Sequence[Value]:
    name, params = equation.primitive.name, equation.params
    if name in _CALLS:
        return _run(graph, *_inner(params["call_jaxpr"] if "call_jaxpr" in params else params["jaxpr"]), inputs)
    if name == "scan":
        return _scan(graph, equation, inputs)
    arrays = [x.array for x in inputs if x.array is not None]
    static = all(is_static(v.aval.shape) for v in (*equation.invars, *equation.outvars))
    if len(arrays) == len(inputs) and static and name not in _NEVER_EVALUATED:
        full = [jnp.broadcast_to(x, v.aval.shape) for x, v in zip(arrays, equation.invars, strict=True)]
        results = equation.primitive.bind(*full, **params)
        return [constant(x) for x in (results if equation.primitive.multiple_results else [results])]
    if name not in RULES:
        raise InputError(f"onnx: the JAX operation {name!r} has no translation; allowed: {', '.join(sorted(RULES))}")
    results = RULES[name](graph, equation, *inputs)
    return [results] if isinstance(results, Value) else results


def _scan(graph: Graph, equation: Any, inputs: list[Value]) -> list[Value]:
    """Adds the nodes of every step of a scan."""
    length, body, consts = equation.params["length"], *_inner(equation.params["jaxpr"])
    # Constants and carry have the same rank within the body, rows and outputs of a step one axis less.
    rows = sum(inner.aval.ndim < outer.aval.ndim for inner, outer in zip(body.invars, equation.invars, strict=True))
    carries = sum(
        inner.aval.ndim == outer.aval.ndim for inner, outer in zip(body.outvars, equation.outvars, strict=True)
    )
    start = len(inputs) - rows
    fixed, carry = inputs[: start - carries], inputs[start - carries : start]
    steps: list[list[Value]] = [[] for _ in range(length)]
    for i in reversed(range(length)) if equation.params["reverse"] else range(length):
        results = _run(graph, body, consts, [*fixed, *carry, *(operations.item(graph, x, i) for x in inputs[start:])])
        carry, steps[i] = results[:carries], results[carries:]
    columns = zip(zip(*steps, strict=True), equation.outvars[carries:], strict=True)
    return [*carry, *(operations.stacked(graph, x, variable.aval.shape, 0) for x, variable in columns)]


def _inner(jaxpr: Any) -> tuple[Any, list[Value]]:
    """Returns the jaxpr of a call, closed or not, and its constants."""
    return getattr(jaxpr, "jaxpr", jaxpr), [constant(x) for x in getattr(jaxpr, "consts", ())]
