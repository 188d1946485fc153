"""Empirical games: payoffs of policies against each other, with bootstrap intervals.

Source: Li and Wellman 2024, arXiv 2405.00243 (bootstrap over seeds and episodes).
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SAMPLES = 500  # of a bootstrap
_HALF = np.full(3, 1 / 6)  # of a game that is won, drawn and lost in equal parts


class Estimate(NamedTuple):
    """A number with the bounds of its 95% interval, or an array with those of its numbers."""

    value: Any
    low: Any
    high: Any

    def at(self, *index: int) -> "Estimate":
        """Returns the estimate of one of the numbers."""
        return Estimate(*(x[index] for x in self))

    def text(self, scale: float = 100.0, form: str = ".0f") -> str:
        """Returns one number with its interval."""
        value, low, high = (format(scale * float(x) + 0.0, form) for x in self)
        return f"{value} ({low} to {high})"

    def to_dict(self) -> dict[str, Any]:
        """Returns plain numbers for JSON."""
        return {name: np.asarray(x).tolist() for name, x in self._asdict().items()}


def payoffs(results: NDArray[Any]) -> Array:
    """Returns the wins minus losses per game of each policy against each, over both sides.

    Outcomes are (..., P, P, 3), payoffs (..., P, P). The matrices are antisymmetric. Without games,
    a payoff is 0.
    """
    lead = results[..., 0] - results[..., 2]
    games = results.sum(axis=-1)
    return (lead - lead.swapaxes(-1, -2)) / np.maximum(games + games.swapaxes(-1, -2), 1e-12)


def resample(counts: NDArray[Any], random: np.random.Generator) -> Array:
    """Returns Bayesian bootstrap samples of counts by outcome: (..., K) to (S, ..., K).

    Source: doi 10.1214/aos/1176345338.
    """
    drawn = random.standard_gamma(counts, (_SAMPLES, *counts.shape))
    return drawn * (counts.sum(axis=-1, keepdims=True) / drawn.sum(axis=-1, keepdims=True))


def games_of(results: NDArray[Any]) -> Array:
    """Returns results with one more game for every pair, won, drawn and lost in equal parts.

    It keeps the interval of a few equal games wide.
    """
    return results + _HALF


def estimate(value: Any, samples: Any) -> Estimate:
    """Returns a value with the 95% interval of its samples (S, ...).

    The interval contains the value. Samples may be NaN.
    """
    low, high = np.nanquantile(samples, [0.025, 0.975], axis=0)
    return Estimate(np.asarray(value), np.minimum(low, value), np.maximum(high, value))


class Analysis(NamedTuple):
    """What the results of P policies say about each; payoffs are wins minus losses of a game."""

    payoff: Estimate
    """Payoff of each policy against each, over both sides (P, P). Intervals are over episodes."""
    mean: Estimate
    """Mean payoff against the others (P,). Its interval is over opponents and episodes."""
    worst: Estimate
    """Lowest payoff against one of the others (P,)."""


def analyse(results: NDArray[Any]) -> Analysis:
    """Returns mean and worst case from results (P, P, 3), with bootstrap intervals."""
    count = len(results)
    random = np.random.default_rng(0)
    matrix = payoffs(results)
    samples = payoffs(resample(games_of(results), random))
    others = (np.arange(count)[:, None] + np.arange(1, count)) % count
    drawn = np.take_along_axis(
        others[None], random.integers(count - 1, size=(len(samples), count, count - 1)), -1
    )
    against = np.take_along_axis(matrix, others, -1)
    return Analysis(
        estimate(matrix, samples),
        estimate(against.mean(axis=-1), np.take_along_axis(samples, drawn, -1).mean(axis=-1)),
        estimate(against.min(axis=-1), np.take_along_axis(samples, others[None], -1).min(axis=-1)),
    )
