"""Skills of one robot: low-level policies from commands to joint targets; their registry.

A skill is a class derived from `Skill` in its own file, registered by `register`. Agents and NPC
robots use it alike.
"""

from __future__ import annotations

import abc
import math
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core.errors import InputError, known_name, nearest
from mqe_jax.core.settings import fail
from mqe_jax.physics.robots.index import Proprioception
from mqe_jax.physics.robots.robot import Robot


class Command(NamedTuple):
    """One command of a skill. An action adds gain x action to the default, clipped to +-limit."""

    name: str
    unit: str
    default: float | Callable[[Robot], float] = 0.0
    """Value without an action, or a function of the robot."""
    gain: float = 0.0
    """Change per unit of action; 0 if actions cannot set the command."""
    limit: float = 0.0
    """Greatest change by an action."""
    scale: float = 1.0
    """Factor in the skill's own observation."""
    mirror: float = 1.0
    """Sign under reflection of left and right."""
    trained: tuple[float, float] | None = None
    """Lowest and highest value for which the skill is trained; None for the default +-limit."""


class Skill(abc.ABC):
    """A low-level policy with C commands; functions of one robot, to be batched by `jax.vmap`."""

    name: ClassVar[str]
    """Name in the registry, and prefix of the recurrent states in exported graphs."""
    commands: tuple[Command, ...]
    """Its commands, in order."""
    gaits: Mapping[str, Mapping[str, float]] = {}
    """Named sets of default commands; the first is the default."""
    period: ClassVar[float] = 0.02
    """Environment step, s."""
    turn: ClassVar[float | None] = None
    """Maximum |vx x yaw_rate| for which the skill is trained, m/s^2; None sets no bound."""
    selector: ClassVar[tuple[str, ...]] = ()
    """Commands that an action sets besides those asked for, after them."""
    robot: Robot
    """Robot type."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot

    # Defined by each skill:

    @abc.abstractmethod
    def init_memory(self) -> Any:
        """Returns the recurrent state after a reset.

        It is a dataclass or dictionary of arrays, or () without one.
        """

    @abc.abstractmethod
    def targets(
        self, params: Any, memory: Any, command: jax.Array, proprioception: Proprioception
    ) -> tuple[jax.Array, Any]:
        """Returns the joint targets (12,), rad, and the next recurrent state, for commands (C,)."""

    def load_params(self, path: str | os.PathLike[str] | None = None) -> Any:
        """Reads the parameters from a file, or those shipped for the robot.

        InputError if they cannot be read.
        """
        if path is not None:
            raise InputError(
                f"skill_weights: {str(path)!r} is not allowed; the skill {self.name!r} has no "
                "weights"
            )
        return ()

    def restrict(self, varied: Sequence[str], gait: str | None) -> Skill:
        """Returns the skill for commands that mostly stay at the defaults of a gait.

        Only the `varied` commands ever differ from them.
        """
        return self

    def clock(self, memory: Any) -> jax.Array:
        """Returns the part of the recurrent state that critics observe, any length."""
        return jnp.zeros(0)

    @property
    def parts(self) -> tuple[Skill, ...]:
        """The skills that act: itself, or those between which actions choose."""
        return (self,)

    def select(self, name: str) -> tuple[float, ...]:
        """Returns the values of the commands in `selector` with which the skill of a name acts."""
        return ()

    def with_choice(self, name: str, commands: jax.Array) -> jax.Array:
        """Returns the commands (N, C) with which the skill of a name acts.

        `commands` (N, C') are that skill's own.
        """
        return commands

    # Common to all skills:

    def index(self, names: Sequence[str]) -> np.ndarray:
        """Returns the positions of commands in the vector of commands.

        InputError for an unknown name.
        """
        known = [command.name for command in self.commands]
        wrong = f"{self.name} command: unknown name"
        return np.array([known.index(known_name(wrong, name, known)) for name in names], int)

    def column(self, field: str, names: Sequence[str]) -> np.ndarray:
        """Returns a field of `Command`, such as 'gain', of the named commands (n,)."""
        return np.array([getattr(self.commands[i], field) for i in self.index(names)], np.float32)

    def default_commands(self, gait: str | None = None, **values: float) -> np.ndarray:
        """Returns the default commands (C,) of a gait, with single values replaced.

        Raises:
            InputError: for an unknown gait or command.
        """
        if gait is not None and gait not in self.gaits:
            allowed = ", ".join(self.gaits) or f"none with the skill {self.name!r}"
            raise InputError(
                f"gait: unknown name {gait!r}{nearest(gait, self.gaits)}; allowed: {allowed}"
            )
        given = [command.default for command in self.commands]
        default = np.array([x(self.robot) if callable(x) else x for x in given], np.float32)
        if gait is None:
            gait = next(iter(self.gaits), "")
        changed = {**self.gaits.get(gait, {}), **values}
        for name, value in changed.items():
            default[self.index([name])] = value
        return default

    def changes(
        self, names: Sequence[str], ranges: Mapping[str, tuple[float, float]], default: np.ndarray
    ) -> np.ndarray:
        """Returns the lowest and the highest change of the named commands by an action (n, 2).

        Args:
            names: commands that the action sets.
            ranges: lowest and highest value by command, for some of them; the others change by
                +-limit.
            default: default commands (C,).

        Raises:
            InputError: naming a command that the action does not set, or a range that excludes the
                default.
        """
        limit = self.column("limit", names)
        default = default[self.index(names)]
        changes = np.stack([-limit, limit], axis=-1)
        for name, (low, high) in ranges.items():
            i = list(names).index(known_name("command_ranges: unknown command", name, names))
            if not low <= default[i] <= high or low == high:
                allowed = f"lowest < highest, with the default {default[i]:g} between"
                raise InputError(
                    f"command_ranges.{name}: {(low, high)} is not allowed; it must be {allowed}"
                )
            changes[i] = np.array([low, high], np.float32) - default[i]
        return changes

    def trained_ranges(self, names: Sequence[str]) -> np.ndarray:
        """Returns the range of the named commands for which the skill is trained (n, 2)."""
        default = self.default_commands()
        ranges = []
        for i in self.index(names):
            limit = self.commands[i].limit
            around = (default[i] - limit, default[i] + limit)
            ranges.append(self.commands[i].trained or around)
        return np.array(ranges, float).reshape(-1, 2)

    def untrained_commands(self, ranges: Mapping[str, tuple[float, float]]) -> list[str]:
        """Returns the commands whose range exceeds that for which the skill was trained.

        Each is a text with both ranges.
        """
        trained = self.trained_ranges(list(ranges))
        found = []
        for (name, (low, high)), (least, most) in zip(ranges.items(), trained, strict=True):
            if low < least or high > most:
                found.append(f"{name} [{low:g}, {high:g}] outside [{least:g}, {most:g}]")
        return found

    def limit_turn(self, commands: jax.Array) -> jax.Array:
        """Returns commands (..., C) with the yaw rate reduced to the bound `turn`."""
        if self.turn is None:
            return commands
        vx, yaw = self.index(("vx", "yaw_rate"))
        most = self.turn / jnp.maximum(jnp.abs(commands[..., vx]), 1e-3)
        return commands.at[..., yaw].set(jnp.clip(commands[..., yaw], -most, most))

    def check_commands(self, names: Sequence[str]) -> None:
        """Checks the commands that the action sets; the InputError names the allowed ones."""
        allowed = [command.name for command in self.commands if command.gain]
        for name in names:
            known_name("commands: unknown command", name, allowed)
        if not names or len(set(names)) != len(names):
            raise InputError(f"commands: {tuple(names)} must be one or more distinct commands")

    def check_period(self, timestep: float, num_substeps: int) -> None:
        """Checks that `num_substeps` physics steps of `timestep`, s, are one period.

        InputError if they are not.
        """
        step = timestep * num_substeps
        if not math.isclose(step, self.period):
            raise InputError(
                f"Scene.timestep: {timestep} s x {num_substeps} substeps is {step:g} s; "
                f"the period of the skill {self.name!r} is {self.period} s"
            )


SKILLS: dict[str, type[Skill]] = {}
"""Skills by name."""


S = TypeVar("S", bound=Skill)


def register(skill: type[S]) -> type[S]:
    """Registers a class under its `name`, for `make(task, skill=name)`, and returns it.

    Raises:
        InputError: for anything else, or if another class is registered under it.
    """
    derived = isinstance(skill, type) and issubclass(skill, Skill)
    if not derived or not isinstance(getattr(skill, "name", None), str):
        fail("skill", skill, "a class derived from Skill, with a name")
    if SKILLS.setdefault(skill.name, skill) is not skill:
        raise InputError(f"skill: the name {skill.name!r} is already registered")
    return skill


def make(name: str | Sequence[str], robot: Robot) -> Skill:
    """Returns a skill of a robot, or a `Choice` of several.

    InputError for an unknown name, with the nearest one.

    Example:
        ```python
        from mqe_jax import skills
        from mqe_jax.physics import robots

        walk = skills.make("walk", robots.get("go1"))
        print([command.name for command in walk.commands])  # vx, vy, yaw_rate, ...
        ```
    """
    from mqe_jax.skills.choice import Choice

    if not isinstance(name, str):
        return Choice(robot, [make(each, robot) for each in name])
    return SKILLS[known_name("skill: unknown name", name, SKILLS)](robot)
