"""Round robins of policies of a match, and ratings from their results."""

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from mqe_jax.acting.evaluate import not_finite
from mqe_jax.acting.results import Rate
from mqe_jax.acting.seats import Policy, Seat, Seats, check_policy, exchangeable, title
from mqe_jax.core.errors import InputError
from mqe_jax.core.precision import single
from mqe_jax.core.settings import checked
from mqe_jax.core.types import (
    RESULTS,
    observations,
)
from mqe_jax.envs import VectorEnv
from mqe_jax.selfplay.league.games import (
    Analysis,
    Estimate,
    analyse,
    estimate,
    games_of,
    resample,
)
from mqe_jax.selfplay.league.tables import draw, grid, shorten, table, write_table
from mqe_jax.selfplay.opponents import Versus

Array = NDArray[np.float64]
CSV = "tournament.csv"
POLICIES = "policies.csv"
PICTURE = "tournament.png"

DRAWN = 0.002
"""Share of the games of a rating that counts as drawn: who always wins leads by 1200 points."""
_POINTS = 400 / np.log(10)  # Elo points of a factor e in the odds
_ITERATIONS = 40


def play(
    matches: VectorEnv, policy: Policy, opponents: Sequence[Policy], key: jax.Array
) -> NDArray[np.int64]:
    """Returns a policy's outcomes as team 0 against each of K opponents (K, 3).

    The first episode of each environment counts.
    """
    names = [title(each) for each in opponents]
    return _play(matches, [policy], opponents, [key], [title(policy)], names)[0]


def round_robin(
    matches: VectorEnv,
    policies: Mapping[str, Policy],
    key: jax.Array,
    report: Callable[[], object] = lambda: None,
) -> NDArray[np.int64]:
    """Returns the outcomes of each policy as team 0 against each as team 1.

    They are (P, P, 3), in the order of `RESULTS`. `report` is called after the games of each policy
    as team 0. InputError for a policy whose actions are not finite.
    """
    teams = list(policies.values())
    names = list(policies)
    keys = jax.random.split(key, len(teams))
    return _play(matches, teams, teams, keys, names, names, report)


