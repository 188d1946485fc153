"""Choice of skills: one skill made of several, of which a further command says which one acts.

The command `skill`, an action entry in [-1, 1], has an equal part of its range for each skill, in
order. Another skill acts once the entry is in its part, by more than `THRESHOLD` from the edge, and
not within `HOLD` after a change. At the start of an episode the first skill acts, and the first
step may change it.

All skills are evaluated in every step. Each remembers what happened, whichever acted: what the
robot sensed, the action that the executed joint targets amount to, and the phase of the gait cycle.
So the next step continues from there.

Actions mean the same commands for every skill, so that a change of skill asks for no other
velocity; each skill gets them reduced to what it is trained for.
"""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core.errors import InputError
from mqe_jax.physics.robots.index import Proprioception, scatter
from mqe_jax.physics.robots.robot import Robot
from mqe_jax.skills import Command, Skill

THRESHOLD = 0.1
"""Distance of the entry from the edge of a skill's part below which the acting skill continues."""
HOLD = 10
"""Steps that a skill acts at least."""
SHARED = ("action", "gait")
"""Fields of the recurrent states of all skills: the last action and the phase of the gait cycle."""


class Choice(Skill):
    """Several skills of a robot; its commands are those of all, and `skill`."""

    name = "choice"
    selector = ("skill",)

    def __init__(self, robot: Robot, parts: Sequence[Skill]) -> None:
        super().__init__(robot)
        self._parts = tuple(parts)
        names = [part.name for part in parts]
        if len(set(names)) < len(names) or len(names) < 2:
            raise InputError(
                f"skill: {tuple(names)} is not allowed; it must be a name, or several distinct "
                "names"
            )
        for part in parts:
            if not all(hasattr(jax.eval_shape(part.init_memory), field) for field in SHARED):
                raise InputError(
                    f"skill: {part.name!r} is not allowed with others; it remembers no action and "
                    "gait"
                )
        every = [
            *(command for part in parts for command in part.commands),
            Command("skill", "of the skills", gain=1.0, limit=1.0),
        ]
        first = {command.name: command for command in reversed(every)}
        self.commands = tuple(
            first[name] for name in dict.fromkeys(command.name for command in every)
        )
        self.gaits = {name: values for part in parts for name, values in part.gaits.items()}
        self._columns = [self.index([command.name for command in part.commands]) for part in parts]
        self._bounds = [_bounds(part) for part in parts]
        self._edges = np.linspace(-1.0, 1.0, len(parts) + 1, dtype=np.float32)[1:-1]

    @property
    def parts(self) -> tuple[Skill, ...]:
        return self._parts

    def select(self, name: str) -> tuple[float]:
        place = [part.name for part in self.parts].index(name)
        return ((2 * place + 1) / len(self.parts) - 1,)

    def with_choice(self, name: str, commands: jax.Array) -> jax.Array:
        default = self.default_commands(skill=self.select(name)[0])
        columns = self._columns[[part.name for part in self.parts].index(name)]
        return jax.vmap(functools.partial(scatter, default, columns))(commands)

    def init_memory(self) -> dict[str, Any]:
        own = {"acting": jnp.zeros(()), "wait": jnp.zeros(())}
        return own | {part.name: part.init_memory() for part in self.parts}

    def targets(
        self,
        params: Any,
        memory: dict[str, Any],
        command: jax.Array,
        proprioception: Proprioception,
    ) -> tuple[jax.Array, dict[str, Any]]:
        entry = command[-1]
        asked = jnp.sum(entry > self._edges).astype(jnp.float32)
        free = (memory["wait"] <= 0) & (jnp.min(jnp.abs(entry - self._edges)) > THRESHOLD)
        acting = jnp.where(free, asked, memory["acting"])
        wait = jnp.where(
            acting != memory["acting"], HOLD - 1.0, jnp.maximum(memory["wait"] - 1.0, 0.0)
        )
        targets = []
        memories = {}
        for part, weights, columns, bounds in zip(
            self.parts, params, self._columns, self._bounds, strict=True
        ):
            own = part.limit_turn(jnp.clip(command[columns], *bounds))
            target, memories[part.name] = part.targets(
                weights, memory[part.name], own, proprioception
            )
            targets.append(target)

        def of_acting(*values: jax.Array) -> jax.Array:
            pairs = enumerate(values[1:], 1)
            return functools.reduce(
                lambda kept, pair: jnp.where(acting == pair[0], pair[1], kept), pairs, values[0]
            )

        shared = {
            field: of_acting(*(getattr(x, field) for x in memories.values())) for field in SHARED
        }
        memories = {name: dataclasses.replace(x, **shared) for name, x in memories.items()}
        return of_acting(*targets), {"acting": acting, "wait": wait, **memories}

    def load_params(self, path: str | os.PathLike[str] | None = None) -> tuple[Any, ...]:
        if path is not None:
            raise InputError(
                f"skill_weights: {str(path)!r} is not allowed; of several skills the shipped "
                "weights act"
            )
        return tuple(part.load_params() for part in self.parts)

    def restrict(self, varied: Sequence[str], gait: str | None) -> Choice:
        def of(part: Skill) -> Skill:
            known = {command.name for command in part.commands}
            return part.restrict(
                [name for name in varied if name in known], gait if gait in part.gaits else None
            )

        return Choice(self.robot, [of(part) for part in self.parts])

    def clock(self, memory: dict[str, Any]) -> jax.Array:
        """Returns the clock of the first skill, which all share, and the index of the skill that
        acts.
        """
        first = self.parts[0]
        return jnp.append(first.clock(memory[first.name]), memory["acting"])

    def trained_ranges(self, names: Sequence[str]) -> np.ndarray:
        """Returns the lowest and the highest value of the named commands for which some skill is
        trained (n, 2).
        """
        known = [
            [part for part in self.parts if name in [c.name for c in part.commands]]
            for name in names
        ]
        each = [
            np.concatenate([part.trained_ranges([name]) for part in parts])
            for name, parts in zip(names, known, strict=True)
        ]
        return np.array([(x[:, 0].min(), x[:, 1].max()) for x in each]).reshape(-1, 2)

    def check_period(self, timestep: float, num_substeps: int) -> None:
        for part in self.parts:
            part.check_period(timestep, num_substeps)


def _bounds(part: Skill) -> np.ndarray:
    """Returns the lowest and the highest value (2, C) of commands that a skill is trained for; none
    without actions.
    """
    names = [command.name for command in part.commands]
    free = part.column("gain", names) == 0
    return np.where(free, np.array([[-np.inf], [np.inf]]), part.trained_ranges(names).T).astype(
        np.float32
    )
