"""Closed-form kinematics of the legs."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mqe_jax.robots.robot import NUM_LEGS, Robot


def foot_positions(robot: Robot, joint_position: jax.Array) -> jax.Array:
    """Computes the feet's centres in the trunk frame (..., 4, 3), m, from joint angles (..., 12), rad."""
    return _leg_points(robot, joint_position, robot.foot_position)


def knee_positions(robot: Robot, joint_position: jax.Array) -> jax.Array:
    """Computes the knees (calf joints) in the trunk frame (..., 4, 3), m, from joint angles (..., 12), rad."""
    return _leg_points(robot, joint_position, (0.0, 0.0))


def _leg_points(robot: Robot, joint_position: jax.Array, point: tuple[float, float]) -> jax.Array:
    """Computes a point (x, z) of each calf frame, m, in the trunk frame (..., 4, 3), m."""
    angles = joint_position.reshape(*joint_position.shape[:-1], NUM_LEGS, 3)
    hip, thigh, calf = jnp.moveaxis(angles, -1, 0)
    front = jnp.array([1.0, 1.0, -1.0, -1.0])
    left = jnp.array([1.0, -1.0, 1.0, -1.0])
    x = -robot.thigh_length * jnp.sin(thigh) + point[1] * jnp.sin(thigh + calf)
    z = -robot.thigh_length * jnp.cos(thigh) + point[1] * jnp.cos(thigh + calf)
    if point[0]:
        x += point[0] * jnp.cos(thigh + calf)
        z -= point[0] * jnp.sin(thigh + calf)
    y = left * robot.hip_length
    return jnp.stack(
        [
            front * robot.leg_root[0] + x,
            left * robot.leg_root[1] + y * jnp.cos(hip) - z * jnp.sin(hip),
            y * jnp.sin(hip) + z * jnp.cos(hip),
        ],
        axis=-1,
    )
