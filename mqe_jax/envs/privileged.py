"""The privileged observation: the simulator's state and randomised physics.

Critics and distillation read it.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mqe_jax.envs.observation import Block, ObservationLayout
from mqe_jax.envs.state import State
from mqe_jax.physics.robots.fleet import Fleet
from mqe_jax.physics.robots.index import RobotIndex, RobotState, gather


def _robot_blocks(joints: int, number: int) -> list[Block]:
    parts = (
        Block("position", 3, "m"),
        Block("quaternion", 4, "wxyz"),
        Block("linear_velocity", 3, "m/s, world"),
        Block("angular_velocity", 3, "rad/s, body"),
        Block("joint_position", joints, "rad, minus the stance"),
        Block("joint_velocity", joints, "rad/s"),
    )
    return [dataclasses.replace(part, name=f"robot{number}/{part.name}") for part in parts]


class PrivilegedObservation:
    """State of the robots and all other moving bodies, physics parameters, gaits and forces.

    Entries of robots that take no part are 0. Physics parameters are included even if not
    randomised. `clock_size` is the length of the clock of a robot's skill; `contact_forces` adds
    those on trunks and feet, which requires the scene's foot sensors.
    """

    def __init__(
        self,
        robots: Fleet,
        model: mujoco.MjModel,
        index: RobotIndex,
        *,
        num_anchors: int,
        clock_size: int,
        contact_forces: bool,
    ) -> None:
        count = index.num_robots
        self._default_joints = robots.table("default_joints")
        self._foot_force = index.foot_force if contact_forces else None
        own_qpos = np.concatenate([index.base_qpos, index.joint_qpos], axis=1)
        own_qvel = np.concatenate([index.base_qvel, index.joint_qvel], axis=1)
        self._qpos = np.setdiff1d(np.arange(model.nq), own_qpos)
        self._qvel = np.setdiff1d(np.arange(model.nv), own_qvel)
        touching = 1 + index.foot_force.shape[1]
        clock = "of each robot's skill; walk policy: sine and cosine"
        forces = "on each robot's trunk and feet, N"
        blocks: list[Block] = []
        for number in range(count):
            blocks += _robot_blocks(robots.num_joints, number)
        blocks += [
            Block("objects/qpos", len(self._qpos), "positions of all non-robot bodies"),
            Block("objects/qvel", len(self._qvel), "velocities of all non-robot bodies"),
            Block("anchors", 2 * num_anchors, "x, y of each, m"),
            Block("friction", count, "sliding friction of each robot"),
            Block("payload", count, "of each robot, kg"),
            Block("center_of_mass", 3 * count, "shift of each trunk's centre of mass, m"),
            Block("motor_strength", count, "factor on each robot's torques"),
            Block("action_lag", 1, "environment steps"),
            Block("gait_phase", clock_size * count, clock),
            Block("contact_force", touching * count if contact_forces else 0, forces),
        ]
        self.layout = ObservationLayout(tuple(block for block in blocks if block.width))

    def observe(self, robot_state: RobotState, state: State[Any], clock: jax.Array) -> jax.Array:
        """Returns the observation of one environment (P,).

        `clock` is that of the skills (R, clock_size).
        """
        data = state.data
        randomized = state.randomized
        robots = jnp.concatenate(
            [
                robot_state.position_w,
                robot_state.quaternion,
                robot_state.linear_velocity_w,
                robot_state.angular_velocity_b,
                robot_state.joint_position - self._default_joints,
                robot_state.joint_velocity,
            ],
            axis=-1,
        )
        count = robot_state.count
        parts = [
            count(robots),
            data.qpos[self._qpos],
            data.qvel[self._qvel],
            state.anchors,
            count(randomized.friction),
            count(randomized.payload),
            count(randomized.center_of_mass),
            count(randomized.motor_strength),
            randomized.action_lag.astype(jnp.float32),
            count(clock),
        ]
        if self._foot_force is not None:
            feet = jnp.linalg.norm(gather(data.sensordata, self._foot_force), axis=-1)
            parts.append(count(jnp.concatenate([robot_state.trunk_force[:, None], feet], axis=-1)))
        return jnp.concatenate([part.ravel() for part in parts])
