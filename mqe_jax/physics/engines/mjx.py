"""MJX's two implementations: physics steps in a scan, with the motors in each of them."""

from __future__ import annotations

import abc
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mqe_jax.physics.engines import private, warp_model
from mqe_jax.physics.engines.engine import Engine
from mqe_jax.physics.robots.index import scatter
from mqe_jax.physics.robots.motors import Motors

if TYPE_CHECKING:
    from mujoco import mjx

_SENSORS = mujoco.mjtDisableBit.mjDSBL_SENSOR


class MjxEngine(Engine):
    """Base of the engines that are implementations of MJX."""

    mjx_model: mjx.Model  # the model on the device
    unroll = 1
    """Physics steps in one iteration of the loop over them; more compile longer."""
    last_apart = False
    """Whether only the last physics step, outside of the loop, computes sensors."""

    @abc.abstractmethod
    def physics_step(self, model: mjx.Model, data: mjx.Data) -> tuple[mjx.Data, jax.Array]:
        """Advances by one physics step and returns the overflow flag.

        `model` is `mjx_model`, possibly with other field values.
        """

    def unused_terms(self, fields: Collection[str]) -> int:
        """Returns the disable flags of terms that are zero where environments override `fields`."""
        return 0

    def advance(
        self, data: mjx.Data, fields: Mapping[str, jax.Array], forced: bool, num_substeps: int
    ) -> tuple[mjx.Data, jax.Array]:
        ctrl = data.ctrl
        model = self.mjx_model.replace(**fields) if fields else self.mjx_model
        model = _disable(model, self.unused_terms(fields))
        loop = _disable(model, _SENSORS) if self.last_apart else model

        def substep(
            model: mjx.Model, carry: tuple[mjx.Data, jax.Array]
        ) -> tuple[mjx.Data, jax.Array]:
            data, overflow = self.physics_step(*self._drive(model, carry[0], ctrl))
            return data, carry[1] | overflow

        carry = (data, jnp.zeros((), bool))
        length = num_substeps - self.last_apart
        carry, _ = jax.lax.scan(
            lambda carry, _: (substep(loop, carry), None), carry, None, length, unroll=self.unroll
        )
        data, overflow = substep(model, carry) if self.last_apart else carry
        return self._clamp(data.replace(ctrl=ctrl)), overflow

    def _drive(
        self, model: mjx.Model, data: mjx.Data, ctrl: jax.Array
    ) -> tuple[mjx.Model, mjx.Data]:
        """Returns model and data for one physics step, with the motors in them.

        The model has their armature, the data their control and clamped joints.
        """
        motors = self.motors
        if motors is None:
            return model, data
        gain = model.actuator_gainprm[:, 0]
        bias = model.actuator_biasprm[:, :3]
        position, velocity = self._joints(data, motors)
        ctrl, added = motors.limit(jnp, ctrl, position, velocity, gain, bias)
        armature = model.dof_armature + scatter(np.zeros(self.model.nv), motors.joint_qvel, added)
        return model.replace(dof_armature=armature), self._clamp(data).replace(ctrl=ctrl)

    def _clamp(self, data: mjx.Data) -> mjx.Data:
        """Returns data with the joint speeds that motors and contacts allow."""
        motors = self.motors
        if motors is None:
            return data
        position, velocity = self._joints(data, motors)
        return data.replace(
            qpos=scatter(data.qpos, motors.joint_qpos, position),
            qvel=scatter(data.qvel, motors.joint_qvel, velocity),
        )

    def _joints(self, data: mjx.Data, motors: Motors) -> tuple[jax.Array, jax.Array]:
        """Returns clamped joint angles and velocities (J,)."""
        return motors.clamp(data.qpos[motors.joint_qpos], data.qvel[motors.joint_qvel])


class JaxEngine(MjxEngine):
    """MJX-JAX on CPU, GPU or TPU, with the contacts of the C engine (`mjx_step.py`)."""

    impl = "jax"

    def __init__(self, model: mujoco.MjModel, **options: Any) -> None:
        super().__init__(model, **options)
        private.load_mjx()
        from mqe_jax.physics.engines.mjx_step import MarginStep

        self._step = MarginStep(model)
        self.mjx_model = self._step.model

    @classmethod
    def is_preferred(cls) -> bool:
        return True

    def blank(self) -> mjx.Data:
        return private.load_mjx().make_data(self.model, jax.local_devices()[0], impl="jax")

    def physics_step(self, model: mjx.Model, data: mjx.Data) -> tuple[mjx.Data, jax.Array]:
        """Advances by one physics step.

        Contacts may have been dropped if the capped contact list is full.
        """
        data = self._step(model, data)
        contact = private.contact(data)
        if len(contact.dist) == self._step.max_contacts:
            return data, jnp.all(contact.dist < contact.includemargin)
        return data, jnp.zeros((), bool)


class WarpMjxEngine(MjxEngine):
    """MJX-Warp as MJX calls it, with all arrays of model and data in each physics step.

    It is the reference of `WarpEngine`, which is faster. Terms that are zero for the whole model
    are disabled.
    """

    impl = "warp-mjx"
    unroll = 3
    last_apart = True

    def __init__(self, model: mujoco.MjModel, **options: Any) -> None:
        super().__init__(model, **options)
        self._mjx = private.load_mjx()
        private.keep_streams()
        self._model = warp_model.with_jacobian(model)
        put = self._mjx.put_model(self._model, jax.local_devices()[0], impl="warp")
        self.mjx_model = private.without_warnings(put)
        if warp_model.skips_zeros(self._model, self.sparse_solver):
            self.mjx_model = private.with_sparse_newton(self.mjx_model)

    @classmethod
    def obstacle(cls) -> str | None:
        return warp_model.obstacle()

    def holds(self, num_envs: int) -> bool:
        return num_envs <= self.num_envs

    def blank(self) -> mjx.Data:
        return self._mjx.make_data(
            self._model,
            jax.local_devices()[0],
            impl="warp",
            naconmax=self.num_envs * self.contacts_per_env,
            njmax=self.max_constraints_per_env,
        )

    def unused_terms(self, fields: Collection[str]) -> int:
        return warp_model.unused_terms(self.model, fields)

    def advance(
        self, data: mjx.Data, fields: Mapping[str, jax.Array], forced: bool, num_substeps: int
    ) -> tuple[mjx.Data, jax.Array]:
        """Advances by physics steps.

        The overflow flag is Warp's own, which it sets but never clears.
        """
        data, _ = super().advance(private.without_overflow(data), fields, forced, num_substeps)
        return data, private.overflow(data)

    def physics_step(self, model: mjx.Model, data: mjx.Data) -> tuple[mjx.Data, jax.Array]:
        return self._mjx.step(model, data), jnp.zeros((), bool)


def _disable(model: mjx.Model, disable: int) -> mjx.Model:
    """Returns the model with further disable flags."""
    flags = model.opt.disableflags
    return model.replace(opt=model.opt.replace(disableflags=type(flags)(flags | disable)))
