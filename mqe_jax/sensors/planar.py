"""Plane geometry of sensors: rays against circles and segments."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

if TYPE_CHECKING:
    from jax.typing import ArrayLike

_EDGE = 1e-6
"""Overlap of neighbouring sides, relative to their length; no ray passes between them."""


def turn(vector: ArrayLike, angle: jax.Array) -> jax.Array:
    """Turns vectors (..., 2) by angles (...), rad, counterclockwise."""
    x, y = jnp.moveaxis(jnp.asarray(vector), -1, 0)
    c = jnp.cos(angle)
    s = jnp.sin(angle)
    return jnp.stack([c * x - s * y, s * x + c * y], axis=-1)


def sides(pose: jax.Array, size: np.ndarray) -> jax.Array:
    """Returns the ends of the sides (4 n, 2, 2), m, of rectangles.

    Their sizes are (n, 2), m, their poses x, y, yaw (n, 3).
    """
    unit = np.array([[0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]], np.float32)
    corners = unit * size[:, None]
    corners = pose[:, None, :2] + turn(jnp.asarray(corners, jnp.float32), pose[:, 2:])
    return jnp.stack([corners, jnp.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 2)


def to_circles(origin: jax.Array, direction: jax.Array, circles: jax.Array) -> jax.Array:
    """Returns the distances (C, N), m, along the rays of one robot to circles.

    They are infinite where a ray misses.

    Args:
        origin: start of the rays (2,), m.
        direction: unit vectors (N, 2).
        circles: x, y, radius (C, 3), m; a circle without a radius is missed.
    """
    dx, dy = direction.T
    x, y = (circles[:, :2] - origin).T[..., None]
    along = dx * x + dy * y
    aside = dx * y - dy * x
    room = jnp.square(circles[:, 2:]) - jnp.square(aside)
    half = jnp.sqrt(jnp.maximum(room, 0.0))
    near = jnp.where(along > half, along - half, along + half)  # the far side from within
    return jnp.where((room > 0) & (near > 0), near, jnp.inf)


def to_segments(origin: jax.Array, direction: jax.Array, segments: jax.Array) -> jax.Array:
    """Returns the distances (S, N), m, along the rays of one robot to segments.

    They are infinite where a ray misses.

    Args:
        origin: start of the rays (2,), m.
        direction: unit vectors (N, 2).
        segments: both ends (S, 2, 2), m.
    """
    start = segments[:, 0] - origin
    side = segments[:, 1] - segments[:, 0]
    dx, dy = direction.T
    sx, sy = start.T[..., None]
    tx, ty = side.T[..., None]
    slope = dx * ty - dy * tx
    scale = 1.0 / jnp.where(slope == 0, 1.0, slope)
    far = scale * (sx * ty - sy * tx)
    part = scale * (sx * dy - sy * dx)
    hit = (slope != 0) & (far > 0) & (jnp.abs(part - 0.5) <= 0.5 + _EDGE)
    return jnp.where(hit, far, jnp.inf)
