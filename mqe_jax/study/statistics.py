"""Statistics over few runs, such as interquartile means and bootstrap intervals.

Scores are float arrays (runs, tasks). A statistic maps scores with any leading axes (..., runs,
tasks) to (...). Numbers equal those of the `rliable` package (tests/test_study.py).

Sources: Agarwal et al. 2021, arXiv 2108.13264 (the statistics); Gorsane et al. 2022, arXiv
2209.10485 (their use in MARL).
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mqe_jax.core.errors import InputError

Array = NDArray[np.float64]


def interquartile_mean(scores: ArrayLike) -> Array:
    """Returns the mean of scores without the lowest and the highest quarter.

    Shapes: (..., runs, tasks) -> (...).
    """
    every = np.asarray(scores, np.float64)
    flat = every.reshape(*every.shape[:-2], -1)
    cut = flat.shape[-1] // 4
    return np.sort(flat, axis=-1)[..., cut : flat.shape[-1] - cut].mean(axis=-1)


def probability_of_improvement(x: ArrayLike, y: ArrayLike) -> Array:
    """Returns P(score of x > score of y), mean over tasks; ties count half.

    Shapes: both (..., runs, tasks) -> (...).
    """
    pairs = np.asarray(x, np.float64)[..., :, None, :] - np.asarray(y, np.float64)[..., None, :, :]
    return np.mean((pairs > 0) + 0.5 * (pairs == 0), axis=(-3, -2, -1))


def bootstrap_interval(
    scores: Sequence[Array], statistic: Callable[..., Array], random: Any, samples: int = 2000
) -> tuple[Array, Array]:
    """Returns the bounds of a 95% percentile bootstrap interval.

    Runs are resampled within each task. `scores` are the statistic's arguments, if several, each
    resampled independently. Tasks are the strata and stay fixed. `random` is a
    `numpy.random.Generator`, or has its `integers`. The bounds of one run are the statistic.
    InputError if scores are not (runs, tasks), or not finite.
    """
    groups = [np.asarray(group, np.float64) for group in scores]
    for group in groups:
        if group.ndim != 2 or not group.size:
            raise InputError(
                f"scores: shape {group.shape} is not allowed; it must be (runs, tasks), both at "
                "least 1"
            )
        if not np.isfinite(group).all():
            raise InputError("scores: not all finite; omit runs without a value")
    draws = [random.integers(0, len(group), size=(samples, *group.shape)) for group in groups]
    resampled = [
        group[index, np.arange(group.shape[1])] for group, index in zip(groups, draws, strict=True)
    ]
    low, high = np.percentile(statistic(*resampled), [2.5, 97.5], axis=0)
    return low, high


def normalize(scores: Mapping[str, Array], low: Array, high: Array) -> dict[str, Array]:
    """Returns each algorithm's scores as fractions of the range from `low` to `high`.

    Scores are (runs, tasks), the bounds (tasks,).
    """
    width = np.where(high > low, high - low, 1.0)
    return {name: (values - low) / width for name, values in scores.items()}
