"""Running statistics: of observations over everything seen, of value targets over the recent past."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

_MIN_STD = 1e-2


class RunningStatistics(NamedTuple):
    """Mean and variance (size,) of all samples so far and their number () float32."""

    mean: jax.Array
    variance: jax.Array
    samples: jax.Array


def running_init(size: int) -> RunningStatistics:
    """Makes statistics that leave the data as it is until the first update."""
    return RunningStatistics(jnp.zeros((size,)), jnp.ones((size,)), jnp.zeros(()))


def running_update(statistics: RunningStatistics, batch: jax.Array) -> RunningStatistics:
    """Merges a batch (..., size) into the statistics; all leading axes are samples.

    Source: Chan, Golub and LeVeque 1979, the parallel form of Welford's algorithm.
    """
    batch = batch.reshape(-1, batch.shape[-1])
    batch_samples = jnp.float32(batch.shape[0])
    batch_mean = jnp.mean(batch, axis=0)
    batch_variance = jnp.mean(jnp.square(batch - batch_mean), axis=0)
    samples = statistics.samples + batch_samples
    share = batch_samples / samples
    shift = batch_mean - statistics.mean
    mean = statistics.mean + shift * share
    variance = statistics.variance * (1.0 - share) + batch_variance * share + jnp.square(shift) * share * (1.0 - share)
    return RunningStatistics(mean, variance, samples)


def running_normalize(statistics: RunningStatistics, x: jax.Array, limit: float = 10.0) -> jax.Array:
    """Returns x (..., size) with mean 0 and deviation 1, kept within +-limit.

    Deviations count as at least 0.01, so that a constant entry becomes 0 and not noise.
    """
    std = jnp.maximum(jnp.sqrt(statistics.variance), _MIN_STD)
    return jnp.clip((x - statistics.mean) / std, -limit, limit)


class ValueStatistics(NamedTuple):
    """Exponential averages of value targets () and of their squares (), and the weight () gathered so far."""

    mean: jax.Array
    square: jax.Array
    weight: jax.Array


def value_init() -> ValueStatistics:
    """Makes statistics that leave values as they are until the first update."""
    return ValueStatistics(jnp.zeros(()), jnp.zeros(()), jnp.zeros(()))


def value_update(statistics: ValueStatistics, target: jax.Array, decay: float) -> ValueStatistics:
    """Moves the averages towards a rollout's targets, of any shape; the start is debiased by the weight.

    Source: Yu et al., arXiv 2103.01955 (there with decay 0.99999 per minibatch; here per rollout).
    """
    mean = decay * statistics.mean + (1.0 - decay) * jnp.mean(target)
    square = decay * statistics.square + (1.0 - decay) * jnp.mean(jnp.square(target))
    weight = decay * statistics.weight + (1.0 - decay)
    return ValueStatistics(mean, square, weight)


def _value_moments(statistics: ValueStatistics) -> tuple[jax.Array, jax.Array]:
    """Returns mean and deviation, 0 and 1 before the first update."""
    seen = statistics.weight > 0.0
    weight = jnp.where(seen, statistics.weight, 1.0)
    mean = statistics.mean / weight
    variance = statistics.square / weight - jnp.square(mean)
    std = jnp.sqrt(jnp.maximum(variance, _MIN_STD**2))
    return jnp.where(seen, mean, 0.0), jnp.where(seen, std, 1.0)


def value_normalize(statistics: ValueStatistics, value: jax.Array) -> jax.Array:
    """Returns a value in units of reward as the network is to give it."""
    mean, std = _value_moments(statistics)
    return (value - mean) / std


def value_denormalize(statistics: ValueStatistics, value: jax.Array) -> jax.Array:
    """Returns what the network gave in units of reward."""
    mean, std = _value_moments(statistics)
    return value * std + mean
