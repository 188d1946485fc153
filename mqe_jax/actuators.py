"""Actuators: joint targets or torques of all robots to the engine's control, and the physics under them."""

from __future__ import annotations

import abc
import dataclasses
import os
import pathlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from mqe_jax.engines import Engine
from mqe_jax.errors import InputError
from mqe_jax.robots.index import RobotIndex
from mqe_jax.robots.robot import NUM_JOINTS, Robot

if TYPE_CHECKING:
    from mujoco import mjx


@dataclasses.dataclass(frozen=True)
class Actuators(abc.ABC):
    """The actuators of R robots of one type."""

    physics: Engine
    """Engine of the environment."""
    index: RobotIndex
    """Index tables of the robots."""

    def control(self, values: jax.Array) -> jax.Array:
        """Returns the engine's control (nu,) from values of all robots (R, 12)."""
        return jnp.zeros(self.physics.model.nu).at[self.index.actuator].set(values)

    @abc.abstractmethod
    def init_memory(self) -> Any:
        """Returns the actuators' recurrent state after a reset."""

    @abc.abstractmethod
    def step(
        self,
        data: mjx.Data,
        memory: Any,
        target: jax.Array,
        fields: Mapping[str, jax.Array],
        xfrc_applied: jax.Array | None,
    ) -> tuple[mjx.Data, Any, jax.Array]:
        """Advances the physics by one environment step.

        Args:
            data: physics state.
            memory: recurrent state.
            target: actuator targets (R, 12).
            fields: as in `Engine.step`.
            xfrc_applied: as in `Engine.step`.

        Returns:
            Physics state, recurrent state, and the engine's overflow flag () bool.
        """


class EngineActuators(Actuators):
    """The actuators of the compiled model, PD or torque, which the engine evaluates at every physics step."""

    def init_memory(self) -> None:
        return None

    def step(
        self,
        data: mjx.Data,
        memory: None,
        target: jax.Array,
        fields: Mapping[str, jax.Array],
        xfrc_applied: jax.Array | None,
    ) -> tuple[mjx.Data, None, jax.Array]:
        data, overflow = self.physics.step(data, self.control(target), fields=fields, xfrc_applied=xfrc_applied)
        return data, None, overflow


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
class NetworkMemory:
    """The last two physics steps of R robots."""

    error: jax.Array
    """Joint position errors (2, R, 12), rad."""
    velocity: jax.Array
    """Joint velocities (2, R, 12), rad/s."""


@dataclasses.dataclass(frozen=True)
class NetworkActuators(Actuators):
    """An actuator network, which computes torques from joint targets at every physics step."""

    robot: Robot
    """Robot type."""
    params: ActuatorParams
    """Weights of the network."""

    def init_memory(self) -> NetworkMemory:
        past = jnp.zeros((2, self.index.num_robots, NUM_JOINTS))
        return NetworkMemory(past, past)

    def step(
        self,
        data: mjx.Data,
        memory: NetworkMemory,
        target: jax.Array,
        fields: Mapping[str, jax.Array],
        xfrc_applied: jax.Array | None,
    ) -> tuple[mjx.Data, NetworkMemory, jax.Array]:
        def substep(carry: tuple[mjx.Data, NetworkMemory], _: None) -> tuple[tuple[mjx.Data, NetworkMemory], jax.Array]:
            data, memory = carry
            errors = jnp.concatenate([(data.qpos[self.index.joint_qpos] - target)[None], memory.error])
            velocities = jnp.concatenate([data.qvel[self.index.joint_qvel][None], memory.velocity])
            limit = self.robot.torque_limit
            torque = jnp.clip(actuator_torque(self.params, errors, velocities), -limit, limit)
            data, overflow = self.physics.step(
                data, self.control(torque), fields=fields, xfrc_applied=xfrc_applied, num_substeps=1
            )
            return (data, NetworkMemory(errors[:2], velocities[:2])), overflow

        (data, memory), overflow = jax.lax.scan(substep, (data, memory), None, self.physics.num_substeps)
        return data, memory, jnp.any(overflow)
