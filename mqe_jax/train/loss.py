"""Generalised advantage estimation and the elementwise terms of the PPO loss.

The caller averages the terms.
"""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp

_LOG_SQRT_2PI = 0.5 * math.log(2.0 * math.pi)


def log_prob(action: jax.Array, mean: jax.Array, log_std: jax.Array) -> jax.Array:
    """Returns the log-density of a diagonal Gaussian in each dimension (..., D).

    Their sum is the joint log-density.
    """
    z = (action - mean) * jnp.exp(-log_std)
    return -0.5 * jnp.square(z) - log_std - _LOG_SQRT_2PI


def entropy(log_std: jax.Array) -> jax.Array:
    """Returns the entropy of a diagonal Gaussian in each dimension (..., D), nats."""
    return log_std + 0.5 + _LOG_SQRT_2PI


def where_used(values: jax.Array, used: jax.Array | None) -> jax.Array:
    """Returns values of the entries of actions (..., D), 0 at those that do not count."""
    return values if used is None else jnp.where(used, values, 0.0)


def clipped_surrogate(
    log_ratio: jax.Array, advantage: jax.Array, clip: float, dual_clip: float | None = None
) -> jax.Array:
    """Returns the PPO policy loss per element, to be minimised; arguments broadcast.

    loss = -min(ratio A, clip(ratio, 1 - clip, 1 + clip) A), ratio = exp(log_ratio). With
    `dual_clip` c > 1 the loss of a negative advantage is at most c |A|. Source: Schulman et al.,
    arXiv 1707.06347; dual clip: Ye et al., arXiv 1912.09729.
    """
    ratio = jnp.exp(log_ratio)
    objective = jnp.minimum(ratio * advantage, jnp.clip(ratio, 1.0 - clip, 1.0 + clip) * advantage)
    if dual_clip is not None:
        objective = jnp.where(
            advantage < 0.0, jnp.maximum(objective, dual_clip * advantage), objective
        )
    return -objective


def value_loss(
    value: jax.Array,
    old_value: jax.Array,
    target: jax.Array,
    clip: float | None,
    huber_delta: float | None,
) -> jax.Array:
    """Returns the loss of each value: half the squared error, linear beyond `huber_delta`.

    All arrays have the same shape. With `clip`, the loss is the larger of those of `value` and of
    `value` clipped to `old_value` +- clip. Source: Yu et al., arXiv 2103.01955.
    """

    def loss(error: jax.Array) -> jax.Array:
        size = jnp.abs(error)
        half = 0.5 * jnp.square(error)
        if huber_delta is None:
            return half
        return jnp.where(size <= huber_delta, half, huber_delta * (size - 0.5 * huber_delta))

    unclipped = loss(value - target)
    if clip is None:
        return unclipped
    clipped = old_value + jnp.clip(value - old_value, -clip, clip)
    return jnp.maximum(unclipped, loss(clipped - target))


def ratio_per_agent(new: jax.Array, old: jax.Array) -> jax.Array:
    """Returns one log-ratio per agent from log-densities per dimension: (..., A, D) -> (..., A, 1).

    Source: MAPPO, Yu et al., arXiv 2103.01955.
    """
    return jnp.sum(new - old, axis=-1, keepdims=True)


RATIOS: dict[str, Callable[[jax.Array, jax.Array], jax.Array]] = {
    "agent": ratio_per_agent,
    "dimension": lambda new, old: new - old,  # as OpenRL: (..., A, D) -> (..., A, D)
    # JRPO: (..., 1, 1)
    "joint": lambda new, old: jnp.sum(ratio_per_agent(new, old), axis=-2, keepdims=True),
}
"""Log-ratio functions by the name of `ppo.ratio`."""


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
    `next_value[t]` is the value of the state reached by step t, before any reset, so that a
    truncated episode bootstraps from its own last state. `terminated` removes the bootstrap (a
    fraction of it where between 0 and 1); `done` (terminated or truncated) cuts the trace. Source:
    Schulman et al., arXiv 1506.02438.
    """

    # integers would round fractions of a bootstrap
    reward = reward.astype(jnp.result_type(reward, jnp.float32))

    def as_reward(flag: jax.Array) -> jax.Array:
        flag = flag.reshape(flag.shape + (1,) * (reward.ndim - flag.ndim))
        return jnp.broadcast_to(flag, reward.shape).astype(reward.dtype)

    delta = reward + gamma * (1.0 - as_reward(terminated)) * next_value - value
    carry_over = gamma * gae_lambda * (1.0 - as_reward(done))

    def backwards(
        trace: jax.Array, inputs: tuple[jax.Array, jax.Array]
    ) -> tuple[jax.Array, jax.Array]:
        delta_t, carry_over_t = inputs
        trace = delta_t + carry_over_t * trace
        return trace, trace

    _, advantage = jax.lax.scan(
        backwards, jnp.zeros_like(delta[0]), (delta, carry_over), reverse=True, unroll=8
    )
    return advantage, advantage + value
