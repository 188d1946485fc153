"""Running statistics: of all observations, and exponentially averaged ones of value targets."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from mqe_jax.core import devices

_OBSERVATION_MIN_STD = 1e-2
_VALUE_MIN_STD = 1e-3  # of the root mean square
_TINY = 1e-12


class RunningStatistics(NamedTuple):
    """Mean and variance (size,) of all samples so far and their number () float32."""

    mean: jax.Array
    variance: jax.Array
    samples: jax.Array


def running_init(size: int) -> RunningStatistics:
    """Returns statistics that leave data unchanged until the first update."""
    return RunningStatistics(jnp.zeros((size,)), jnp.ones((size,)), jnp.zeros(()))


def running_update(statistics: RunningStatistics, batch: jax.Array, active: jax.Array) -> RunningStatistics:
    """Merges the samples (..., size) of a batch that are active (...) bool into the statistics.

    Source: Chan, Golub and LeVeque 1979, the parallel form of Welford's algorithm.
    """
    batch = batch.reshape(math.prod(batch.shape[:-1]), batch.shape[-1])
    mask = jnp.broadcast_to(active.reshape(-1, 1), batch.shape)
    batch_samples = devices.total(jnp.sum(active.astype(jnp.float32)))
    batch_mean = devices.mean_where(batch, mask, axis=0)
    batch_variance = devices.variance(batch, mask, axis=0)
    samples = statistics.samples + batch_samples
    fraction = batch_samples / jnp.maximum(samples, 1.0)
    shift = batch_mean - statistics.mean
    mean = statistics.mean + shift * fraction
    variance = (
        statistics.variance * (1.0 - fraction)
        + batch_variance * fraction
        + jnp.square(shift) * fraction * (1.0 - fraction)
    )
    return RunningStatistics(mean, variance, samples)


def running_normalize(statistics: RunningStatistics, x: jax.Array) -> jax.Array:
    """Returns x (..., size) normalised to mean 0 and deviation 1, clipped to +-10; constant entries become 0."""
    std = jnp.maximum(jnp.sqrt(statistics.variance), _OBSERVATION_MIN_STD)
    return jnp.clip((x - statistics.mean) / std, -10.0, 10.0)


class ValueStatistics(NamedTuple):
    """Exponential averages of value targets () and of their squares (), and the accumulated weight ()."""

    mean: jax.Array
    square: jax.Array
    weight: jax.Array


def value_init(enabled: bool = True) -> ValueStatistics:
    """Returns statistics with which values denormalise to 0; if not `enabled`, those that leave values unchanged."""
    return ValueStatistics(jnp.zeros(()), jnp.float32(not enabled), jnp.float32(not enabled))


def value_update(statistics: ValueStatistics, target: jax.Array, active: jax.Array, decay: float) -> ValueStatistics:
    """Updates the averages with a rollout's targets where `active`, of the same shape; weights remove the initial bias.

    Source: Yu et al., arXiv 2103.01955 (there with decay 0.99999 per minibatch; here per rollout).
    """
    mean = decay * statistics.mean + (1.0 - decay) * devices.mean_where(target, active)
    square = decay * statistics.square + (1.0 - decay) * devices.mean_where(jnp.square(target), active)
    weight = decay * statistics.weight + (1.0 - decay)
    return ValueStatistics(mean, square, weight)


def _value_moments(statistics: ValueStatistics) -> tuple[jax.Array, jax.Array]:
    """Returns mean and standard deviation, both 0 before the first update.

    The standard deviation is at least a thousandth of the root mean square: rounding errors are not magnified.
    """
    weight = jnp.where(statistics.weight > 0.0, statistics.weight, 1.0)
    mean, square = statistics.mean / weight, statistics.square / weight
    return mean, jnp.sqrt(jnp.maximum(square - jnp.square(mean), _VALUE_MIN_STD**2 * square))


def value_normalize(statistics: ValueStatistics, value: jax.Array) -> jax.Array:
    """Normalises values in reward units."""
    mean, std = _value_moments(statistics)
    return (value - mean) / jnp.maximum(std, _TINY)


def value_denormalize(statistics: ValueStatistics, value: jax.Array) -> jax.Array:
    """Denormalises values to reward units."""
    mean, std = _value_moments(statistics)
    return value * std + mean
