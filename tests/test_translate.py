"""Translation of JAX functions to ONNX: each operation in onnxruntime against JAX."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from mqe_jax.errors import InputError

pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")

from mqe_jax.export import translate  # noqa: E402

INDEX = np.array([[2, 0], [4, 2]])
WEIGHT = np.linspace(-1.0, 1.0, 20, dtype=np.float32).reshape(5, 4)


def run(function: Any, inputs: dict[str, np.ndarray], most_nodes: int | None = None) -> dict[str, np.ndarray]:
    """Returns the outputs of the translated function."""
    model = translate.translate(function, {name: x.shape[1:] for name, x in inputs.items()}, "test")
    assert most_nodes is None or len(model.graph.node) <= most_nodes, [node.op_type for node in model.graph.node]
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    return dict(zip(names, session.run(names, inputs), strict=True))


def agree(function: Any, inputs: dict[str, np.ndarray]) -> None:
    """Checks values, shapes and types against JAX."""
    expected, found = jax.device_get(jax.jit(function)(inputs)), run(function, inputs)
    assert expected.keys() == found.keys()
    for name, value in expected.items():
        assert (found[name].shape, found[name].dtype) == (value.shape, value.dtype), name
        np.testing.assert_allclose(found[name], value, rtol=2e-6, atol=2e-6, err_msg=name)


def each(functions: Any, *values: Any, prefix: str = "") -> dict[str, jax.Array]:
    """Applies functions to the same values; results by their names."""
    return {prefix + function.__name__: function(*values) for function in functions}


def elementwise(given: dict[str, jax.Array]) -> dict[str, jax.Array]:
    x, y = given["x"], given["y"]
    unit, positive, whole = jnp.tanh(x), jnp.abs(x) + 0.1, jnp.floor(4.0 * x).astype(jnp.int32)
    functions = (jnp.abs, jnp.ceil, jnp.cos, jnp.cosh, jnp.exp, jnp.floor, jnp.negative, jnp.sign, jnp.sin, jnp.sinh)
    functions += (jnp.tan, jnp.tanh, jnp.arctan, jnp.arcsinh, jnp.expm1, jnp.square, jnp.round, jnp.isfinite)
    functions += (jax.nn.relu, jax.nn.elu, jax.nn.sigmoid, jax.nn.silu, jax.scipy.special.erf, jax.scipy.special.erfc)
    functions += (lax.stop_gradient, jnp.copy, jnp.array)
    pairs = (jnp.add, jnp.subtract, jnp.multiply, jnp.divide, jnp.maximum, jnp.minimum, jnp.arctan2, lax.rem, jnp.mod)
    pairs += (jnp.equal, jnp.not_equal, jnp.less, jnp.less_equal, jnp.greater, jnp.greater_equal)
    return {
        **each(functions, x),
        **each((jnp.log, jnp.log1p, jnp.sqrt, lax.rsqrt), positive),
        **each((jnp.arccos, jnp.arcsin, jnp.arctanh), 0.9 * unit),
        **each(pairs, x, y),
        **each((*pairs[:3], lax.rem), whole, 3, prefix="int_"),
        **each((jnp.logical_and, jnp.logical_or, jnp.logical_xor), x > 0, y > 0),
        "logical_not": ~(x > 0),
        "arccosh": jnp.arccosh(1.0 + positive),
        "power": positive**y,
        "cube": x**3,
        "inverse_square": positive**-2,
        "gelu": jax.nn.gelu(x, approximate=False),
        "softplus": jax.nn.softplus(x),
        "clamp": lax.clamp(-0.5, x, 0.5),
        "clip": jnp.clip(x, -WEIGHT[:, 0], WEIGHT[:, 3]),
        "nan_to_num": jnp.nan_to_num(x / jnp.round(x)),
        "quadrants": jnp.arctan2(*(jnp.where(jnp.abs(v) < 0.7, 0.0, v) for v in (x, y))),
        "truncated": (3.0 * x).astype(jnp.int32),
        "where": jnp.where(x > y, x, 0.0),
        "where_bool": jnp.where(x > y, x > 0, y > 0),
        "select": lax.select_n(jnp.clip(whole, 0, 2), x, y, x + y),
        "piecewise": jnp.select([x > 1.0, x > 0.0], [x, 2.0 * x], 3.0),
    }


def movement(given: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """Shapes (N, 5) and (N, 3, 5), indices that do not depend on the inputs."""
    x, z = given["x"], given["z"]
    return {
        "reshape": z.reshape(-1, 15),
        "merged": z.reshape(-1, 5),
        "transpose": jnp.swapaxes(z, 0, 2),
        "expand": z[:, None, :, None],
        "squeeze": jnp.squeeze(z[:, 1:2], 1),
        "broadcast": jnp.broadcast_to(x[:, None], z.shape),
        "constant_rows": jnp.broadcast_to(jnp.arange(5.0), x.shape),
        "concatenate": jnp.concatenate([x, z[:, 0], jnp.ones_like(x)], axis=-1),
        "stack": jnp.stack([x, 2.0 * x], axis=1),
        "split": jnp.split(z, [1], axis=1)[1],
        "slice": z[:, 1:, 4:0:-2],
        "slice_strided": lax.slice(x, (0, 1), (x.shape[0], 5), (1, 2)),
        "rev": z[:, ::-1],
        "tile": jnp.tile(x, (1, 2)),
        "pad": jnp.pad(z, ((0, 0), (1, 0), (0, 2)), constant_values=3.0),
        "gather": x[:, INDEX],
        "gather_rows": z[:, INDEX[0]],
        "gather_pairs": z[:, INDEX[0], INDEX[1]],
        "gather_moved": jnp.moveaxis(z, 0, 2)[INDEX[0]],
        "gather_mapped": jax.vmap(lambda row: row[INDEX[1]])(x),
        "gather_each": jax.vmap(lambda i, row: row[:, i], in_axes=(0, 1), out_axes=1)(INDEX[:, 0], z[:, :2]),
        "dynamic_slice": lax.dynamic_slice(x, (0, 2), (x.shape[0], 2)),
        "dynamic_update_slice": lax.dynamic_update_slice(x, 2.0 * x[:, :2], (0, 3)),
        "set": z.at[:, :, INDEX[0]].set(1.0),
        "set_all": x.at[:, jnp.array([3, 1, 2, 0, 4])].set(z[:, 0]),
        "add": x.at[:, INDEX[0]].add(z[:, 0, :2]),
        "add_to_constant": jax.vmap(lambda row: jnp.zeros(7).at[INDEX[0]].add(row[:2]))(x),
    }


def reductions(given: dict[str, jax.Array]) -> dict[str, jax.Array]:
    x, z = given["x"], given["z"]
    heads = jnp.stack([jnp.asarray(WEIGHT), 2.0 * WEIGHT, 3.0 * WEIGHT])
    return {
        **each((jnp.sum, jnp.prod, jnp.max, jnp.min, jnp.argmax, jnp.argmin, jnp.mean), z, 1),
        "mean_over_batch": x - jnp.mean(x, axis=0),
        "any": jnp.any(z > 0.5, axis=(1, 2)),
        "all": jnp.all(z > -0.5, axis=1),
        "norm": jnp.linalg.norm(z, axis=-1),
        "sum_of_broadcast": jnp.sum(jnp.broadcast_to(x[:, None], z.shape), axis=1),
        "softmax": jax.nn.softmax(z, axis=-1),
        "logsumexp": jax.nn.logsumexp(z, axis=(1, 2)),
        "matmul": z @ WEIGHT,
        "matrix_of_each_agent": jnp.einsum("nac,acf->naf", z, heads),
        "vmapped": jax.vmap(jnp.matmul, in_axes=(1, 0), out_axes=1)(z, heads),
        "batched": z @ jnp.swapaxes(z, 1, 2),
        "dot": jnp.einsum("nac,nc->na", z, x),
        "outer": jnp.einsum("na,nb->nab", x, x),
        "weight_first": jnp.einsum("cf,nac->fna", WEIGHT, z),
        "twice": jnp.tensordot(z, heads, axes=([1, 2], [0, 1])),
    }


def control_flow(given: dict[str, jax.Array]) -> dict[str, jax.Array]:
    x, z = given["x"], given["z"]

    def step(carry: jax.Array, row: jax.Array) -> tuple[jax.Array, jax.Array]:
        carry = 0.5 * carry + row
        return carry, carry[:, :2]

    rows = jnp.swapaxes(z, 0, 1)
    last, each = lax.scan(step, x, rows)
    _, backwards = lax.scan(step, jnp.zeros_like(x), rows, reverse=True)
    counted = lax.fori_loop(0, 4, lambda i, y: jnp.where(i % 2 == 0, y + x, 2.0 * y), x)
    return {"last": last, "each": each, "backwards": backwards, "counted": counted, "nested": jax.jit(jax.nn.relu)(x)}


def given(batch: int) -> dict[str, np.ndarray]:
    random = np.random.default_rng(0)
    shapes = {"x": (5,), "y": (5,), "z": (3, 5)}
    return {name: 1.5 * random.normal(size=(batch, *shape)).astype(np.float32) for name, shape in shapes.items()}


def test_every_rule_computes_what_jax_computes(monkeypatch: pytest.MonkeyPatch) -> None:
    used = set()

    class Recorded(dict[str, Any]):
        def __getitem__(self, name: str) -> Any:
            used.add(name)
            return super().__getitem__(name)

    monkeypatch.setattr(translate, "RULES", Recorded(translate.RULES))
    for function in (elementwise, movement, reductions, control_flow):
        agree(function, given(4))
    assert used == set(translate.RULES)


def test_constants_are_evaluated_and_unused_operations_omitted() -> None:
    def function(inputs: dict[str, jax.Array]) -> dict[str, jax.Array]:
        unused = lax.sort(inputs["x"])
        scale = jnp.linalg.norm(jnp.asarray(WEIGHT), axis=0) + 0.0 * unused.shape[1]
        return {"y": inputs["x"] @ (WEIGHT * scale), "again": inputs["x"] @ (WEIGHT * scale)}

    inputs = {"x": given(2)["x"]}
    found = run(function, inputs, most_nodes=3)  # a product, two outputs
    np.testing.assert_allclose(found["y"], jax.jit(function)(inputs)["y"], rtol=1e-5)
    np.testing.assert_array_equal(found["y"], found["again"])


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (lambda x: lax.sort(x), "'sort' has no translation; allowed: abs, "),
        (lambda x: x[:, jnp.max(x).astype(int)], "'gather' has no translation with indices that depend"),
        (lambda x: lax.dynamic_slice(x, (0, 0), (1, 5)), "'dynamic_slice' has no translation of shape"),
        (lambda x: lax.while_loop(lambda y: y[0, 0] < 9.0, lambda y: y + 1.0, x), "'while' has no translation"),
        (lambda x: lax.round(x), "'round' has no translation for halves away from zero"),
        (lambda x: x.at[:, jnp.array([1, 1])].add(1.0), "'scatter-add' has no translation with repeated indices"),
        (lambda x: x.astype(int) & 3, "'and' has no translation for integers"),
    ],
)
def test_what_has_no_translation_is_named(function: Any, words: str) -> None:
    with pytest.raises(InputError, match=words):
        translate.translate(lambda inputs: {"y": function(inputs["x"])}, {"x": (5,)}, "test")
