"""Equilibria and cycles of a tournament, and means over mixed teams, with bootstrap intervals.

`python -m lab.games runs/cup/tournament.csv` prints them for the table that `mqe tournament` wrote:
of a match each policy's weight in the maximum-entropy Nash equilibrium, its payoff against that
equilibrium and the share of cycles; of a cooperative task the success of teams of one policy, of
two, and with the reference policies.

Sources: Balduzzi et al. 2018, arXiv 1806.02643 (Nash averaging); Li and Wellman 2024, arXiv
2405.00243 (bootstrap over seeds and episodes).
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mqe_jax.core.errors import InputError, one_line
from mqe_jax.core.files import parsing, read_rows
from mqe_jax.core.types import RESULTS
from mqe_jax.selfplay.league.games import Estimate, estimate, games_of, payoffs, resample
from mqe_jax.selfplay.league.tables import shorten, table

Array = NDArray[np.float64]

REFERENCES = ("scripted", "idle")
"""Policies with which `mqe tournament` mixes all others."""
_SAME = 1e-9  # relative to the largest payoff: smaller singular values are 0
# weights of the barrier; the last one bounds the error of the entropy
_BARRIERS = 10.0 ** -np.arange(1, 15)


def cycles(payoff: Array) -> float:
    """Returns the share of triples in which i beats j, j beats k and k beats i; a payoff of 0 beats
    none.
    """
    beats = (np.asarray(payoff) > 0).astype(float)
    count = len(beats)
    return float(
        np.trace(beats @ beats @ beats) / 3 / max(count * (count - 1) * (count - 2) / 6, 1)
    )


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


class Equilibrium(NamedTuple):
    """What an equilibrium says of P policies; payoffs are wins minus losses of a game."""

    weight: Estimate
    """Weight of each policy in the maximum-entropy Nash equilibrium (P,)."""
    average: Estimate
    """Nash average: payoff against that equilibrium (P,)."""
    cycles: Estimate
    """Share of intransitive triples ()."""


def solve(results: NDArray[Any]) -> Equilibrium:
    """Returns the equilibrium and the cycles of outcomes (P, P, 3), with intervals over
    episodes.
    """
    matrix = payoffs(results)
    samples = payoffs(resample(games_of(results), np.random.default_rng(0)))
    weights = [nash(each) for each in (matrix, *samples)]
    averages = [each @ weight for each, weight in zip((matrix, *samples), weights, strict=True)]
    return Equilibrium(
        estimate(weights[0], weights[1:]),
        estimate(averages[0], averages[1:]),
        estimate(cycles(matrix), [cycles(each) for each in samples]),
    )


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


def means(success: Array, references: Sequence[str], episodes: int) -> dict[str, Estimate]:
    """Returns means over policies of the success of mixed teams (N, N), whose last rows are of
    reference policies: those of `mates`, and by name with each reference policy, in both places.
    """
    count = len(success) - len(references)
    found = mates(success[:count, :count], episodes)
    for i, name in enumerate(references, count):
        teams = np.stack([success[:count, i], success[i, :count]], axis=-1)
        found[name] = partners(teams, episodes)
    return found


def read_table(file: Path, columns: Sequence[str]) -> tuple[list[str], Array]:
    """Returns the policies of a tournament's table, in its order, and numbers of each pair (P, P,
    columns); InputError for another file.
    """
    with parsing(file, "a tournament's table"):
        header, *rows = read_rows(file)
        at = [header.index(name) for name in columns]
        names = list(dict.fromkeys(row[0] for row in rows))
        values = np.array([[float(row[i]) for i in at] for row in rows])
        if not rows or not np.isfinite(values).all():
            raise ValueError("no rows of finite numbers")
        return names, values.reshape(len(names), len(names), len(at))


def describe(file: Path) -> str:
    """Returns what the table of a tournament says, as text."""
    if next(read_rows(file), [""])[0] == "team0":
        names, results = read_table(file, RESULTS)
        found = solve(results)
        order = np.argsort(-found.average.value, kind="stable").tolist()
        columns = {
            "policy": [shorten(names[i]) for i in order],
            "Nash average": [found.average.at(i).text(form="+.0f") for i in order],
            "Nash weight": [found.weight.at(i).text() for i in order],
        }
        lines = [*table(columns), "", f"cycles: {found.cycles.text()}% of all triples"]
        return "\n".join(lines)
    names, values = read_table(file, ("success", "episodes"))
    references = [name for name in names if name in REFERENCES]
    own = [i for i, name in enumerate(names) if name not in REFERENCES]
    order = [*own, *(names.index(name) for name in references)]
    success = values[..., 0][np.ix_(order, order)]
    every = means(success, references, int(values[0, 0, 1]))
    rows = [f"{name:<12}{mean.text(form='.1f')}" for name, mean in every.items()]
    return "\n".join(["success in % (95% interval)", *rows])


def main() -> None:
    """Prints what the table of a tournament says."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", type=Path, help="tournament.csv of `mqe tournament`")
    print(describe(parser.parse_args().file))


if __name__ == "__main__":
    try:
        main()
    except (InputError, OSError) as error:
        raise SystemExit(f"error: {one_line(error)}") from None
