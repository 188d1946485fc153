"""Control: from agents' actions to actuator targets.

| mode | per robot | meaning |
|---|---|---|
| `command` | one per command of the action (3) | the skill's commands, by default velocities |
| `position` | J | joint target = default + scale x action, then PD at every physics step |
| `torque` | J | joint torque = action x torque limit |

J is the number of a robot's joints, of unlike robots the largest one. Actions lie in [-1, 1]. In
`command`, a positive action is scaled by the highest change of the command, a negative one by the
lowest, both times the skill's gain / limit. Unlike robots get the same commands, except for those
that no action sets and that depend on the robot, such as the width of the stance. PD control runs
inside the physics engine, at every physics step.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from mqe_jax.core.errors import InputError, known_name
from mqe_jax.core.settings import fail
from mqe_jax.core.types import rows_of
from mqe_jax.physics.robots.fleet import Fleet, pad
from mqe_jax.physics.robots.index import Proprioception, scatter
from mqe_jax.skills import Skill

MODES = ("command", "position", "torque")


def check_mode(mode: str) -> str:
    """Returns the mode, or raises an InputError that names the allowed ones."""
    return known_name("control: unknown mode", mode, MODES)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ControlState:
    """Controller state of one environment (R robots)."""

    skill: Any
    """Recurrent states of the skill, leading axis R; () if no robot uses it; a tuple, of those of
    each group, if there are several."""
    delayed: jax.Array  # past actuator targets, newest first (lag + 1, R, J)


@dataclasses.dataclass(frozen=True)
class Commander:
    """What an agent's actions mean in the mode `command`."""

    skill: Skill  # skill of the agents
    commands: tuple[str, ...]  # commands that the action sets, in order
    default_commands: np.ndarray  # default commands of the skill (C,)
    ranges: Mapping[str, tuple[float, float]]
    """Lowest and highest value of some of `commands`; the rest have the skill's default ranges."""

    def skill_commands(self, action: jax.Array) -> jax.Array:
        """Computes the skill's commands (A, C) from actions (A, action_size) in [-1, 1]."""
        default = self.default_commands
        columns = self.skill.index(self.commands)

        def of_agent(change: Any) -> jax.Array:
            return scatter(default, columns, default[columns] + change)

        return self.skill.limit_turn(jax.vmap(of_agent)(self.change(action)))

    def action_of(self, change: jax.Array) -> jax.Array:
        """Computes the actions (..., action_size) that change the commands from the defaults.

        `change` is (..., action_size).
        """
        down, up = np.where(self.slopes > 0, 1.0 / np.maximum(self.slopes, 1e-9), 0.0)
        return jnp.clip(jnp.where(change < 0, down, up) * change, -1.0, 1.0)

    def change(self, action: jax.Array) -> jax.Array:
        """Computes the changes of the commands (..., action_size) that actions ask for.

        They are differences from the default commands.
        """
        down, up = self.slopes
        low, high = self.changes.T
        return jnp.clip(jnp.where(action < 0, down, up) * action, low, high)

    def admits(self, other: Commander) -> bool:
        """Returns whether actions can have the skill of `other` act with all its commands.

        That skill must be one of the skills here.
        """
        names = other.commands
        skills = [part.name for part in self.skill.parts]
        if names != self.commands[: len(names)] or other.skill.name not in skills:
            return False
        low, high = other.limits.T
        least, most = self.limits[: len(names)].T
        return bool(np.all((low >= least - 1e-6) & (high <= most + 1e-6)))

    def translate(self, action: jax.Array, other: Commander) -> jax.Array:
        """Computes the actions that give here the commands of actions (..., n) of `other`.

        This commander must admit `other`.
        """
        entries = self.skill.select(other.skill.name)
        if not entries and np.array_equal(self.changes, other.changes):
            return action
        here = (self.limits - self.changes)[: len(other.commands)]
        shift = (other.limits - other.changes - here)[:, 0]  # between the default commands
        entries = jnp.broadcast_to(jnp.array(entries), (*action.shape[:-1], len(entries)))
        return self.action_of(jnp.concatenate([other.change(action) + shift, entries], axis=-1))

    @property
    def limits(self) -> np.ndarray:
        """Lowest and highest value of each of `commands` (n, 2)."""
        return self.default_commands[self.skill.index(self.commands), None] + self.changes

    @functools.cached_property
    def changes(self) -> np.ndarray:
        """Lowest and highest change of each of `commands` by an action (n, 2)."""
        return self.skill.changes(self.commands, self.ranges, self.default_commands)

    @property
    def slopes(self) -> np.ndarray:
        """Change of each command per unit of a negative and of a positive action (2, n)."""
        gain = self.skill.column("gain", self.commands)
        limit = self.skill.column("limit", self.commands)
        return np.abs(self.changes.T) * (gain / limit)


