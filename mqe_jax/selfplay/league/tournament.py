"""Round robins of policies of a match, and ratings from their results."""

from __future__ import annotations

import csv
import dataclasses
import io
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from annotated_types import MinLen
from numpy.typing import NDArray

from mqe_jax.core.files import replacing, write_atomically
from mqe_jax.core.limits import NonNegativeInt
from mqe_jax.core.literal import line, to_label
from mqe_jax.core.precision import single
from mqe_jax.core.settings import PathText, check_arguments, fail
from mqe_jax.core.types import RESULTS, AnyBatch, AnyPolicy, RandomKey, observations
from mqe_jax.envs import VectorEnv
from mqe_jax.selfplay.league.games import Estimate, Results, estimate, games_of, resample
from mqe_jax.selfplay.opponents import Versus
from mqe_jax.train.policy import Policy, check_policy

Array = NDArray[np.float64]
CSV, PICTURE = "tournament.csv", "tournament.png"

_POINTS = 400 / np.log(10)  # Elo points of a factor e in the odds
_ITERATIONS = 40
_LONG = 28  # characters of a name in the picture, at most


@single
@check_arguments(matches=AnyBatch, policy=AnyPolicy, key=RandomKey)
def play(matches: VectorEnv, policy: Policy, opponents: Sequence[Policy], key: jax.Array) -> NDArray[np.int64]:
    """Returns a policy's outcomes as team 0 against each of K opponents, in each environment's first episode (K, 3)."""
    check_policy(policy, matches)
    env = Versus(matches, opponents)

    def advance(carry: Any, key: jax.Array) -> tuple[Any, None]:
        state, memory, finished, outcome = carry
        action, memory = policy.act(observations(state).to(policy), memory, key)
        state = env.step(state, action)
        done = state.terminated | state.truncated
        now = state.outcome.result[:, 0] > 0
        outcome = jnp.where((done & ~finished)[:, None], now, outcome)
        return (state, memory, finished | done, outcome), None

    @jax.jit
    def run(key: jax.Array) -> jax.Array:
        key, reset_key = jax.random.split(key)
        count = matches.num_envs
        nothing = jnp.zeros((count,), bool), jnp.zeros((count, 3), bool)
        start = env.reset(reset_key), policy.initial_memory(count), *nothing
        (_, _, _, outcome), _ = jax.lax.scan(advance, start, jax.random.split(key, matches.max_episode_steps))
        return outcome

    return np.asarray(run(key)).reshape(-1, len(opponents), 3).sum(axis=0)


@check_arguments(matches=AnyBatch, policies=Annotated[Mapping[str, AnyPolicy], MinLen(1)], key=RandomKey)
def round_robin(matches: VectorEnv, policies: Mapping[str, Policy], key: jax.Array) -> NDArray[np.int64]:
    """Returns the outcomes of each policy as team 0 against each as team 1: (P, P, 3) in `RESULTS`."""
    keys = jax.random.split(key, len(policies))
    teams = list(policies.values())
    return np.stack([play(matches, policy, teams, k) for policy, k in zip(teams, keys, strict=True)])


@check_arguments(results=Results)
def scores(results: NDArray[Any]) -> Array:
    """Returns the points of each policy against each, as both teams together, in games: (..., P, P, 3) to (..., P, P).

    A draw counts half.
    """
    points = results[..., 0] + 0.5 * results[..., 1]
    return points + (results.sum(axis=-1) - points).swapaxes(-1, -2)


@check_arguments(results=Results, reference=NonNegativeInt)
def rate(results: NDArray[Any], reference: int) -> Estimate:
    """Returns Bradley-Terry ratings in Elo points (doi 10.2307/2334029) (P,), of which that of `reference` is 0.

    A draw is half a win; every pair has one drawn game more than it played, so that ratings are finite. Intervals are
    of a Bayesian bootstrap of all these games.
    """
    if reference >= len(results):
        fail("reference", reference, f"the index of one of the {len(results)} policies")
    games = games_of(results)
    samples = _strengths(scores(resample(games, np.random.default_rng(0))), reference)
    return estimate(_strengths(scores(games), reference), samples)


