"""Translates a JAX function to an ONNX graph over a symbolic batch axis, by jax2onnx."""

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import jax2onnx
import numpy as np
import onnx
from jax.extend.core import Jaxpr, Literal
from onnx import TensorProto, helper, numpy_helper

from mqe_jax.core.errors import InputError, one_line

OPSET = 17
BATCH = "N"

Function = Callable[[Mapping[str, Any]], Mapping[str, jax.Array]]
"""A function of arrays by name that returns arrays by name, both of one environment."""


def _select(which: jax.Array, *cases: jax.Array) -> jax.Array:
    if len(cases) == 2 and cases[0].dtype == bool:
        return (which & cases[1]) | (~which & cases[0])
    return jax.lax.select_n(which, *cases)


def _remainder(x: jax.Array, y: jax.Array) -> jax.Array:
    if x.dtype == jnp.float32:
        return x - y * jnp.trunc(x / y)
    return x - y * jax.lax.div(x, y)


REPLACED: dict[str, Callable[..., jax.Array]] = {
    "clamp": lambda low, x, high: jax.lax.min(jax.lax.max(x, low), high),
    "select_n": _select,
    "rem": _remainder,
}
"""Operations that jax2onnx rejects for a symbolic axis, or onnxruntime for some types."""


def translate(
    function: Function,
    inputs: Mapping[str, Sequence[int]],
    name: str,
    properties: Mapping[str, str] | None = None,
) -> onnx.ModelProto:
    """Returns the graph of a function of float32 arrays, batched over a leading axis N.

    Arrays that the function closes over become constants; `inputs` are the shapes of its inputs by
    name, without N, and `properties` the metadata of the model. InputError for an operation that
    jax2onnx cannot translate.
    """
    specs = {key: jax.ShapeDtypeStruct(tuple(shape), np.float32) for key, shape in inputs.items()}

    def copied(values: Mapping[str, Any]) -> Any:
        # An output that is an input would have two names.
        return jax.tree.map(jnp.copy, function(values))

    # Traced here, as jax2onnx replaces functions of jax.numpy while it traces, some of which fail
    # under `vmap`.
    with jax.disable_jit():  # also unrolls scans, in which jax2onnx loses N
        closed, outputs = jax.make_jaxpr(copied, return_shape=True)(specs)

    def evaluate_batch(*values: jax.Array) -> tuple[jax.Array, ...]:
        leaves = jax.tree.leaves(dict(zip(specs, values, strict=True)))
        return tuple(jax.vmap(lambda *x: _evaluate(closed.jaxpr, closed.consts, x))(*leaves))

    arguments = [(BATCH, *spec.shape) for spec in specs.values()]
    names = {"input_names": list(specs), "output_names": sorted(outputs)}
    logging.getLogger("onnx_ir").setLevel(logging.ERROR)
    try:
        model = jax2onnx.to_onnx(evaluate_batch, arguments, model_name=name, opset=OPSET, **names)
    except Exception as error:  # jax2onnx has no exception class
        raise InputError(f"onnx: jax2onnx cannot translate {name} ({one_line(error)})") from error
    _halve(model.graph)
    del model.graph.value_info[:]  # onnxruntime infers them
    helper.set_model_props(model, dict(properties or {}))
    onnx.checker.check_model(model, full_check=True)
    return model


def _evaluate(jaxpr: Jaxpr, constants: Sequence[Any], inputs: Sequence[Any]) -> list[Any]:
    """Evaluates a jaxpr; equations that do not depend on the inputs become constants.

    jax2onnx fails for some of these.
    """
    known = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*constants, *inputs), strict=True))

    def read(variable: Any) -> Any:
        return variable.val if isinstance(variable, Literal) else known[variable]

    for equation in jaxpr.eqns:
        values = [read(v) for v in equation.invars]
        name = equation.primitive.name
        params = equation.params
        inner = params.get("call_jaxpr", params.get("jaxpr"))
        outputs: list[Any] = [v.aval for v in equation.outvars]
        if name == "concatenate":
            values = [x for x in values if x.shape[params["dimension"]]]
        if all(0 in getattr(x, "shape", ()) for x in outputs):  # graphs have no empty arrays
            results = [np.zeros(x.shape, x.dtype) for x in outputs]
        elif inner is not None and name != "reduce":  # whose jaxpr is that of its operator
            consts = getattr(inner, "consts", ())
            results = _evaluate(getattr(inner, "jaxpr", inner), consts, values)
        elif not any(isinstance(x, jax.core.Tracer) for x in values):
            with jax.ensure_compile_time_eval():
                results = equation.primitive.bind(*values, **params)
        elif name in REPLACED:
            results = REPLACED[name](*values)
        else:
            results = equation.primitive.bind(*values, **params)
        if not isinstance(results, list | tuple):
            results = [results]
        known.update(zip(equation.outvars, results, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _halve(graph: onnx.GraphProto) -> None:
    """Stores large constants as float16, with a cast, if that represents them exactly."""
    for stored in graph.initializer:
        array = numpy_helper.to_array(stored)
        if array.dtype != np.float32 or array.size <= 1000:
            continue
        half = array.astype(np.float16)
        if np.array_equal(half, array):
            whole = stored.name
            stored.CopyFrom(numpy_helper.from_array(half, f"{whole}_half"))
            cast = helper.make_node("Cast", [stored.name], [whole], to=TensorProto.FLOAT)
            graph.node.insert(0, cast)
