"""An actuator network: torques of all robots' joints from their targets, at every physics step."""

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
from mqe_jax.physics.robots.fleet import Fleet
from mqe_jax.physics.robots.index import RobotIndex, gather, scatter

if TYPE_CHECKING:
    from mujoco import mjx

ActuatorParams = dict[str, dict[str, jax.Array]]


def load_actuator_network(path: str | os.PathLike[str]) -> ActuatorParams:
    """Returns an actuator network (6-32-32-1, softsign) from a safetensors file.

    Its arrays are `0.weight` (32, 6), `0.bias` and those of layers `2` and `4`.

    InputError if the file is missing, damaged, or holds other names or shapes.
    """
    file = pathlib.Path(path)
    if not file.is_file():
        raise InputError(f"actuator_network: no file {file}")
    flat = read_tensors(file, "actuator_network")
    sizes = {"0": (6, 32), "2": (32, 32), "4": (32, 1)}
    return jax.tree.map(jnp.asarray, linear_layers(f"actuator_network {file}", flat, sizes))


def actuator_torque(params: ActuatorParams, error: jax.Array, velocity: jax.Array) -> jax.Array:
    """Returns joint torques (...), N m.

    `error`, joint position minus target, rad, and `velocity`, rad/s, are (3, ...): of this physics
    step and the two before.
    """

    def linear(layer: str, x: jax.Array) -> jax.Array:
        weight = params[layer]["weight"]
        return jnp.matmul(x, weight.T, precision="highest") + params[layer]["bias"]

    x = jnp.moveaxis(jnp.concatenate([error, velocity]), 0, -1)
    for layer in ("0", "2"):
        x = jax.nn.soft_sign(linear(layer, x))
    return linear("4", x)[..., 0]


@dataclasses.dataclass(frozen=True)
class NetworkActuators:
    """An actuator network, which computes torques from joint targets at every physics step.

    Its recurrent state: joint position errors (rad) and velocities (rad/s) of the last two physics
    steps (2, R, J).
    """

    physics: Engine
    index: RobotIndex
    robots: Fleet
    params: ActuatorParams

    def init_memory(self) -> tuple[jax.Array, jax.Array]:
        """Returns the recurrent state after a reset."""
        past = jnp.zeros((2, *self.index.joint_qpos.shape))
        return past, past

    def step(
        self,
        data: "mjx.Data",
        memory: tuple[jax.Array, jax.Array],
        target: jax.Array,
        fields: Mapping[str, jax.Array],
        xfrc_applied: jax.Array | None,
    ) -> "tuple[mjx.Data, Any, jax.Array]":
        """Advances the physics by one environment step under joint targets (R, J), rad.

        Returns as `Engine.step`, with the next recurrent state.
        """

        def substep(carry: Any, _: None) -> Any:
            data, (errors, velocities) = carry
            error = gather(data.qpos, self.index.joint_qpos) - target
            velocity = gather(data.qvel, self.index.joint_qvel)
            errors = jnp.concatenate([error[None], errors])
            velocities = jnp.concatenate([velocity[None], velocities])
            limit = self.robots.table("torque_limit")
            torque = jnp.clip(actuator_torque(self.params, errors, velocities), -limit, limit)
            ctrl = scatter(np.zeros(self.physics.model.nu), self.index.actuator, torque)
            data, overflow = self.physics.step(
                data, ctrl, fields=fields, xfrc_applied=xfrc_applied, num_substeps=1
            )
            return (data, (errors[:2], velocities[:2])), overflow

        (data, memory), overflow = jax.lax.scan(
            substep, (data, memory), None, self.physics.num_substeps
        )
        return data, memory, jnp.any(overflow)
