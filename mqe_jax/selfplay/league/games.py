"""Empirical games: payoffs of policies against each other, equilibria, cycles, and bootstrap
intervals.

Sources: Balduzzi et al. 2018, arXiv 1806.02643 (Nash averaging); Li and Wellman 2024, arXiv
2405.00243 (bootstrap over seeds and episodes).
"""

from typing import Annotated, Any, NamedTuple

import numpy as np
import pydantic
from numpy.typing import NDArray

from mqe_jax.core.limits import Episodes
from mqe_jax.core.settings import check_arguments, fail

Array = NDArray[np.float64]

_SAMPLES = 500  # of a bootstrap
_DRAW = np.array([0.0, 0.5, 0.0])
_SAME = 1e-9  # relative to the largest payoff: smaller singular values are 0
# weights of the barrier; the last one bounds the error of the entropy
_BARRIERS = 10.0 ** -np.arange(1, 15)


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


def _check_results(value: Any) -> Any:
    shape = np.shape(value)
    if (
        len(shape) < 3
        or shape[-3:] != (*shape[-2:-1] * 2, 3)
        or not np.all(np.isfinite(value))
        or np.min(value) < 0
    ):
        raise ValueError("outcomes of policies against policies, as of round_robin")
    return value


def _check_payoff(value: Any) -> Any:
    shape = np.shape(value)
    if len(shape) != 2 or shape[0] != shape[1] or not shape[0] or not np.all(np.isfinite(value)):
        raise ValueError("finite numbers (P, P)")
    if not np.allclose(value, -np.transpose(value), rtol=0, atol=_SAME * np.max(np.abs(value))):
        raise ValueError("antisymmetric: what one policy wins, the other one loses")
    return value


def _check_mixed(value: Any) -> Any:
    if np.ndim(value) != 2 or not np.size(value) or not np.all((0 <= value) & (value <= 1)):
        raise ValueError("rates in [0, 1] of policies in teams (P, K)")
    return value


def _check_rates(value: Any) -> Any:
    shape = np.shape(value)
    if (
        len(shape) != 2
        or shape[0] != shape[1]
        or not shape[0]
        or not np.all((0 <= value) & (value <= 1))
    ):
        raise ValueError("rates in [0, 1] of policies with policies (P, P)")
    return value


Results = Annotated[Any, pydantic.AfterValidator(_check_results)]
"""Kind of an argument that is a result of `round_robin` (P, P, 3); of some, with leading axes."""
Mixed = Annotated[Any, pydantic.AfterValidator(_check_mixed)]
"""Kind of an argument that is a rate of each policy in some teams (P, K)."""
Payoff = Annotated[Any, pydantic.AfterValidator(_check_payoff)]
"""Kind of an argument that is an antisymmetric matrix (P, P)."""
Rates = Annotated[Any, pydantic.AfterValidator(_check_rates)]
"""Kind of an argument that is a rate of each pair (P, P)."""


@check_arguments(results=Results)
def payoffs(results: NDArray[Any]) -> Array:
    """Returns wins minus losses of a game, on both sides together, from outcomes (..., P, P, 3):
    (..., P, P).

    The matrices are antisymmetric. Without games, a payoff is 0.
    """
    lead = results[..., 0] - results[..., 2]
    games = results.sum(axis=-1)
    return (lead - lead.swapaxes(-1, -2)) / np.maximum(games + games.swapaxes(-1, -2), 1e-12)


@check_arguments(payoff=Payoff)
def cycles(payoff: Array) -> float:
    """Returns the share of triples in which i beats j, j beats k and k beats i; a payoff of 0 beats
    none.
    """
    beats = (np.asarray(payoff) > 0).astype(float)
    count = len(beats)
    return float(
        np.trace(beats @ beats @ beats) / 3 / max(count * (count - 1) * (count - 2) / 6, 1)
    )


