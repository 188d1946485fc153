"""Running statistics: of all observations, and exponentially averaged ones of value targets."""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core import devices
from mqe_jax.core.blocks import Block

_OBSERVATION_MIN_STD = 1e-2
_VALUE_MIN_STD = 1e-3  # of the root mean square
_TINY = 1e-12


@dataclasses.dataclass(frozen=True, eq=False)
class Features:
    """Which statistics normalise the entries of an observation.

    Entries of one feature share them.
    """

    index: np.ndarray
    """Feature of each entry (size,); `count` for entries that are not normalised."""
    mask: np.ndarray
    """Entry that says whether an entry counts (size,); `size` if it always does."""
    count: int
    """Number of features F."""


def features_of(blocks: Sequence[Block]) -> Features:
    """Returns the features by which the entries of blocks are normalised.

    Entities of a kind share theirs. Masks and pixels are not normalised.
    """
    names: dict[tuple[str, int, int], int] = {}
    index = []
    mask = []
    size = sum(block.width for block in blocks)
    for block in blocks:
        entities = block.entities
        start = len(index)
        length = block.width if entities is None else entities.width + entities.masked
        for entry in range(block.width):
            column = entry % length
            hidden = block.image is not None or (entities is not None and column == entities.width)
            kind = (
                ("", start, entry) if entities is None else (entities.kind, entities.width, column)
            )
            index.append(-1 if hidden else names.setdefault(kind, len(names)))
            masked = entities is not None and entities.masked and not hidden
            mask.append(start + entry - column + length - 1 if masked else size)
    count = len(names)
    return Features(np.where(np.array(index, int) < 0, count, index), np.array(mask, int), count)


class RunningStatistics(NamedTuple):
    """Mean, variance and number of all samples so far, float32.

    Mean and variance are (size,), and the number is (). With `Features`, each is (F,).
    """

    mean: jax.Array
    variance: jax.Array
    samples: jax.Array


def running_init(size: int, features: Features | None = None) -> RunningStatistics:
    """Returns statistics that leave data unchanged until the first update."""
    shape = (size,) if features is None else (features.count,)
    return RunningStatistics(
        jnp.zeros(shape), jnp.ones(shape), jnp.zeros(() if features is None else shape)
    )


def running_update(
    statistics: RunningStatistics,
    batch: jax.Array,
    active: jax.Array,
    features: Features | None = None,
) -> RunningStatistics:
    """Merges the samples (..., size) of a batch that are active (...) bool into the statistics.

    Source: Chan, Golub and LeVeque 1979, the parallel form of Welford's algorithm.
    """
    batch = batch.reshape(math.prod(batch.shape[:-1]), batch.shape[-1])
    mask = jnp.broadcast_to(active.reshape(-1, 1), batch.shape)
    if features is None:
        batch_samples = devices.total(jnp.sum(active.astype(jnp.float32)))
        batch_mean = devices.mean_where(batch, mask, axis=0)
        batch_variance = devices.variance(batch, mask, axis=0)
    else:
        batch_samples, batch_mean, batch_variance = _moments(batch, mask, features)
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


def _moments(
    batch: jax.Array, mask: jax.Array, features: Features
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Returns number, mean and variance of each feature (F,) in a batch (B, size).

    Only entries whose `mask` (B, size) is true count.
    """
    one_hot = np.asarray(features.index[:, None] == np.arange(features.count), np.float32)

    def by_feature(x: jax.Array) -> jax.Array:
        return devices.total(jnp.matmul(jnp.sum(x, axis=0), one_hot, precision="highest"))

    mask = mask & (jnp.pad(batch, ((0, 0), (0, 1)), constant_values=1.0)[:, features.mask] > 0.5)
    samples = by_feature(mask.astype(jnp.float32))
    mean = by_feature(jnp.where(mask, batch, 0.0)) / jnp.maximum(samples, 1.0)
    deviation = jnp.where(mask, batch - jnp.append(mean, 0.0)[features.index], 0.0)
    return samples, mean, by_feature(jnp.square(deviation)) / jnp.maximum(samples, 1.0)


def running_normalize(
    statistics: RunningStatistics, x: jax.Array, features: Features | None = None
) -> jax.Array:
    """Returns x (..., size) normalised to mean 0 and deviation 1, clipped to +-10.

    Constant entries become 0.
    """
    mean = statistics.mean
    variance = statistics.variance
    if features is not None:
        mean, variance = (
            jnp.append(y, own)[features.index] for y, own in ((mean, 0.0), (variance, 1.0))
        )
    std = jnp.maximum(jnp.sqrt(variance), _OBSERVATION_MIN_STD)
    return jnp.clip((x - mean) / std, -10.0, 10.0)


class ValueStatistics(NamedTuple):
    """Exponential averages () of value targets and of their squares.

    `weight` () is the accumulated weight of both.
    """

    mean: jax.Array
    square: jax.Array
    weight: jax.Array


def value_init(enabled: bool = True) -> ValueStatistics:
    """Returns statistics with which values denormalise to 0.

    If not `enabled`, they leave values unchanged.
    """
    return ValueStatistics(jnp.zeros(()), jnp.float32(not enabled), jnp.float32(not enabled))


def value_update(
    statistics: ValueStatistics, target: jax.Array, active: jax.Array, decay: float
) -> ValueStatistics:
    """Updates the averages with a rollout's targets where `active`, of the same shape.

    Weights remove the initial bias. Source: Yu et al., arXiv 2103.01955 (there with decay 0.99999
    per minibatch; here per rollout).
    """
    mean = decay * statistics.mean + (1.0 - decay) * devices.mean_where(target, active)
    square = decay * statistics.square + (1.0 - decay) * devices.mean_where(
        jnp.square(target), active
    )
    weight = decay * statistics.weight + (1.0 - decay)
    return ValueStatistics(mean, square, weight)


def _value_moments(statistics: ValueStatistics) -> tuple[jax.Array, jax.Array]:
    """Returns mean and standard deviation, both 0 before the first update.

    The deviation is at least a thousandth of the root mean square, to bound rounding errors.
    """
    weight = jnp.where(statistics.weight > 0.0, statistics.weight, 1.0)
    mean = statistics.mean / weight
    square = statistics.square / weight
    return mean, jnp.sqrt(jnp.maximum(square - jnp.square(mean), _VALUE_MIN_STD**2 * square))


def value_normalize(statistics: ValueStatistics, value: jax.Array) -> jax.Array:
    """Normalises values in reward units."""
    mean, std = _value_moments(statistics)
    return (value - mean) / jnp.maximum(std, _TINY)


def value_denormalize(statistics: ValueStatistics, value: jax.Array) -> jax.Array:
    """Denormalises values to reward units."""
    mean, std = _value_moments(statistics)
    return value * std + mean
