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
from collections.abc import Mapping, Sequence
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
        commands: dict[str, Command] = {}
        gaits: dict[str, Mapping[str, float]] = {}
        for part in parts:
            for command in part.commands:
                commands.setdefault(command.name, command)
            gaits |= part.gaits
        commands["skill"] = Command("skill", "of the skills", gain=1.0, limit=1.0)
        self.commands = tuple(commands.values())
        self.gaits = gaits
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
        (selected,) = self.select(name)
        default = self.default_commands(skill=selected)
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
        clear = jnp.min(jnp.abs(entry - self._edges)) > THRESHOLD
        free = (memory["wait"] <= 0) & clear
        acting = jnp.where(free, asked, memory["acting"])
        rest = jnp.maximum(memory["wait"] - 1.0, 0.0)
        wait = jnp.where(acting != memory["acting"], HOLD - 1.0, rest)
        targets = []
        memories = {}
        parts = zip(self.parts, params, self._columns, self._bounds, strict=True)
        for part, weights, columns, bounds in parts:
            own = part.limit_turn(jnp.clip(command[columns], *bounds))
            target, memories[part.name] = part.targets(
                weights, memory[part.name], own, proprioception
            )
            targets.append(target)

        def of_acting(values: Sequence[jax.Array]) -> jax.Array:
            kept = values[0]
            for number, value in enumerate(values[1:], 1):
                kept = jnp.where(acting == number, value, kept)
            return kept

        shared = {}
        for field in SHARED:
            shared[field] = of_acting([getattr(each, field) for each in memories.values()])
        memories = {name: dataclasses.replace(x, **shared) for name, x in memories.items()}
        return of_acting(targets), {"acting": acting, "wait": wait, **memories}

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
            own_gait = gait if gait in part.gaits else None
            return part.restrict([name for name in varied if name in known], own_gait)

        return Choice(self.robot, [of(part) for part in self.parts])

    def clock(self, memory: dict[str, Any]) -> jax.Array:
        """Returns the clock of the first skill, which all share, and the acting skill's index."""
        first = self.parts[0]
        return jnp.append(first.clock(memory[first.name]), memory["acting"])

    def trained_ranges(self, names: Sequence[str]) -> np.ndarray:
        """Returns the range of the named commands for which some skill is trained (n, 2)."""
        ranges = []
        for name in names:
            having = [part for part in self.parts if name in [c.name for c in part.commands]]
            low, high = np.concatenate([part.trained_ranges([name]) for part in having]).T
            ranges.append((low.min(), high.max()))
        return np.array(ranges).reshape(-1, 2)

    def check_period(self, timestep: float, num_substeps: int) -> None:
        for part in self.parts:
            part.check_period(timestep, num_substeps)


def _bounds(part: Skill) -> np.ndarray:
    """Returns the range (2, C) of commands that a skill is trained for.

    Commands that no action sets are unbounded.
    """
    names = [command.name for command in part.commands]
    free = part.column("gain", names) == 0
    unbounded = np.array([[-np.inf], [np.inf]])
    bounds = np.where(free, unbounded, part.trained_ranges(names).T)
    return bounds.astype(np.float32)
