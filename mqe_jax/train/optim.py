"""The optimiser: Adam with clipping by global norm, as an `init` / `update` pair."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from mqe_jax.core.types import PyTree

# decays of the moments
_B1 = 0.9
_B2 = 0.999


class AdamState(NamedTuple):
    """First and second moments (shaped as the parameters) and the number of updates, () int32."""

    mean: PyTree
    square: PyTree
    updates: jax.Array


class Optimizer(NamedTuple):
    """An optimiser as two functions.

    `init(params)` returns its state. `update(grads, state, params, learning_rate)` returns params,
    state and the norm of the gradients.
    """

    init: Callable[[PyTree], AdamState]
    update: Callable[
        [PyTree, AdamState, PyTree, jax.Array | float], tuple[PyTree, AdamState, jax.Array]
    ]


def restart(state: AdamState, when: jax.Array | bool) -> AdamState:
    """Returns the initial state if `when` is true, else the state itself.

    After updates with gradients of 0, without corrections of the moments, the first real steps
    would be too long.
    """
    return (
        state
        if when is False
        else jax.tree.map(lambda x: jnp.where(when, jnp.zeros_like(x), x), state)
    )


def adam(eps: float = 1e-5, max_grad_norm: float | None = None) -> Optimizer:
    """Returns Adam with gradients clipped to a global norm of at most `max_grad_norm`.

    `grad_norm` is the norm before clipping. Source: Kingma and Ba, arXiv 1412.6980.
    """

    def init(params: PyTree) -> AdamState:
        return AdamState(
            mean=jax.tree.map(jnp.zeros_like, params),
            square=jax.tree.map(jnp.zeros_like, params),
            updates=jnp.zeros((), jnp.int32),
        )

    def update(
        grads: PyTree, state: AdamState, params: PyTree, learning_rate: jax.Array | float
    ) -> tuple[PyTree, AdamState, jax.Array]:
        squares = (jnp.sum(jnp.square(leaf)) for leaf in jax.tree.leaves(grads))
        grad_norm = jnp.sqrt(sum(squares, jnp.float32(0.0)))
        if max_grad_norm is not None:
            scale = jnp.minimum(1.0, max_grad_norm / jnp.maximum(grad_norm, 1e-12))
            grads = jax.tree.map(lambda g: g * scale, grads)
        updates = state.updates + 1
        steps = updates.astype(jnp.float32)
        mean = jax.tree.map(lambda m, g: _B1 * m + (1.0 - _B1) * g, state.mean, grads)
        square = jax.tree.map(
            lambda s, g: _B2 * s + (1.0 - _B2) * jnp.square(g), state.square, grads
        )
        mean_scale = 1.0 / (1.0 - _B1**steps)
        square_scale = 1.0 / (1.0 - _B2**steps)

        def move(p: jax.Array, m: jax.Array, s: jax.Array) -> jax.Array:
            return p - learning_rate * (m * mean_scale) / (jnp.sqrt(s * square_scale) + eps)

        params = jax.tree.map(move, params, mean, square)
        return params, AdamState(mean, square, updates), grad_norm

    return Optimizer(init, update)
