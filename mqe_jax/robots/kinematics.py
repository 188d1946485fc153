"""Closed-form kinematics of the legs."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mqe_jax.robots.go1 import CALF_LENGTH, HIP_LENGTH, LEG_ROOT, NUM_LEGS, THIGH_LENGTH


def foot_positions(joint_position: jax.Array) -> jax.Array:
    """Computes the feet's centres in the trunk frame (..., 4, 3), m, from joint angles (..., 12), rad."""
    return _leg_points(joint_position, CALF_LENGTH)


def knee_positions(joint_position: jax.Array) -> jax.Array:
    """Computes the knees (calf joints) in the trunk frame (..., 4, 3), m, from joint angles (..., 12), rad."""
    return _leg_points(joint_position, 0.0)


def _leg_points(joint_position: jax.Array, along_calf: float) -> jax.Array:
    """Closed-form leg kinematics: the point `along_calf` metres down each calf, trunk frame (..., 4, 3)."""
    angles = joint_position.reshape(*joint_position.shape[:-1], NUM_LEGS, 3)
    hip, thigh, calf = jnp.moveaxis(angles, -1, 0)
    front = jnp.array([1.0, 1.0, -1.0, -1.0])
    left = jnp.array([1.0, -1.0, 1.0, -1.0])
    x = -THIGH_LENGTH * jnp.sin(thigh) - along_calf * jnp.sin(thigh + calf)
    z = -THIGH_LENGTH * jnp.cos(thigh) - along_calf * jnp.cos(thigh + calf)
    y = left * HIP_LENGTH
    return jnp.stack(
        [
            front * LEG_ROOT[0] + x,
            left * LEG_ROOT[1] + y * jnp.cos(hip) - z * jnp.sin(hip),
            y * jnp.sin(hip) + z * jnp.cos(hip),
        ],
        axis=-1,
    )
