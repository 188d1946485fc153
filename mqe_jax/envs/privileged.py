"""The privileged observation: everything that is in the simulator, for critics and distillation."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from mqe_jax.envs.observation import Block, ObservationLayout
from mqe_jax.robots import go1
from mqe_jax.robots.index import RobotIndex, RobotState

_ROBOT = (
    Block("position", 3, "m"), Block("quaternion", 4, "wxyz"), Block("linear_velocity", 3, "m/s, world"),
    Block("angular_velocity", 3, "rad/s, body"), Block("joint_position", 12, "rad, minus default"),
    Block("joint_velocity", 12, "rad/s"),
)  # fmt: skip


class PrivilegedObservation:
    """Full state of the R robots, of everything else that moves, and of the gates.

    Attributes:
        layout: its blocks, in order; raw units.
    """

    def __init__(self, model: mujoco.MjModel, index: RobotIndex, num_gates: int) -> None:
        robots = range(index.num_robots)
        self._qpos = np.setdiff1d(np.arange(model.nq), np.concatenate([index.base_qpos, index.joint_qpos], axis=1))
        self._qvel = np.setdiff1d(np.arange(model.nv), np.concatenate([index.base_qvel, index.joint_qvel], axis=1))
        blocks = (
            *(Block(f"robot{i}/{block.name}", block.width, block.meaning) for i in robots for block in _ROBOT),
            Block("objects/qpos", len(self._qpos), "positions of all non-robot bodies"),
            Block("objects/qvel", len(self._qvel), "velocities of all non-robot bodies"),
            Block("gates", 2 * num_gates, "centres, m"),
        )
        self.layout = ObservationLayout(tuple(block for block in blocks if block.width))

    def observe(self, robot_state: RobotState, data: mjx.Data, anchors: jax.Array) -> jax.Array:
        """Returns the observation of one world (P,)."""
        robots = jnp.concatenate(
            [
                robot_state.position_w, robot_state.quaternion, robot_state.linear_velocity_w,
                robot_state.angular_velocity_b, robot_state.joint_position - go1.DEFAULT_JOINTS,
                robot_state.joint_velocity,
            ],
            axis=-1,
        )  # fmt: skip
        return jnp.concatenate([robots.ravel(), data.qpos[self._qpos], data.qvel[self._qvel], gates.ravel()])