@single
def _play(
    matches: VectorEnv,
    policies: Sequence[Policy],
    opponents: Sequence[Policy],
    keys: Any,
    names: Sequence[str],
    names_of_opponents: Sequence[str],
    report: Callable[[], object] = lambda: None,
) -> NDArray[np.int64]:
    """Returns the outcomes of P policies as team 0 against each of K opponents (P, K, 3).

    Each policy has its key and its name. One compiled program serves all policies.
    """
    for policy in policies:
        check_policy(policy, matches)
    env = Versus(matches, opponents)
    count = matches.num_envs
    still = jnp.zeros((count, env.num_agents, env.action_size))
    (team,) = env.teams

    @jax.jit
    def run(seats: Seats, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        def advance(carry: Any, key: jax.Array) -> tuple[Any, None]:
            state, memory, finished, outcome, finite = carry
            action, memory = seats.act(observations(state), memory, key, still)
            state = env.step(state, action)
            done = state.terminated | state.truncated
            now = state.outcome.result[:, 0] > 0
            outcome = jnp.where((done & ~finished)[:, None], now, outcome)
            finite &= jnp.all(jnp.isfinite(state.action), axis=-1)
            return (state, memory, finished | done, outcome, finite), None

        key, reset_key = jax.random.split(key)
        memory = seats.initial_memory(count)
        nothing = jnp.zeros((count,), bool), jnp.zeros((count, 3), bool)
        every = jnp.ones((count, matches.num_agents), bool)
        start = env.reset(reset_key), memory, *nothing, every
        (_, _, _, outcome, finite), _ = jax.lax.scan(
            advance, start, jax.random.split(key, matches.max_episode_steps)
        )
        return outcome, finite

    outcomes = []
    teams = [Seats((Seat(actor, team, team),)) for actor in exchangeable(policies)]
    for seats, key, name in zip(teams, keys, names, strict=True):
        outcome, finite = map(np.asarray, run(seats, key))
        half = len(team)
        sound = [finite[place :: len(opponents), half:].all() for place in range(len(opponents))]
        for each, right in zip(
            [name, *names_of_opponents], [finite[:, :half].all(), *sound], strict=True
        ):
            if not right:
                raise InputError(not_finite("policies", each))
        outcomes.append(outcome)
        report()
    return np.stack(outcomes).reshape(len(policies), -1, len(opponents), 3).sum(axis=1)


def scores(results: NDArray[Any]) -> Array:
    """Returns the points of each policy against each, over both sides: (..., P, P).

    A point is a game won. A draw counts half. Results are (..., P, P, 3).
    """
    points = results[..., 0] + 0.5 * results[..., 1]
    return points + (results.sum(axis=-1) - points).swapaxes(-1, -2)


def differ(won: int, lost: int) -> bool:
    """Returns whether a two-sided exact sign test of won and lost games has p < 0.05."""
    games = int(won) + int(lost)
    tail = sum(math.comb(games, k) for k in range(min(int(won), int(lost)) + 1))
    return 40 * tail < 2**games


def rate(results: NDArray[Any], reference: int) -> Estimate:
    """Returns Bradley-Terry ratings in Elo points (doi 10.2307/2334029) (P,); `reference` has 0.

    A draw is half a win, and a share `DRAWN` of each pair's games counts as drawn, so that ratings
    are finite and do not grow with the number of games. Intervals are of a Bayesian bootstrap of
    the games and one more for every pair (`games_of`).
    """
    samples = resample(games_of(results), np.random.default_rng(0))
    return estimate(*(_strengths(_mixed(scores(each)), reference) for each in (results, samples)))


def _mixed(points: Array) -> Array:
    """Returns points (..., P, P) with a share `DRAWN` of the games drawn."""
    games = points + points.swapaxes(-1, -2)
    return (1 - DRAWN) * points + 0.5 * DRAWN * games


def _strengths(points: Array, reference: int) -> Array:
    """Returns the maximum-likelihood ratings (..., P) of points (..., P, P).

    Newton's method with bounded steps finds them.
    """
    count = points.shape[-1]
    points = points * (1 - np.eye(count))
    games = points + points.swapaxes(-1, -2)
    strength = np.zeros(points.shape[:-1])
    for _ in range(_ITERATIONS):
        expected = 1 / (1 + np.exp(strength[..., None, :] - strength[..., :, None]))
        slope = (points - games * expected).sum(axis=-1)
        bend = games * expected * (1 - expected)
        total = bend.sum(axis=-1)
        curvature = total[..., None] * np.eye(count) - bend
        # the reference stays where it is
        curvature[..., reference, reference] += 1 + total.max(axis=-1)
        step = np.linalg.solve(curvature, slope[..., None])[..., 0]
        strength = strength + step / np.maximum(np.abs(step).max(axis=-1, keepdims=True) / 2, 1)
    return _POINTS * (strength - strength[..., reference, None])


@dataclasses.dataclass(frozen=True, repr=False)
class Standings:
    """The results of a tournament of P policies; as text, tables with the strongest first."""

    task: str
    """Id of the match."""
    policies: tuple[str, ...]
    """Names of the policies; all arrays have their order."""
    results: NDArray[np.int64]
    """Number of episodes that each policy as team 0 (first axis) won, drew and lost (last axis)
    against each as team 1 (P, P, 3)."""
    ratings: Estimate
    """Bradley-Terry ratings with their 95% intervals, Elo points (P,); the reference policy has
    0."""
    skill: str
    """The skill of all robots, with the ranges of its commands."""

    @functools.cached_property
    def analysis(self) -> Analysis:
        """Wins minus losses of a game: of each pair, their mean and their worst, with intervals."""
        return analyse(self.results)

    def __repr__(self) -> str:
        found = self.analysis
        order = self._order
        names = [shorten(self.policies[i]) for i in order]
        ratings = [self.ratings.at(i).text(1) for i in order]
        columns = {"mean": found.mean, "worst case": found.worst}
        texts = {
            name: [kind.at(i).text(form="+.0f") for i in order] for name, kind in columns.items()
        }
        lines = [
            f"{self.task}, skill {self.skill}",
            "",
            *table({"policy": names, "rating (95% interval)": ratings}),
            "",
            "wins minus losses of 100 games on both sides together (95% interval)",
            *table({"policy": names, **texts}),
            "",
            "each pair's wins minus losses of 100 games; * if a sign test has p < 0.05",
            *grid(self._cells),
        ]
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Returns the results as JSON can represent them, ratings with the strongest first."""
        found = self.analysis
        policies = []
        for i in self._order:
            each = {"mean": found.mean.at(i).to_dict(), "worst": found.worst.at(i).to_dict()}
            policies.append({"policy": self.policies[i], **self.ratings.at(i).to_dict(), **each})
        pairs = {"results": self.results.tolist(), "payoff": found.payoff.to_dict()}
        about = {"task": self.task, "skill": self.skill, "policies": [*self.policies]}
        return {**about, "ratings": policies, **pairs}

    @checked
    def save(self, folder: str | Path) -> None:
        """Writes the results of every pair, their analysis and a picture of the pairs.

        It replaces files atomically.
        """
        folder = Path(folder)
        found = self.analysis
        pairs = []
        both = self.results + self.results.swapaxes(0, 1)[..., ::-1]
        for i, j in itertools.product(range(len(self.policies)), repeat=2):
            games = max(int(both[i, j].sum()), 1)
            rates = [f"{x:.4f}" for count in both[i, j] for x in Rate.of(count / games, games)]
            rates += [f"{x[i, j]:.4f}" for x in found.payoff]
            row = self.policies[i], self.policies[j], *self.results[i, j], *rates, self.skill
            pairs.append(row)
        shares = (*RESULTS, "lead")
        sides = [f"{name}{end}" for name in shares for end in ("_both_sides", "_low", "_high")]
        write_table(folder / CSV, ("team0", "team1", *RESULTS, *sides, "skill"), pairs)
        kinds = {"rating": self.ratings, "mean": found.mean, "worst": found.worst}
        header = [f"{name}{end}" for name in kinds for end in ("", "_low", "_high")]
        rows = [
            (
                self.policies[i],
                *(f"{x[i]:.6g}" for kind in kinds.values() for x in kind),
                self.skill,
            )
            for i in self._order
        ]
        write_table(folder / POLICIES, ("policy", *header, "skill"), rows)
        order = self._order
        draw(
            [self.policies[i] for i in order],
            found.payoff.value[np.ix_(order, order)],
            self._cells,
            "wins minus losses of 100 games, row against column\n* sign test: p < 0.05",
            folder / PICTURE,
            least=-1.0,
        )

    @property
    def _cells(self) -> NDArray[np.str_]:
        """Wins minus losses of 100 games of each pair as text, the strongest first (P, P)."""
        order = np.ix_(self._order, self._order)
        value = self.analysis.payoff.value[order]
        won, _, lost = np.moveaxis(self.results + self.results.swapaxes(0, 1)[..., ::-1], -1, 0)
        pairs = zip(won[order].flat, lost[order].flat, strict=True)
        stars = np.where([differ(*pair) for pair in pairs], "*", "").reshape(value.shape)
        texts = np.array([[f"{100 * x + 0.0:+.0f}" for x in row] for row in value])
        return np.where(np.eye(len(value), dtype=bool), "", np.char.add(texts, stars))

    @property
    def _order(self) -> list[int]:
        return np.argsort(-self.ratings.value, kind="stable").tolist()
