"""Cross-play of a cooperative task: teams whose agents follow policies of different trainings."""

import dataclasses
import itertools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from mqe_jax.acting.evaluate import Evaluator
from mqe_jax.acting.results import Rate
from mqe_jax.acting.seats import Policy, Seat, Seats, check_policy, exchangeable
from mqe_jax.core.settings import checked, fail
from mqe_jax.core.types import teams_of
from mqe_jax.envs import VectorEnv
from mqe_jax.selfplay.league.games import Estimate
from mqe_jax.selfplay.league.tables import draw, grid, shorten, table, write_table
from mqe_jax.selfplay.league.tournament import CSV, PICTURE

Array = NDArray[np.float64]


def cross_play(
    batch: VectorEnv,
    policies: Mapping[str, Policy],
    episodes: int,
    key: jax.Array,
    report: Callable[[], object] = lambda: None,
) -> Array:
    """Returns the success rates (P, P) of each policy of agent 0 with each policy of its mates.

    The rows are agent 0's policies, the columns those of the others. `report` is called after each
    row. The batch has P copies. One compiled program evaluates the teams of a row at once and
    serves all rows. InputError for a policy whose actions are not finite.
    """
    for name, policy in policies.items():
        check_policy(policy, batch, name)
    if batch.num_agents < 2 or len(teams_of(batch)) > 1:
        fail("task", batch.name, "one of a team of several agents")
    team = tuple(range(batch.num_agents))
    names = [*policies]
    actors = exchangeable([*policies.values()])

    def seats(first: Any, others: Any) -> Seats:
        return Seats((Seat(first, team, team[:1]), Seat(others, team, team[1:])))

    evaluator = Evaluator(batch.with_groups(seats(actors[0], actors[0]).groups))
    count = len(actors)
    rates = np.zeros((count, count))
    for first, row_key in enumerate(jax.random.split(key, count)):
        teams = [seats(actors[first], others) for others in actors]
        stacked = jax.tree.map(lambda *x: jnp.stack(x), *teams)
        pairs = [(names[first], name) for name in names]
        keys = jax.random.split(row_key, count)
        results = evaluator(stacked, episodes, keys, names=pairs)
        rates[first] = [result.success_rate for result in results]
        report()
    return rates


@dataclasses.dataclass(frozen=True, repr=False)
class CrossPlay:
    """Success of mixed teams of P policies and some reference policies, N in all.

    It prints as tables.
    """

    task: str
    """Id of the task."""
    policies: tuple[str, ...]
    """Names of the policies."""
    references: tuple[str, ...]
    """Names of the reference policies, further mates."""
    episodes: int
    """Episodes of each team."""
    success: Array
    """Success rates (N, N): the row's policy is agent 0's, the column's that of the others."""
    skill: str
    """The skill of all robots, with the ranges of its commands."""

    @property
    def means(self) -> dict[str, float]:
        """Mean success by kind of team: `same` policies, different ones (`cross`), or a reference.

        The mean of a reference policy, under its name, is over teams in which agent 0 or the others
        follow it.
        """
        count = len(self.policies)
        teams = self.success[:count, :count]
        found = {"same": float(teams.diagonal().mean())}
        if count > 1:
            found["cross"] = float(teams[~np.eye(count, dtype=bool)].mean())
        for i, name in enumerate(self.references, count):
            both = np.concatenate([self.success[:count, i], self.success[i, :count]])
            found[name] = float(both.mean())
        return found

    @property
    def worst(self) -> tuple[int, int] | None:
        """The team of different policies with the least success; None if there is one policy.

        A team is the index of agent 0's policy and the index of the others' policy.
        """
        count = len(self.policies)
        pairs = itertools.permutations(range(count), 2)
        return min(pairs, key=lambda pair: self.success[pair], default=None)

    def rate(self, first: int, others: int) -> Estimate:
        """Returns the success of a team, from the indices of agent 0's policy and the others'."""
        return Estimate(*Rate.of(float(self.success[first, others]), self.episodes))

    def __repr__(self) -> str:
        count = len(self.policies)
        names = [*self.policies, *self.references]
        wide = max(
            50 * (rate.high - rate.low) for rate in itertools.starmap(self.rate, self._pairs)
        )
        shown = {"same": "policies with themselves", "cross": "different policies"}
        lines = [f"{self.task}, skill {self.skill}", f"success in % of {self.episodes} episodes"]
        for name, mean in self.means.items():
            lines.append(f"{shown.get(name, f'policies with {name}'):<26}{100 * mean:.1f}")
        if self.worst is not None:
            first, others = self.worst
            lines.append(
                f"{'worst different policies':<26}{self.rate(first, others).text(form='.1f')}: "
            )
            lines[-1] += f"{first + 1} with {others + 1}"
        lines += [
            "",
            f"agent 0 follows the row, the others the column; intervals are +-{wide:.0f} at most",
        ]
        lines += [*table({"policy": [*map(shorten, names)]}), "", *grid(self._cells)]
        columns = {}
        for at, name in enumerate(self.references, count):
            columns[f"agent 0 {name}"] = [self.rate(at, i).text() for i in range(count)]
            columns[f"others {name}"] = [self.rate(i, at).text() for i in range(count)]
        if columns:
            lines += [
                "",
                "with a reference policy as a part of the team",
                *table({"": [""] * count, **columns}),
            ]
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Returns the results as JSON can represent them."""
        size = range(len(self.success))
        worst = None
        if self.worst is not None:
            worst = {
                "policies": [self.policies[i] for i in self.worst],
                **self.rate(*self.worst).to_dict(),
            }
        bounds = np.array([[self.rate(i, j) for j in size] for i in size])
        return {
            "task": self.task,
            "skill": self.skill,
            "policies": [*self.policies],
            "references": [*self.references],
            "episodes": self.episodes,
            "success": Estimate(*np.moveaxis(bounds, -1, 0)).to_dict(),
            **self.means,
            "worst": worst,
        }

    @checked
    def save(self, folder: str | Path) -> None:
        """Writes the success of every team, and a picture of it, atomically."""
        folder = Path(folder)
        names = [*self.policies, *self.references]
        rows = [
            (names[i], names[j], self.episodes, *(f"{x:.4f}" for x in self.rate(i, j)), self.skill)
            for i, j in self._pairs
        ]
        header = ("agent0", "others", "episodes", "success", "low", "high", "skill")
        write_table(folder / CSV, header, rows)
        draw(
            names,
            self.success,
            self._cells,
            "success in %, agent 0 (row) with the others (column)",
            folder / PICTURE,
        )

    @property
    def _cells(self) -> NDArray[np.str_]:
        return np.array([[f"{100 * x:.0f}" for x in row] for row in self.success])

    @property
    def _pairs(self) -> list[tuple[int, int]]:
        return [(i, j) for i in range(len(self.success)) for j in range(len(self.success))]
