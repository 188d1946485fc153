"""Control: from agents' actions to actuator targets (`mqe_jax.actuators` applies them).

| mode | per robot | meaning |
|---|---|---|
| `command` | one number per command that the action sets (3) | commands for the skill, by default velocities to walk |
| `position` | 12 | joint target = default + scale x action, then PD at every physics step |
| `torque` | 12 | joint torque = action x torque limit |

Actions lie in [-1, 1]. PD control runs inside the physics engine, at every physics step.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.errors import InputError, nearest
from mqe_jax.robots.index import Proprioception, placed
from mqe_jax.robots.robot import NUM_JOINTS, Robot
from mqe_jax.skills import Skill

MODES = ("command", "position", "torque")


def check_mode(mode: str) -> str:
    """Returns the mode, or raises an InputError that names the allowed ones."""
    if mode not in MODES:
        raise InputError(f"control: unknown mode {mode!r}{nearest(mode, MODES)}; allowed: {', '.join(MODES)}")
    return mode


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ControlState:
    """Controller state of one environment (R robots)."""

    skill: Any
    """Recurrent states of the skill, leading axis R; () if no robot uses it."""
    delayed: jax.Array
    """Past actuator targets, newest first (lag + 1, R, 12)."""


@dataclasses.dataclass(frozen=True)
class Controller:
    """Computes actuator targets from actions."""

    mode: str
    """Action mode: one of `MODES`."""
    robot: Robot
    """Robot type shared by all R robots."""
    num_robots: int
    """Number of robots R."""
    num_agents: int
    """Number of agents A: the first A robots."""
    skill: Skill
    """Skill of the agents in the mode `command`, and of the NPC robots in every mode."""
    skill_params: Any
    """Parameters of the skill, or None if no robot uses it."""
    commands: tuple[str, ...]
    """Commands that the action sets, in order."""
    default_commands: np.ndarray
    """Default commands of the skill (C,)."""
    lag: int = 0
    """Maximum action lag, environment steps."""
    position_scale: float = 1.0
    """Factor on the range of the joint targets in the mode `position`."""

    @property
    def action_size(self) -> int:
        """Length of one agent's action."""
        return len(self.commands) if self.mode == "command" else NUM_JOINTS

    @property
    def neutral(self) -> np.ndarray:
        """Neutral actuator targets (R, 12), used without an action."""
        rest = np.tile(self.robot.default_joints, (self.num_robots, 1)).astype(np.float32)
        if self.mode == "torque":
            rest[: self.num_agents] = 0.0
        return rest

    def reset(self) -> ControlState:
        """Returns the controller state after a reset."""
        memory = () if self.skill_params is None else self.skill.init_memory()
        memory = jax.tree.map(lambda x: jnp.broadcast_to(x, (self.num_robots, *x.shape)), memory)
        return ControlState(memory, jnp.tile(jnp.asarray(self.neutral), (self.lag + 1, 1, 1)))

    def clock(self, state: ControlState) -> jax.Array:
        """Returns the clocks of the robots' skills (R, n); n is 0 if no robot uses the skill."""
        if self.skill_params is None:
            return jnp.zeros((self.num_robots, 0))
        return jax.vmap(self.skill.clock, axis_size=self.num_robots)(state.skill)

    def skill_commands(self, action: jax.Array) -> jax.Array:
        """Computes the skill's commands (A, C) around the defaults from actions (A, action_size) in [-1, 1]."""
        gain, limit = (self.skill.column(field, self.commands) for field in ("gain", "limit"))
        change = jnp.clip(gain * action, -limit, limit)
        default, columns = self.default_commands, self.skill.index(self.commands)
        return jax.vmap(lambda change: placed(default, columns, default[columns] + change))(change)

    @jax.named_scope("control")
    def targets(
        self,
        state: ControlState,
        action: jax.Array,
        proprioception: Proprioception,
        npc_commands: jax.Array | None = None,
        lag: jax.Array | int = 0,
    ) -> tuple[jax.Array, ControlState]:
        """Computes the actuator targets (R, 12) of all robots from the agents' actions.

        Args:
            state: control state.
            action: of the A agents, the first robots (A, action_size), in [-1, 1].
            proprioception: of all robots, leading axis R.
            npc_commands: the skill's commands for the NPC robots (R - A, C), if there are any.
            lag: delay of the targets, environment steps ().
        """
        agents, memory = self.num_agents, state.skill
        target = jnp.asarray(self.neutral)
        commands = jnp.tile(jnp.asarray(self.default_commands), (agents, 1))
        if self.mode == "command":
            commands = self.skill_commands(action)
        elif self.mode == "position":
            target = target.at[:agents].set(self.robot.joint_targets(action, self.position_scale))
        else:
            target = target.at[:agents].set(action * self.robot.torque_limit)
        if self.skill_params is not None:
            if npc_commands is not None:
                commands = jnp.concatenate([commands, npc_commands])
            act = functools.partial(self.skill.targets, self.skill_params)
            skilled, memory = jax.vmap(act)(memory, commands, proprioception)
            uses = np.arange(len(skilled))[:, None] >= (0 if self.mode == "command" else agents)
            target = jnp.where(uses, skilled, target)
        delayed = jnp.concatenate([target[None], state.delayed[:-1]])
        return (delayed[lag] if self.lag else target), ControlState(memory, delayed)