def _strengths(points: Array, reference: int) -> Array:
    """Returns the maximum-likelihood ratings (..., P) of points (..., P, P), by Newton's method with bounded steps."""
    count = points.shape[-1]
    points = points * (1 - np.eye(count))
    games, strength = points + points.swapaxes(-1, -2), np.zeros(points.shape[:-1])
    for _ in range(_ITERATIONS):
        expected = 1 / (1 + np.exp(strength[..., None, :] - strength[..., :, None]))
        slope, bend = (points - games * expected).sum(axis=-1), games * expected * (1 - expected)
        total = bend.sum(axis=-1)
        curvature = total[..., None] * np.eye(count) - bend
        curvature[..., reference, reference] += 1 + total.max(axis=-1)  # the reference stays where it is
        step = np.linalg.solve(curvature, slope[..., None])[..., 0]
        strength = strength + step / np.maximum(np.abs(step).max(axis=-1, keepdims=True) / 2, 1)
    return _POINTS * (strength - strength[..., reference, None])


@dataclasses.dataclass(frozen=True, repr=False)
class Standings:
    """The results of a tournament of P policies; as text, a table with the strongest first."""

    task: str
    """Id of the match."""
    policies: tuple[str, ...]
    """Names of the policies."""
    results: NDArray[np.int64]
    """Outcomes of each policy as team 0 against each (P, P, 3), as of `round_robin`."""
    ratings: Estimate
    """Ratings, relative to one of them."""

    def __repr__(self) -> str:
        points, games = scores(self.results), np.maximum(self.results.sum(axis=-1) + self.results.sum(axis=-1).T, 1)
        lines = [f"{'policy':<32} rating (95% interval); points of 100 games against each, in the same order"]
        for i in self._order:
            row = " ".join(f"{100 * points[i, j] / games[i, j]:4.0f}" if i != j else "    " for j in self._order)
            low, value, high = (x[i] for x in (self.ratings.low, self.ratings.value, self.ratings.high))
            lines.append(f"{line(self.policies[i]):<32} {value:6.0f} ({low:.0f} to {high:.0f})  {row}")
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Returns the results as JSON can represent them, ratings with the strongest first."""
        rows = [
            {"policy": self.policies[i], **{name: float(x[i]) for name, x in self.ratings._asdict().items()}}
            for i in self._order
        ]
        return {"task": self.task, "ratings": rows, "policies": [*self.policies], "results": self.results.tolist()}

    @check_arguments(folder=PathText)
    def save(self, folder: str | Path) -> None:
        """Writes the results of every pair, the ratings, and a picture of the points, atomically."""
        folder, text = Path(folder), io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(("team0", "team1", *RESULTS, "rating_of_team0", "low", "high"))
        for i, j in itertools.product(range(len(self.policies)), repeat=2):
            names = self.policies[i], self.policies[j]
            writer.writerow((*names, *self.results[i, j], *(f"{x[i]:.1f}" for x in self.ratings)))
        write_atomically(folder / CSV, text.getvalue().encode())
        _draw(self.policies, self.results, folder / PICTURE)

    @property
    def _order(self) -> list[int]:
        return np.argsort(-self.ratings.value, kind="stable").tolist()


def _draw(names: Sequence[str], results: NDArray[np.int64], path: Path) -> None:
    """Draws each policy's points per game against each, rows against columns."""
    from matplotlib.figure import Figure

    share = scores(results) / np.maximum(results.sum(axis=-1) + results.sum(axis=-1).T, 1)
    size = 2.6 + 0.6 * len(names)
    figure = Figure((size + 0.8, size), dpi=120, layout="constrained")
    axes = figure.add_subplot()
    axes.imshow(share, cmap="RdYlGn", vmin=0, vmax=1)
    for (row, column), value in np.ndenumerate(share):
        if row != column:
            axes.text(column, row, f"{100 * value:.0f}", ha="center", va="center", fontsize=9)
    ends = (name if len(name) <= _LONG else f"...{name[3 - _LONG :]}" for name in names)  # the end names a run
    shown = list(map(to_label, ends))
    axes.set_xticks(range(len(names)), shown, rotation=45, ha="right")
    axes.set_yticks(range(len(names)), shown)
    figure.suptitle("points of 100 games, row against column", fontsize=10)
    with replacing(path) as temporary:
        figure.savefig(temporary)
