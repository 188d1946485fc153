"""Robots of any joints, which are read from an MJCF (`mqe_jax.physics.robots.reader`)."""

import dataclasses
import functools
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mqe_jax.physics.kinematics import poses
from mqe_jax.physics.robots.build import build_robot
from mqe_jax.physics.robots.robot import Body, Mirror, Proportions, Robot
from mqe_jax.physics.rotation import rotate

LEG_JOINTS = 3


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class ModelRobot(Robot):
    """A robot of any joints, read from an MJCF."""

    joints: tuple[str, ...]
    bodies: tuple[Body, ...]
    soles: tuple[tuple[str, tuple[float, float, float]], ...]
    """Body of each foot, and the foot's centre in its frame (3,), m."""
    reflection: Mirror
    four_legged: bool
    """Whether it has four legs of three joints, in the order of a `Quadruped`."""
    reach: float
    """Distance of the farthest hip from the trunk's origin, m."""
    sizes: Proportions

    @property
    def joint_names(self) -> tuple[str, ...]:
        return self.joints

    @property
    def tree(self) -> tuple[Body, ...]:
        return self.bodies

    @property
    def mirror(self) -> Mirror:
        return self.reflection

    @property
    def limb(self) -> int:
        return LEG_JOINTS if self.four_legged else len(self.joints)

    @property
    def radius(self) -> float:
        return self.reach

    @property
    def proportions(self) -> Proportions:
        return self.sizes

    def foot_positions(self, joint_position: jax.Array) -> jax.Array:
        return self._points(joint_position, [center for _, center in self.soles])

    def knee_positions(self, joint_position: jax.Array) -> jax.Array:
        return self._points(joint_position, [(0.0, 0.0, 0.0)] * len(self.soles))

    def _points(
        self, joint_position: jax.Array, points: Sequence[tuple[float, float, float]]
    ) -> jax.Array:
        """Computes a point of each foot's body, m, in the trunk frame (..., F, 3), m."""

        model = self._model
        ids = [model.body(body).id for body, _ in self.soles]
        columns = np.array([model.joint(name).qposadr[0] for name in self.joints])

        def locate(angles: jax.Array) -> jax.Array:
            qpos = jnp.zeros(model.nq).at[3].set(1.0).at[columns].set(angles)
            data: Any = SimpleNamespace(qpos=qpos)
            position, quaternion = poses(model, data, ids)
            return position + rotate(quaternion, jnp.asarray(points))

        return jnp.vectorize(locate, signature="(j)->(f,p)")(jnp.asarray(joint_position))

    @functools.cached_property
    def _model(self) -> mujoco.MjModel:
        return build_robot(self, 0, visual=False).compile()
