"""MJX-JAX's physics step with contact margins that hold for every pair of geoms.

MJX-JAX detects no contact with a box before the surfaces meet, whatever the margin. Here collisions are computed on
spheres and capsules inflated by their margins; distances and positions are then those of the original surfaces.
"""

from __future__ import annotations

import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

_BEFORE_COLLISION = (
    mjx.kinematics,
    mjx.com_pos,
    mjx.camlight,
    mjx.tendon,
    mjx.crb,
    mjx.tendon_armature,
    mjx.factor_m,
)
_ROUND = (int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_CAPSULE))


class MarginStep:
    """`mjx.step` of a model for MJX's JAX implementation (Euler integration)."""

    model: mjx.Model

    def __init__(self, model: mujoco.MjModel) -> None:
        if model.opt.integrator != mujoco.mjtIntegrator.mjINT_EULER:
            raise ValueError("the integrator must be Euler")
        self.model = mjx.put_model(model, impl="jax")
        self._inflation = np.where(np.isin(model.geom_type, _ROUND), model.geom_margin, 0.0).astype(np.float32)
        self._size = model.geom_size.astype(np.float32)
        self._size[:, 0] += self._inflation
        self._margin = model.geom_margin.astype(np.float32) - self._inflation

    def __call__(self, model: mjx.Model, data: mjx.Data) -> mjx.Data:
        """Advances one environment by one physics step; `model` is `self.model`, possibly with other field values."""
        data = self._forward_position(model, data)
        data = mjx.sensor_pos(model, data)
        data = mjx.fwd_velocity(model, data)
        data = mjx.sensor_vel(model, data)
        data = mjx.fwd_actuation(model, data)
        data = mjx.fwd_acceleration(model, data)
        if data._impl.efc_J.size == 0:
            data = data.replace(qacc=data.qacc_smooth)
        else:
            data = mjx.sensor_acc(model, mjx.solve(model, data))
        return mjx.euler(model, data)

    def _forward_position(self, model: mjx.Model, data: mjx.Data) -> mjx.Data:
        for compute in _BEFORE_COLLISION:
            data = compute(model, data)
        data = self._collision(model, data)
        return mjx.transmission(model, mjx.make_constraint(model, data))

    def _collision(self, model: mjx.Model, data: mjx.Data) -> mjx.Data:
        inflated = model.replace(geom_size=jnp.asarray(self._size), geom_margin=jnp.asarray(self._margin))
        data = mjx.collision(inflated, data)
        contact = data._impl.contact
        if len(contact.dist) == 0:
            return data
        first, second = jnp.asarray(self._inflation)[jnp.asarray(contact.geom)].T
        normal = contact.frame[:, 0]  # from the first geom to the second
        contact = contact.replace(
            dist=contact.dist + first + second,
            pos=contact.pos - 0.5 * (first - second)[:, None] * normal,
            includemargin=contact.includemargin + first + second,
        )
        return data.replace(_impl=data._impl.replace(contact=contact))
