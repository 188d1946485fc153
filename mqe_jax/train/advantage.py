"""Generalised advantage estimation with separate termination and truncation."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def gae(
    reward: jax.Array,
    value: jax.Array,
    next_value: jax.Array,
    terminated: jax.Array,
    done: jax.Array,
    *,
    gamma: float,
    gae_lambda: float,
) -> tuple[jax.Array, jax.Array]:
    """Returns the advantage and the value target, both shaped as `reward`.

    Shapes: time-major (T, ...); `terminated` and `done` (bool) may lack trailing axes of `reward`.
    `next_value[t]` is the value of the state reached by step t, before any reset, so that a truncated episode
    bootstraps from its own last state. `terminated` removes the bootstrap (a fraction of it where between 0 and 1);
    `done` (terminated or truncated) cuts the trace. Source: Schulman et al., arXiv 1506.02438.
    """

    reward = reward.astype(jnp.result_type(reward, jnp.float32))  # integers would round fractions of a bootstrap

    def as_reward(flag: jax.Array) -> jax.Array:
        flag = flag.reshape(flag.shape + (1,) * (reward.ndim - flag.ndim))
        return jnp.broadcast_to(flag, reward.shape).astype(reward.dtype)

    delta = reward + gamma * (1.0 - as_reward(terminated)) * next_value - value
    carry_over = gamma * gae_lambda * (1.0 - as_reward(done))

    def backwards(trace: jax.Array, inputs: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        delta_t, carry_over_t = inputs
        trace = delta_t + carry_over_t * trace
        return trace, trace

    _, advantage = jax.lax.scan(backwards, jnp.zeros_like(delta[0]), (delta, carry_over), reverse=True, unroll=8)
    return advantage, advantage + value
