"""Plane geometry of sensors: rays against circles and segments."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

if TYPE_CHECKING:
    from jax.typing import ArrayLike

_EDGE = 1e-6  # overlap of neighbouring sides, relative to their length, so that no ray passes between them


def turn(vector: ArrayLike, angle: jax.Array) -> jax.Array:
    """Turns vectors (..., 2) by angles (...), rad, counterclockwise."""
    (x, y), (c, s) = jnp.moveaxis(jnp.asarray(vector), -1, 0), (jnp.cos(angle), jnp.sin(angle))
    return jnp.stack([c * x - s * y, s * x + c * y], axis=-1)


def cross(a: jax.Array, b: jax.Array) -> jax.Array:
    """Returns the cross products (...) of vectors (..., 2)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def sides(pose: jax.Array, size: np.ndarray) -> jax.Array:
    """Returns the ends of the sides (4 n, 2, 2), m, of rectangles of a size (n, 2) at poses x, y, yaw (n, 3)."""
    corners = np.array([[0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]], np.float32) * size[:, None]
    corners = pose[:, None, :2] + turn(jnp.asarray(corners, jnp.float32), pose[:, 2:])
    return jnp.stack([corners, jnp.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 2)


def cast(origin: jax.Array, direction: jax.Array, circles: jax.Array, segments: jax.Array) -> jax.Array:
    """Returns the distances along rays to shapes (..., C + S), m, infinite where a ray misses.

    Args:
        origin: start of each ray (..., 2), m.
        direction: unit vectors (..., 2).
        circles: x, y, radius (C, 3), m.
        segments: both ends (S, 2, 2), m.
    """
    origin, direction = origin[..., None, :], direction[..., None, :]
    center = circles[:, :2] - origin
    along, aside = jnp.sum(direction * center, axis=-1), cross(direction, center)
    half = jnp.sqrt(jnp.maximum(jnp.square(circles[:, 2]) - jnp.square(aside), 0.0))
    near = jnp.where(along > half, along - half, along + half)  # the far side from within
    circle = jnp.where((jnp.abs(aside) < circles[:, 2]) & (near > 0), near, jnp.inf)

    start, side = segments[:, 0] - origin, segments[:, 1] - segments[:, 0]
    slope = cross(direction, side)
    divisor = jnp.where(slope == 0, 1.0, slope)
    far, part = cross(start, side) / divisor, cross(start, direction) / divisor
    hit = (slope != 0) & (far > 0) & (part >= -_EDGE) & (part <= 1 + _EDGE)
    return jnp.concatenate([circle, jnp.where(hit, far, jnp.inf)], axis=-1)
