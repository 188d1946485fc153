"""Control: from agents' actions to actuator targets.

| mode | per robot | meaning |
|---|---|---|
| `command` | one number per command that the action sets (3) | velocity (and gait) commands for the walk policy |
| `position` | 12 | joint target = default + scale x action, then PD at every physics step |
| `torque` | 12 | joint torque = action x torque limit |

Actions lie in [-1, 1]. PD control runs inside the physics engine, at every physics step.
"""

from __future__ import annotations

import dataclasses
import functools
import os
import pathlib
from collections.abc import Sequence
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax import walk_policy
from mqe_jax.engines import Engine
from mqe_jax.errors import InputError, nearest
from mqe_jax.robots.index import RobotIndex
from mqe_jax.robots.robot import NUM_JOINTS, Robot
from mqe_jax.walk_policy import WalkMemory

if TYPE_CHECKING:
    from mujoco import mjx

MODES = ("command", "position", "torque")

# Per-command action scaling around the default: (scale, clip), in the command's unit.
COMMAND_RANGES = {
    "vx": (2.0, 1.0),
    "vy": (0.5, 0.5),
    "yaw_rate": (0.5, 0.5),
    "body_height": (0.12, 0.12),
    "gait_frequency": (1.0, 1.0),
    "footswing_height": (0.08, 0.08),
    "pitch": (0.25, 0.25),
    "roll": (0.1, 0.1),
    "stance_width": (0.1, 0.1),
    "stance_length": (0.06, 0.06),
}


def check_mode(mode: str) -> str:
    """Returns the mode, or raises an InputError that names the allowed ones."""
    if mode not in MODES:
        raise InputError(f"control: unknown mode {mode!r}{nearest(mode, MODES)}; allowed: {', '.join(MODES)}")
    return mode


def check_commands(names: Sequence[str]) -> tuple[str, ...]:
    """Returns the commands that the action sets, or raises an InputError that names the allowed ones."""
    for name in names:
        if name not in COMMAND_RANGES:
            allowed = ", ".join(COMMAND_RANGES)
            raise InputError(f"commands: unknown command {name!r}{nearest(name, COMMAND_RANGES)}; allowed: {allowed}")
    if not names or len(set(names)) != len(names):
        raise InputError(f"commands: {tuple(names)} must be one or more distinct commands")
    return tuple(names)


def commands_from_action(action: jax.Array, names: Sequence[str], default: np.ndarray) -> jax.Array:
    """Computes walk commands (A, 15) around the defaults (15,) from actions (A, len(names)) in [-1, 1]."""
    gain = np.array([COMMAND_RANGES[name][0] for name in names], np.float32)
    limit = np.array([COMMAND_RANGES[name][1] for name in names], np.float32)
    index = np.array([walk_policy.command_index(name) for name in names])
    change = jnp.clip(gain * action, -limit, limit)
    return jnp.tile(jnp.asarray(default), (action.shape[0], 1)).at[:, index].add(change)


ActuatorParams = dict[str, dict[str, jax.Array]]


