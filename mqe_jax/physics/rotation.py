"""Rotations: quaternions wxyz, and roll, pitch, yaw in rad."""

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike


def quaternion_to_euler(quaternion: jax.Array) -> jax.Array:
    """Converts wxyz quaternions (..., 4) to roll, pitch, yaw (..., 3), rad.

    These rotations are applied in the order z, y, x.
    """
    w, x, y, z = jnp.moveaxis(quaternion, -1, 0)
    roll = jnp.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = jnp.arcsin(jnp.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return jnp.stack([roll, pitch, yaw], axis=-1)


def euler_to_quaternion(euler: jax.Array) -> jax.Array:
    """Converts roll, pitch, yaw (..., 3), rad, to wxyz quaternions (..., 4)."""
    cr, cp, cy = jnp.moveaxis(jnp.cos(euler / 2), -1, 0)
    sr, sp, sy = jnp.moveaxis(jnp.sin(euler / 2), -1, 0)
    return jnp.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        axis=-1,
    )


def rotate(quaternion: jax.Array, vector: ArrayLike) -> jax.Array:
    """Rotates body-frame vectors (..., 3) into the world frame by wxyz quaternions (..., 4)."""
    w = quaternion[..., :1]
    imaginary = quaternion[..., 1:]
    vector = jnp.broadcast_to(vector, imaginary.shape)
    cross = 2 * jnp.cross(imaginary, vector)
    return vector + w * cross + jnp.cross(imaginary, cross)


def rotate_inverse(quaternion: jax.Array, vector: jax.Array) -> jax.Array:
    """Rotates world-frame vectors (..., 3) into the body frame of wxyz quaternions (..., 4)."""
    return rotate(quaternion * jnp.array([1.0, -1.0, -1.0, -1.0]), vector)


def compose(first: jax.Array, second: ArrayLike) -> jax.Array:
    """Returns the products of wxyz quaternions (..., 4): rotations by `second`, then by `first`."""
    other = jnp.asarray(second)
    w = first[..., :1]
    u = first[..., 1:]
    real = other[..., :1]
    v = other[..., 1:]
    scalar = w * real - jnp.sum(u * v, axis=-1, keepdims=True)
    return jnp.concatenate([scalar, w * v + real * u + jnp.cross(u, v)], axis=-1)


def rotation(axis: ArrayLike, angle: jax.Array) -> jax.Array:
    """Returns quaternions (..., 4) of rotations about unit axes (..., 3) by angles (...), rad."""
    half = angle[..., None] / 2
    return jnp.concatenate([jnp.cos(half), jnp.sin(half) * jnp.asarray(axis)], axis=-1)
