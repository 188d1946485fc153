"""What MJX's implementations share: physics steps in a scan, with the motors in each of them."""

from __future__ import annotations

import abc
from collections.abc import Mapping
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.engines.engine import Engine

if TYPE_CHECKING:
    from mujoco import mjx


class MjxEngine(Engine):
    """Base of the engines that are implementations of MJX."""

    mjx_model: mjx.Model
    """The model on the device."""

    @abc.abstractmethod
    def physics_step(self, model: mjx.Model, data: mjx.Data) -> tuple[mjx.Data, jax.Array]:
        """Advances by one physics step.

        Args:
            model: `mjx_model`, possibly with other field values.
            data: state of the environment.

        Returns:
            Data, and whether contacts may have been dropped () bool.
        """

    def advance(
        self, data: mjx.Data, fields: Mapping[str, jax.Array], forced: bool, num_substeps: int
    ) -> tuple[mjx.Data, jax.Array]:
        ctrl = data.ctrl
        model = self.mjx_model.replace(**fields) if fields else self.mjx_model

        def substep(carry: tuple[mjx.Data, jax.Array], _: None) -> tuple[tuple[mjx.Data, jax.Array], None]:
            data, overflow = self.physics_step(*self._driven(model, self._clamped(carry[0]), ctrl))
            return (data, carry[1] | overflow), None

        data, overflow = jax.lax.scan(substep, (data, jnp.zeros((), bool)), None, num_substeps)[0]
        return self._clamped(data.replace(ctrl=ctrl)), overflow

    def _driven(self, model: mjx.Model, data: mjx.Data, ctrl: jax.Array) -> tuple[mjx.Model, mjx.Data]:
        """Returns model and data with the armature and the control of the motors for one physics step."""
        motors = self.motors
        if motors is None:
            return model, data
        position, velocity = data.qpos[motors.joint_qpos], data.qvel[motors.joint_qvel]
        gain, bias = model.actuator_gainprm[:, 0], model.actuator_biasprm[:, :3]
        ctrl, armature = motors.limit(jnp, ctrl, position, velocity, gain, bias)
        added = _spread(armature, motors.joint_qvel, self.model.nv)
        return model.replace(dof_armature=model.dof_armature + added), data.replace(ctrl=ctrl)

    def _clamped(self, data: mjx.Data) -> mjx.Data:
        """Returns data with the joint speeds that motors and contacts allow."""
        motors = self.motors
        if motors is None:
            return data
        old = data.qpos[motors.joint_qpos], data.qvel[motors.joint_qvel]
        position, velocity = motors.clamp(jnp, *old)
        return data.replace(
            qpos=data.qpos + _spread(position - old[0], motors.joint_qpos, self.model.nq),
            qvel=data.qvel + _spread(velocity - old[1], motors.joint_qvel, self.model.nv),
        )


def _spread(values: jax.Array, addresses: np.ndarray, size: int) -> jax.Array:
    """Returns an array (size,) with the values (J,) at their addresses and zeros elsewhere, by a gather."""
    source = np.full(size, len(addresses))
    source[addresses] = np.arange(len(addresses))
    return jnp.concatenate([values, jnp.zeros(1)])[source]
