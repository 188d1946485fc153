"""Network layers as `init` / `apply` pairs over nested dicts of arrays."""

import math
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp

from mqe_jax.core.types import Params

PRECISION = "highest"
"""Precision of matrix products: with full float32, results do not depend on the GPU model."""


def orthogonal(key: jax.Array, shape: tuple[int, int], scale: float) -> jax.Array:
    """Samples a matrix with orthonormal rows or columns, whichever are fewer, times `scale`.

    Shapes: (n_in, n_out) float32. Source: Saxe et al., arXiv 1312.6120.
    """
    rows, columns = shape
    normal = jax.random.normal(key, (max(shape), min(shape)), jnp.float32)

    def add_column(j: jax.Array, q: jax.Array) -> jax.Array:
        column = normal[:, j]
        for _ in range(2):  # the second pass removes rounding errors
            column = column - jnp.matmul(
                q, jnp.matmul(column, q, precision=PRECISION), precision=PRECISION
            )
        return q.at[:, j].set(column / jnp.linalg.norm(column))

    # Gram-Schmidt in place of jnp.linalg.qr, which can deadlock on a CPU with few cores: LAPACK
    # decompositions run concurrently in XLA's threads, and each waits for a free one.
    q = jax.lax.fori_loop(0, min(shape), add_column, jnp.zeros_like(normal))
    return scale * (q if rows >= columns else q.T)


def dense_init(key: jax.Array, n_in: int, n_out: int, scale: float = math.sqrt(2.0)) -> Params:
    """Initialises an affine layer: orthogonal weight of gain `scale`, zero bias.

    Shapes: weight (n_in, n_out), bias (n_out,).
    """
    return {
        "weight": orthogonal(key, (n_in, n_out), scale),
        "bias": jnp.zeros((n_out,), jnp.float32),
    }


def dense(params: Params, x: jax.Array, *, precision: str | None = PRECISION) -> jax.Array:
    """Applies an affine layer to the last axis: (..., n_in) -> (..., n_out)."""
    return jnp.matmul(x, params["weight"], precision=precision) + params["bias"]


def mlp_init(key: jax.Array, sizes: Sequence[int], *, final_scale: float = 1.0) -> Params:
    """Initialises affine layers `"0"`, `"1"`, ... of shapes (sizes[i], sizes[i + 1]).

    The last layer has the gain `final_scale`.
    """
    count = len(sizes) - 1
    keys = jax.random.split(key, count)
    gains = [math.sqrt(2.0)] * (count - 1) + [final_scale]
    return {str(i): dense_init(keys[i], sizes[i], sizes[i + 1], gains[i]) for i in range(count)}


def mlp(
    params: Params,
    x: jax.Array,
    activation: Callable[[jax.Array], jax.Array] = jax.nn.relu,
    *,
    activate_last: bool = False,
    precision: str | None = PRECISION,
) -> jax.Array:
    """Applies the layers in order, with `activation` between them.

    Shapes: (..., sizes[0]) -> (..., sizes[-1]). With `activate_last`, the activation follows the
    last layer as well.
    """
    count = len(params)
    for i in range(count):
        x = dense(params[str(i)], x, precision=precision)
        if i < count - 1 or activate_last:
            x = activation(x)
    return x


def layer_norm_init(width: int) -> Params:
    """Initialises a layer normalisation: scale one and shift zero (width,)."""
    return {"scale": jnp.ones((width,)), "shift": jnp.zeros((width,))}


def layer_norm(params: Params, x: jax.Array) -> jax.Array:
    """Normalises the last axis to mean 0 and variance 1, then scales and shifts it.

    Shapes: (..., W) -> (..., W). Source: Ba et al., arXiv 1607.06450.
    """
    return _standardize(x) * params["scale"] + params["shift"]


def norm_dense(norm: Params, layer: Params, x: jax.Array) -> jax.Array:
    """Applies a layer normalisation, then an affine layer: (..., n_in) -> (..., n_out).

    Scale and shift join the affine layer, so that they and their gradients cost no pass over the
    batch.
    """
    shift = jnp.matmul(norm["shift"], layer["weight"], precision=PRECISION)
    weight = norm["scale"][:, None] * layer["weight"]
    return dense({"weight": weight, "bias": layer["bias"] + shift}, _standardize(x))


def _standardize(x: jax.Array) -> jax.Array:
    x = x - jnp.mean(x, axis=-1, keepdims=True)
    return x * jax.lax.rsqrt(jnp.mean(jnp.square(x), axis=-1, keepdims=True) + 1e-5)


def gru_init(key: jax.Array, n_in: int, n_hidden: int) -> Params:
    """Initialises a gated recurrent unit.

    Its weights concatenate the gates reset, update and candidate, each orthogonal.
    """
    keys = jax.random.split(key, 6)

    def three_gates(gate_keys: jax.Array, rows: int) -> Params:
        gates = jax.vmap(lambda k: orthogonal(k, (rows, n_hidden), 1.0))(gate_keys)
        weight = jnp.swapaxes(gates, 0, 1).reshape(rows, 3 * n_hidden)
        return {"weight": weight, "bias": jnp.zeros((3 * n_hidden,), jnp.float32)}

    return {"input": three_gates(keys[:3], n_in), "hidden": three_gates(keys[3:], n_hidden)}


def gru(params: Params, h: jax.Array, x: jax.Array) -> jax.Array:
    """Returns the next hidden state: h (..., n_hidden), x (..., n_in) -> (..., n_hidden).

    Source: Cho et al., arXiv 1406.1078, with the reset gate applied after the hidden product.
    """
    reset_x, update_x, candidate_x = jnp.split(dense(params["input"], x), 3, axis=-1)
    reset_h, update_h, candidate_h = jnp.split(dense(params["hidden"], h), 3, axis=-1)
    reset = jax.nn.sigmoid(reset_x + reset_h)
    update = jax.nn.sigmoid(update_x + update_h)
    candidate = jnp.tanh(candidate_x + reset * candidate_h)
    return (1.0 - update) * candidate + update * h


@jax.custom_vjp
def clip_parameter(x: jax.Array, low: float, high: float) -> jax.Array:
    """Clips a parameter to [low, high] with a custom gradient.

    Within the bounds the gradient is that of the identity. Outside, it is passed if a descent step
    reduces the violation and zero if it would increase it.
    """
    return jnp.clip(x, low, high)


def _bounded_forward(
    x: jax.Array, low: float, high: float
) -> tuple[jax.Array, tuple[jax.Array, float, float]]:
    return jnp.clip(x, low, high), (x, low, high)


def _bounded_backward(
    saved: tuple[jax.Array, float, float], gradient: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    x, low, high = saved
    outwards = ((x < low) & (gradient > 0.0)) | ((x > high) & (gradient < 0.0))
    zero = jnp.zeros(())
    return jnp.where(outwards, 0.0, gradient), zero, zero


clip_parameter.defvjp(_bounded_forward, _bounded_backward)