class Group(NamedTuple):
    """Robots of one kind that use a skill."""

    skill: Skill
    params: Any
    """Parameters of the skill."""
    robots: tuple[int, ...]
    """Their numbers among all robots."""
    shift: np.ndarray
    """What is added to the commands, since the robots' defaults differ from others' (C,)."""


@dataclasses.dataclass(frozen=True)
class Controller(Commander):
    """Computes actuator targets from actions."""

    mode: str  # action mode: one of `MODES`
    robots: Fleet  # all R robots
    num_agents: int  # number of agents A: the first A robots
    groups: tuple[Group, ...]  # the robots that use a skill
    npc: Skill | None = None
    """Skill of the NPC robots, if it is another one than the agents'."""
    lag: int = 0  # maximum action lag, environment steps
    position_scale: float = 1.0  # factor on the range of the joint targets in the mode `position`

    @property
    def action_size(self) -> int:
        """Length of one agent's action."""
        if self.mode == "command":
            return len(self.commands)
        return Fleet(self.robots[: self.num_agents]).num_joints

    @property
    def skilled(self) -> bool:
        """Whether the agents' skill acts."""
        return any(group.robots[0] < self.num_agents for group in self.groups)

    @property
    def neutral(self) -> np.ndarray:
        """Neutral actuator targets (R, J), used without an action."""
        rest = self.robots.table("default_joints").astype(np.float32)
        if self.mode == "torque":
            rest[: self.num_agents] = 0.0
        return rest

    def check_action(self, action: jax.Array, size: int) -> jax.Array:
        """Returns actions (A, size) as an array.

        InputError for others, or known ones that are not finite.
        """
        try:
            action = jnp.asarray(action)
        except (TypeError, ValueError, OverflowError):
            fail("action", action, "an array of numbers")
        shape = (self.num_agents, size)
        if action.shape != shape:
            raise InputError(
                f"action: shape {action.shape}; expected {shape} (agents, action size)"
            )
        if not jnp.issubdtype(action.dtype, jnp.floating):
            raise InputError(f"action: dtype {action.dtype}; expected a floating-point type")
        # Under jit the result is traced even if the action is a captured constant.
        finite = jnp.all(jnp.isfinite(action))
        if not isinstance(finite, Tracer) and not bool(finite):
            raise InputError("action: contains NaN or infinity; expected numbers in [-1, 1]")
        return action

    def reset(self) -> ControlState:
        """Returns the controller state after a reset."""

        def start(group: Group) -> Any:
            count = len(group.robots)
            return jax.tree.map(
                lambda x: jnp.broadcast_to(x, (count, *x.shape)), group.skill.init_memory()
            )

        delayed = jnp.tile(jnp.asarray(self.neutral), (self.lag + 1, 1, 1))
        return ControlState(_one_or_all([start(group) for group in self.groups]), delayed)

    def clock(self, state: ControlState) -> jax.Array:
        """Returns the clocks of the robots' skills (R, n); n is 0 if no robot uses the skill."""
        clocks = []
        for group, memory in zip(self.groups, self._memories(state), strict=True):
            clocks.append(jax.vmap(group.skill.clock, axis_size=len(group.robots))(memory))
        width = max((clock.shape[1] for clock in clocks), default=0)
        rest = jnp.zeros((len(self.robots), width))
        return self._merge(rest, [pad(clock, width) for clock in clocks])

    def _merge(self, rest: jax.Array, of_groups: Sequence[jax.Array], first: int = 0) -> jax.Array:
        """Returns rows `rest` (R, n), with those of the groups for robots from `first` on."""
        rows = np.arange(len(rest))
        at = len(rest)
        for group in self.groups:
            own = np.array(group.robots)
            rows[own] = np.where(own < first, own, at + np.arange(len(own)))
            at += len(own)
        return jnp.concatenate([rest, *of_groups])[rows_of(rows.tolist())]

    @jax.named_scope("control")
    def targets(
        self,
        state: ControlState,
        action: jax.Array,
        proprioception: Proprioception,
        npc_commands: jax.Array | None = None,
        lag: jax.Array | int = 0,
    ) -> tuple[jax.Array, ControlState]:
        """Computes the actuator targets (R, J) of all robots from the agents' actions.

        Args:
            state: control state.
            action: of the A agents, the first robots (A, action_size), in [-1, 1].
            proprioception: of all robots, leading axis R.
            npc_commands: commands for the NPC robots (R - A, C) of their skill, if there are any.
            lag: delay of the targets, environment steps ().
        """
        agents = self.num_agents
        target = jnp.asarray(self.neutral)
        commands = jnp.tile(jnp.asarray(self.default_commands), (agents, 1))
        if self.mode == "command":
            commands = self.skill_commands(action)
        elif self.mode == "position":
            moved = self.robots.joint_targets(action, self.position_scale)
            target = target.at[:agents].set(pad(moved, target.shape[1]))
        else:
            moved = action * self.robots.table("torque_limit")[:agents, : action.shape[1]]
            target = target.at[:agents].set(pad(moved, target.shape[1]))
        skilled = []
        memories = []
        for group, memory in zip(self.groups, self._memories(state), strict=True):
            sensed = proprioception.of(rows_of(group.robots), group.skill.robot.num_joints)
            act = jax.vmap(functools.partial(group.skill.targets, group.params))
            targets, memory = act(memory, self._asked(group, commands, npc_commands), sensed)
            skilled.append(pad(targets, target.shape[1]))
            memories.append(memory)
        target = self._merge(target, skilled, 0 if self.mode == "command" else agents)
        delayed = jnp.concatenate([target[None], state.delayed[:-1]])
        control = ControlState(_one_or_all(memories), delayed)
        if self.lag:
            target = delayed[lag]
        return target, control

    def _asked(
        self, group: Group, commands: jax.Array, npc_commands: jax.Array | None
    ) -> jax.Array:
        """Returns the commands of a group's robots, from those of the agents and the NPC robots."""
        numbers = np.array(group.robots)
        if self.npc and numbers[0] >= self.num_agents:
            numbers -= self.num_agents
            assert npc_commands is not None
            commands = npc_commands
        elif npc_commands is not None and not self.npc:
            commands = jnp.concatenate([commands, npc_commands])
        own = commands[rows_of(numbers.tolist())]
        return own + group.shift if np.any(group.shift) else own

    @property
    def npc_skill(self) -> Skill:
        """Skill of the NPC robots."""
        return self.npc or self.skill

    @property
    def npc_default_commands(self) -> np.ndarray:
        """Default commands of the NPC robots' skill (C,)."""
        return self.npc.default_commands() if self.npc else self.default_commands

    def _memories(self, state: ControlState) -> Sequence[Any]:
        """Returns the recurrent states of the groups."""
        if len(self.groups) > 1:
            return state.skill
        return [state.skill] if self.groups else []


def _one_or_all(memories: Sequence[Any]) -> Any:
    """Returns the recurrent state of one group, or those of several; () without one."""
    return memories[0] if len(memories) == 1 else tuple(memories)
