"""Actuators: targets of all robots' joints to the engine's control, and the physics under it."""

from __future__ import annotations

import dataclasses
import os
import pathlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core.errors import InputError
from mqe_jax.core.files import linear_layers, read_tensors
from mqe_jax.physics.engines import Engine
from mqe_jax.physics.robots.index import RobotIndex, placed
from mqe_jax.physics.robots.robot import NUM_JOINTS, Robot

if TYPE_CHECKING:
    from mujoco import mjx


@dataclasses.dataclass(frozen=True)
class Actuators:
    """The actuators of the compiled model, PD or torque, which the engine evaluates at every physics step."""

    physics: Engine
    """Physics of the environment."""
    index: RobotIndex
    """Index tables of the robots."""

    def control(self, values: jax.Array) -> jax.Array:
        """Returns the engine's control (nu,) from values of all robots (R, 12)."""
        return placed(np.zeros(self.physics.model.nu), self.index.actuator, values)

    def init_memory(self) -> Any:
        """Returns the recurrent state after a reset."""
        return ()

    def step(
        self,
        data: mjx.Data,
        memory: Any,
        target: jax.Array,
        fields: Mapping[str, jax.Array],
        xfrc_applied: jax.Array | None,
    ) -> tuple[mjx.Data, Any, jax.Array]:
        """Advances the physics by one environment step under targets (R, 12); other arguments as `Engine.step`.

        Returns:
            Physics state, recurrent state, and whether any physics step may have dropped contacts () bool.
        """
        data, overflow = self.physics.step(data, self.control(target), fields=fields, xfrc_applied=xfrc_applied)
        return data, memory, overflow


ActuatorParams = dict[str, dict[str, jax.Array]]


def load_actuator_network(path: str | os.PathLike[str]) -> ActuatorParams:
    """Reads an actuator network (6-32-32-1, softsign) from safetensors: `0.weight` (32, 6), `0.bias`, `2...`, `4...`.

    Raises:
        InputError: if the file is missing, damaged, or holds other names or shapes.
    """
    file = pathlib.Path(path)
    if not file.is_file():
        raise InputError(f"actuator_network: no file {file}")
    flat = read_tensors(file, "actuator_network")
    layers = linear_layers(f"actuator_network {file}", flat, {"0": (6, 32), "2": (32, 32), "4": (32, 1)})
    return jax.tree.map(jnp.asarray, layers)


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


@dataclasses.dataclass(frozen=True)
class NetworkActuators(Actuators):
    """An actuator network, which computes torques from joint targets at every physics step.

    Its recurrent state: joint position errors (rad) and velocities (rad/s) of the last two physics steps (2, R, 12).
    """

    robot: Robot
    """Robot type."""
    params: ActuatorParams
    """Weights of the network."""

    def init_memory(self) -> tuple[jax.Array, jax.Array]:
        past = jnp.zeros((2, self.index.num_robots, NUM_JOINTS))
        return past, past

    def step(
        self,
        data: mjx.Data,
        memory: tuple[jax.Array, jax.Array],
        target: jax.Array,
        fields: Mapping[str, jax.Array],
        xfrc_applied: jax.Array | None,
    ) -> tuple[mjx.Data, Any, jax.Array]:
        def substep(carry: Any, _: None) -> Any:
            data, (errors, velocities) = carry
            errors = jnp.concatenate([(data.qpos[self.index.joint_qpos] - target)[None], errors])
            velocities = jnp.concatenate([data.qvel[self.index.joint_qvel][None], velocities])
            limit = self.robot.torque_limit
            torque = self.control(jnp.clip(actuator_torque(self.params, errors, velocities), -limit, limit))
            data, overflow = self.physics.step(data, torque, fields=fields, xfrc_applied=xfrc_applied, num_substeps=1)
            return (data, (errors[:2], velocities[:2])), overflow

        (data, memory), overflow = jax.lax.scan(substep, (data, memory), None, self.physics.num_substeps)
        return data, memory, jnp.any(overflow)