@check_arguments(payoff=Payoff)
def nash(payoff: Array) -> Array:
    """Returns the weights (P,) of the maximum-entropy Nash equilibrium of a symmetric zero-sum game
    (P, P).

    Copies of a policy share its weight equally. The payoff of each policy against the equilibrium,
    `payoff @ nash(payoff)`, is its Nash average: 0 within the support, at most 0 outside.
    """
    from scipy.linalg import null_space
    from scipy.optimize import linprog

    matrix = (np.asarray(payoff, np.float64) - np.transpose(payoff)) / 2
    matrix /= np.max(np.abs(matrix)) or 1.0
    count = len(matrix)
    # The linear program maximises a bound: the weight of each policy in p, or its loss A p, exceeds
    # it. The equilibrium p then has the largest support (Goldman and Tucker 1956), which is that of
    # maximum entropy.
    ones = np.ones((count, 1))
    zeros = np.zeros((count, 1))
    loses = np.block([[matrix, zeros], [matrix - np.eye(count), ones]])
    tight = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
    sums = np.append(np.ones(count), 0.0)[None]
    found = linprog(
        -np.eye(count + 1)[-1], loses, np.zeros(2 * count), sums, [1.0], options=tight
    ).x[:-1]
    inside = found > -matrix @ found
    # All equilibria have their weights inside, whose policies tie with each of them.
    equal = np.vstack([matrix[np.ix_(inside, inside)], np.ones(inside.sum())])
    start = (
        np.linalg.lstsq(equal, np.eye(len(equal))[-1] - equal @ found[inside], _SAME)[0]
        + found[inside]
    )
    weights = np.zeros(count)
    weights[inside] = _spread(start, null_space(equal, _SAME), -matrix[np.ix_(~inside, inside)])
    return weights / weights.sum()


def _spread(start: Array, moves: Array, losses: Array) -> Array:
    """Returns the weights `start + moves @ z` of maximum entropy with `losses @ weights` at least
    0.

    Newton's method with a logarithmic barrier; `start` (S,) is strictly feasible, `moves` (S, D),
    `losses` (L, S).
    """
    weights = start
    sinks = losses @ moves
    if not moves.size:
        return weights

    def value(weights: Array) -> float:
        lost = losses @ weights
        if weights.min() <= 0 or (len(lost) and lost.min() <= 0):
            return np.inf
        return float(weights @ np.log(weights) - barrier * np.log(lost).sum())

    for barrier in _BARRIERS if len(losses) else _BARRIERS[-1:]:
        for _ in range(50):
            lost = losses @ weights
            slope = moves.T @ np.log(weights) - barrier * sinks.T @ (1 / lost)
            bend = moves.T @ (moves / weights[:, None]) + barrier * sinks.T @ (
                sinks / lost[:, None] ** 2
            )
            step = -np.linalg.solve(bend, slope)
            gain = -slope @ step
            now = value(weights)
            size = 1.0
            if gain < 1e-24:
                break
            while (
                size > 1e-9
                and not value(weights + size * moves @ step) <= now - 0.1 * size * gain + 1e-15
            ):
                size /= 2
            if size <= 1e-9:
                break
            weights = weights + size * moves @ step
    return weights


def resample(counts: NDArray[Any], random: np.random.Generator) -> Array:
    """Returns Bayesian bootstrap samples (doi 10.1214/aos/1176345338) of counts by outcome: (...,
    K) to (S, ..., K).
    """
    drawn = random.standard_gamma(counts, (_SAMPLES, *counts.shape))
    return drawn * (counts.sum(axis=-1, keepdims=True) / drawn.sum(axis=-1, keepdims=True))


def games_of(results: NDArray[Any]) -> Array:
    """Returns results with one more drawn game for every pair, so that a few equal games leave
    doubt.
    """
    return results + _DRAW


def estimate(value: Any, samples: Any) -> Estimate:
    """Returns a value with the interval of its samples (S, ...), which contains it; samples may be
    NaN.
    """
    low, high = np.nanquantile(samples, [0.025, 0.975], axis=0)
    return Estimate(np.asarray(value), np.minimum(low, value), np.maximum(high, value))