def load_actuator_network(path: str | os.PathLike[str]) -> ActuatorParams:
    """Reads an actuator network (6-32-32-1, softsign) from safetensors: `0.weight` (32, 6), `0.bias`, `2...`, `4...`.

    Raises:
        InputError: if the file is missing, damaged, or holds other names or shapes.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    file = pathlib.Path(path)
    if not file.is_file():
        raise InputError(f"actuator_network: no file {file}")
    try:
        flat = load_file(file)
    except SafetensorError as error:
        raise InputError(f"actuator_network {file}: not a safetensors file ({error})") from None
    params: ActuatorParams = {}
    for layer, (n_in, n_out) in zip(("0", "2", "4"), ((6, 32), (32, 32), (32, 1)), strict=True):
        for kind, shape in (("weight", (n_out, n_in)), ("bias", (n_out,))):
            name = f"{layer}.{kind}"
            found = tuple(flat[name].shape) if name in flat else "nothing"
            if found != shape:
                raise InputError(f"actuator_network {file}: {name} has shape {found}; expected {shape}")
            params.setdefault(layer, {})[kind] = jnp.asarray(flat[name], jnp.float32)
    return params


def actuator_torque(params: ActuatorParams, error: jax.Array, velocity: jax.Array) -> jax.Array:
    """Computes joint torques (...), N m, by the actuator network.

    Args:
        params: weights of the network.
        error: joint position minus target at this physics step and the two before (3, ...), rad.
        velocity: joint velocity likewise (3, ...), rad/s.
    """
    x = jnp.moveaxis(jnp.concatenate([error, velocity]), 0, -1)
    for layer in ("0", "2"):
        x = jax.nn.soft_sign(jnp.matmul(x, params[layer]["weight"].T, precision="highest") + params[layer]["bias"])
    return (jnp.matmul(x, params["4"]["weight"].T, precision="highest") + params["4"]["bias"])[..., 0]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ControlState:
    """Controller state of one environment (R robots)."""

    walk: WalkMemory | None
    """Recurrent states of the walk policies, leading axis R; None if no robot uses one."""
    delayed: jax.Array
    """Past actuator targets, newest first (lag + 1, R, 12)."""
    error: jax.Array
    """Joint position errors of the last two physics steps (2, R, 12), rad; empty without an actuator network."""
    velocity: jax.Array
    """Joint velocities of the last two physics steps (2, R, 12), rad/s; empty without an actuator network."""


@dataclasses.dataclass(frozen=True)
class Controller:
    """Computes actuator targets from actions and steps the physics under them."""

    mode: str
    """Action mode: one of `MODES`."""
    robot: Robot
    """Robot type shared by all R robots."""
    physics: Engine
    """Physics of the environment."""
    index: RobotIndex
    """Index tables of the robots."""
    num_agents: int
    """Number of agents A: the first A robots."""
    walk_params: walk_policy.Params | None
    """Weights of the walk policy, or None if it is not used."""
    actuator_params: ActuatorParams | None
    """Weights of the actuator network, or None for PD."""
    commands: tuple[str, ...]
    """Commands that the action sets, in order."""
    default_commands: np.ndarray
    """Default commands of the walk policy (15,)."""
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
        rest = np.tile(self.robot.default_joints, (self.index.num_robots, 1)).astype(np.float32)
        if self.mode == "torque":
            rest[: self.num_agents] = 0.0
        return rest

    def reset(self) -> ControlState:
        """Returns the controller state after a reset."""
        robots = self.index.num_robots
        walk = None
        if self.walk_params is not None:
            walk = jax.tree.map(lambda x: jnp.broadcast_to(x, (robots, *x.shape)), walk_policy.initial_memory())
        past = jnp.zeros((2 if self.actuator_params is not None else 0, robots, NUM_JOINTS))
        return ControlState(walk, jnp.tile(jnp.asarray(self.neutral), (self.lag + 1, 1, 1)), past, past)

    def targets(
        self,
        state: ControlState,
        action: jax.Array,
        gravity_b: jax.Array,
        joint_position: jax.Array,
        joint_velocity: jax.Array,
        npc_commands: jax.Array | None = None,
    ) -> tuple[jax.Array, ControlState]:
        """Computes the actuator targets (R, 12) of all robots from the agents' actions.

        Args:
            state: control state.
            action: of the A agents, the first robots (A, action_size), in [-1, 1].
            gravity_b: unit gravity vectors (R, 3).
            joint_position: (R, 12), rad.
            joint_velocity: (R, 12), rad/s.
            npc_commands: walk commands of the NPC robots (R - A, 15), if there are any.
        """
        agents = self.num_agents
        target = jnp.asarray(self.neutral)
        commands = jnp.zeros((agents, 15)) + self.default_commands
        if self.mode == "command":
            commands = commands_from_action(action, self.commands, self.default_commands)
        elif self.mode == "position":
            target = target.at[:agents].set(walk_policy.joint_targets(self.robot, action, self.position_scale))
        else:
            target = target.at[:agents].set(action * self.robot.torque_limit)
        if self.walk_params is None or state.walk is None:
            return target, state
        if npc_commands is not None:
            commands = jnp.concatenate([commands, npc_commands])
        act = functools.partial(walk_policy.walk, self.robot, self.walk_params)
        walked, walk = jax.vmap(act)(state.walk, commands, gravity_b, joint_position, joint_velocity)
        walks = np.arange(len(walked))[:, None] >= (0 if self.mode == "command" else agents)
        return jnp.where(walks, walked, target), dataclasses.replace(state, walk=walk)

    def apply(
        self,
        state: ControlState,
        data: mjx.Data,
        target: jax.Array,
        lag: jax.Array,
        fields: dict[str, jax.Array],
        xfrc_applied: jax.Array | None,
    ) -> tuple[mjx.Data, ControlState, jax.Array]:
        """Advances the physics by one environment step with targets (R, 12) delayed by `lag` () steps.

        Returns:
            Physics state, control state, and whether any physics step may have dropped contacts () bool.
        """
        delayed = jnp.concatenate([target[None], state.delayed[:-1]])
        target = delayed[lag] if self.lag else target
        state = dataclasses.replace(state, delayed=delayed)
        scatter = lambda values: jnp.zeros(self.physics.model.nu).at[self.index.actuator].set(values)  # noqa: E731
        params = self.actuator_params
        if params is None:
            data, overflow = self.physics.step(data, scatter(target), fields=fields, xfrc_applied=xfrc_applied)
            return data, state, overflow

        def substep(
            carry: tuple[mjx.Data, jax.Array, jax.Array], _: None
        ) -> tuple[tuple[mjx.Data, jax.Array, jax.Array], jax.Array]:
            data, errors, velocities = carry
            errors = jnp.concatenate([(data.qpos[self.index.joint_qpos] - target)[None], errors])
            velocities = jnp.concatenate([data.qvel[self.index.joint_qvel][None], velocities])
            limit = self.robot.torque_limit
            torque = jnp.clip(actuator_torque(params, errors, velocities), -limit, limit)
            data, overflow = self.physics.step(
                data, scatter(torque), fields=fields, xfrc_applied=xfrc_applied, num_substeps=1
            )
            return (data, errors[:2], velocities[:2]), overflow

        (data, error, velocity), overflow = jax.lax.scan(
            substep, (data, state.error, state.velocity), None, self.physics.num_substeps
        )
        return data, dataclasses.replace(state, error=error, velocity=velocity), jnp.any(overflow)
