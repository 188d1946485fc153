"""The protocol of skills: commands and proprioception of one robot to joint targets."""

from __future__ import annotations

import abc
import math
import os
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.errors import InputError, nearest
from mqe_jax.robots.robot import Robot


class Command(NamedTuple):
    """One command of a skill. An action of 1 adds `gain` to the default, clipped to +-`limit`."""

    name: str
    unit: str
    default: float | None
    """None: depends on the robot."""
    gain: float = 0.0
    """Change per unit of action, in the command's unit; 0 if actions cannot set the command."""
    limit: float = 0.0
    """Greatest change by an action, in the command's unit."""
    scale: float = 1.0
    """Factor in the skill's observation."""
    mirror: float = 1.0
    """Sign under reflection of left and right."""


class Proprioception(NamedTuple):
    """What a skill senses of one robot."""

    gravity_b: jax.Array
    """Unit gravity vector in the trunk frame (3,)."""
    joint_position: jax.Array
    """(12,), rad."""
    joint_velocity: jax.Array
    """(12,), rad/s."""


class Skill(abc.ABC):
    """A low-level policy for one type of robot, with C commands; functions of one robot, to be batched by `jax.vmap`.

    A skill defines `name`, `commands`, `period`, `init_memory` and `targets`; `load_params` if it has weights.
    """

    name: ClassVar[str]
    """Name of the skill in the registry; prefix of its recurrent states in an exported graph."""
    commands: ClassVar[tuple[Command, ...]]
    """Its commands, in order."""
    period: ClassVar[float] = 0.02
    """Environment step, s."""
    gaits: ClassVar[Mapping[str, Mapping[str, float]]] = {}
    """Named sets of default commands; the first is the default."""
    clock_size: ClassVar[int] = 0
    """Length of `clock`."""
    robot: Robot
    """Robot type."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot

    # -- defined by each skill ----------------------------------------------------------------------------------

    @abc.abstractmethod
    def init_memory(self) -> Any:
        """Returns the recurrent state after a reset: a dataclass or dictionary of arrays of zeros, or ()."""

    @abc.abstractmethod
    def targets(
        self, params: Any, memory: Any, command: jax.Array, proprioception: Proprioception
    ) -> tuple[jax.Array, Any]:
        """Computes joint targets (12,), rad, and the next recurrent state.

        Args:
            params: from `load_params`.
            memory: recurrent state.
            command: (C,).
            proprioception: of the robot.
        """

    def load_params(self, path: str | os.PathLike[str] | None = None) -> Any:
        """Reads the weights from a file; those shipped for the robot if `path` is None.

        Raises:
            InputError: if the file cannot be read, or the skill has no weights.
        """
        if path is not None:
            raise InputError(f"skill_weights: the skill {self.name!r} has no weights")
        return ()

    def clock(self, memory: Any) -> jax.Array:
        """Returns the part of the recurrent state that critics see (clock_size,)."""
        return jnp.zeros(0)

    def robot_defaults(self) -> Mapping[str, float]:
        """Returns the default commands that depend on the robot."""
        return {}

    # -- common to all skills -----------------------------------------------------------------------------------

    def default_commands(self, gait: str | None = None, **values: float) -> np.ndarray:
        """Returns the default commands (C,) of a gait, with single values replaced.

        Raises:
            InputError: for an unknown gait or command.
        """
        if gait is not None and gait not in self.gaits:
            allowed = ", ".join(self.gaits) or f"none with the skill {self.name!r}"
            raise InputError(f"gait: unknown name {gait!r}{nearest(gait, self.gaits)}; allowed: {allowed}")
        own, first = self.robot_defaults(), next(iter(self.gaits), None)
        default = np.array([own.get(c.name, c.default) for c in self.commands], np.float32)
        values = {**self.gaits.get(gait or first or "", {}), **values}
        if values:
            default[self.index(values)] = list(values.values())
        return default

    @classmethod
    def index(cls, names: Sequence[str] | Mapping[str, Any]) -> np.ndarray:
        """Returns the positions of commands in the vector of commands; InputError for an unknown name."""
        known = [command.name for command in cls.commands]
        for name in names:
            if name not in known:
                raise InputError(
                    f"{cls.name} command: unknown name {name!r}{nearest(name, known)}; allowed: {', '.join(known)}"
                )
        return np.array([known.index(name) for name in names])

    @classmethod
    def check_commands(cls, names: Sequence[str]) -> tuple[str, ...]:
        """Returns the commands that the action sets, or raises an InputError that names the allowed ones."""
        allowed = [command.name for command in cls.commands if command.gain]
        for name in names:
            if name not in allowed:
                hint = nearest(name, allowed)
                raise InputError(f"commands: unknown command {name!r}{hint}; allowed: {', '.join(allowed)}")
        if not names or len(set(names)) != len(names):
            raise InputError(f"commands: {tuple(names)} must be one or more distinct commands")
        return tuple(names)

    @classmethod
    def ranges(cls, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """Returns gains and limits (n,) of commands, in each command's unit."""
        chosen = [cls.commands[i] for i in cls.index(names)]
        return np.array([c.gain for c in chosen], np.float32), np.array([c.limit for c in chosen], np.float32)

    @classmethod
    def commands_from_action(cls, action: jax.Array, names: Sequence[str], default: np.ndarray) -> jax.Array:
        """Computes commands (A, C) around the defaults (C,) from actions (A, len(names)) in [-1, 1]."""
        gain, limit = cls.ranges(names)
        change = jnp.clip(gain * action, -limit, limit)
        return jnp.tile(jnp.asarray(default), (action.shape[0], 1)).at[:, cls.index(names)].add(change)

    @classmethod
    def check_period(cls, timestep: float, num_substeps: int) -> None:
        """Checks that `num_substeps` physics steps of `timestep` (s) are one period; raises an InputError."""
        period = timestep * num_substeps
        if not math.isclose(period, cls.period):
            raise InputError(
                f"Scene.timestep: {timestep} s x {num_substeps} substeps is {period:g} s; "
                f"the period of the skill {cls.name!r} is {cls.period} s"
            )


def joint_targets(robot: Robot, action: jax.Array, scale: float = 1.0) -> jax.Array:
    """Computes joint targets (..., 12), rad, from actions (..., 12): default + `scale` x the robot's scale x action."""
    return jnp.asarray(robot.default_joints) + scale * robot.action_scale * action