class Analysis(NamedTuple):
    """What the results of P policies say about each; payoffs are wins minus losses of a game."""

    payoff: Estimate
    """Payoff of each policy against each, on both sides together (P, P). Intervals are over
    episodes."""
    mean: Estimate
    """Mean payoff against the others (P,). Its interval is over opponents and episodes."""
    worst: Estimate
    """Lowest payoff against one of the others (P,)."""
    weight: Estimate
    """Weight in the maximum-entropy Nash equilibrium (P,)."""
    average: Estimate
    """Nash average: payoff against that equilibrium (P,)."""
    cycles: Estimate
    """Share of intransitive triples ()."""

    def by_policy(self) -> dict[str, Estimate]:
        """Returns what describes each policy (P,), by name."""
        return {
            "mean": self.mean,
            "worst": self.worst,
            "nash_average": self.average,
            "nash_weight": self.weight,
        }


@check_arguments(results=Results)
def analyse(results: NDArray[Any]) -> Analysis:
    """Returns mean, worst case, Nash average and cycles from results (P, P, 3), with bootstrap
    intervals.
    """
    count = len(results)
    if count < 2:
        fail("results", np.shape(results), "those of at least two policies")
    random = np.random.default_rng(0)
    matrix = payoffs(results)
    samples = payoffs(resample(games_of(results), random))
    others = (np.arange(count)[:, None] + np.arange(1, count)) % count
    drawn = np.take_along_axis(
        others[None], random.integers(count - 1, size=(len(samples), count, count - 1)), -1
    )
    weights = [nash(each) for each in (matrix, *samples)]
    averages = [each @ weight for each, weight in zip((matrix, *samples), weights, strict=True)]
    against = np.take_along_axis(matrix, others, -1)
    return Analysis(
        estimate(matrix, samples),
        estimate(against.mean(axis=-1), np.take_along_axis(samples, drawn, -1).mean(axis=-1)),
        estimate(against.min(axis=-1), np.take_along_axis(samples, others[None], -1).min(axis=-1)),
        estimate(weights[0], weights[1:]),
        estimate(averages[0], averages[1:]),
        estimate(cycles(matrix), [cycles(each) for each in samples]),
    )


@check_arguments(rates=Rates, episodes=Episodes)
def mates(rates: Array, episodes: int) -> dict[str, Estimate]:
    """Returns means of the success rates of pairs of policies (P, P), with intervals over policies
    and episodes.

    `same` is that of policies with themselves, `cross` that with others, and `gap` the first minus
    the second; with one policy there are no others. Rates of values in [0, 1] have conservative
    intervals.
    """
    count = len(rates)
    (samples, times) = _resample_teams(rates, episodes)

    def mean(rates: Array, weights: Array) -> Array:
        total = weights.sum(axis=(-1, -2))
        return np.where(
            total > 0, (rates * weights).sum(axis=(-1, -2)) / np.maximum(total, 1e-12), np.nan
        )

    own = np.eye(count)
    same = mean(rates, own), mean(samples, times[:, None] * own)
    found = {"same": estimate(*same)}
    if count > 1:
        cross = (
            mean(rates, 1 - own),
            mean(samples, times[:, :, None] * times[:, None, :] * (1 - own)),
        )
        found |= {
            "cross": estimate(*cross),
            "gap": estimate(same[0] - cross[0], same[1] - cross[1]),
        }
    return found


@check_arguments(rates=Mixed, episodes=Episodes)
def partners(rates: Array, episodes: int) -> Estimate:
    """Returns the mean of success rates of P policies in K teams each (P, K), over policies and
    episodes as `mates`.
    """
    samples, times = _resample_teams(rates, episodes)
    return estimate(np.mean(rates), (samples.mean(axis=-1) * times).sum(axis=-1) / len(rates))


def _resample_teams(rates: Array, episodes: int) -> tuple[Array, Array]:
    """Returns bootstrap samples of success rates (S, P, K), and how often each draws each policy
    (S, P).
    """
    random = np.random.default_rng(0)
    count = len(rates)
    ended = episodes * np.stack([rates, 1 - np.asarray(rates)], axis=-1) + 0.5
    samples = resample(ended, random)[..., 0] / (episodes + 1)
    return samples, random.multinomial(count, np.full(count, 1 / count), len(samples)).astype(float)
