"""Marks: what a sensor draws over the scene to show what it measures."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

Color = tuple[float, float, float]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Marks:
    """Lines, points and an area of one colour that show what A agents sense; environment frame."""

    label: str = dataclasses.field(metadata={"static": True})
    """What the legend calls them."""
    color: Color = dataclasses.field(metadata={"static": True})
    """Red, green and blue, 0 to 1."""
    bold: bool = dataclasses.field(metadata={"static": True})
    """Whether the lines are thick."""
    lines: jax.Array
    """Both ends of each line (A, L, 2, 3), m."""
    line_opacity: jax.Array
    """Opacity of each line (A, L); 0 hides it."""
    points: jax.Array
    """Points (A, P, 3), m."""
    point_opacity: jax.Array
    """Opacity of each point (A, P); 0 hides it."""
    area: jax.Array
    """Corners of a translucent area (A, K, 3), m, the first of which sees all others."""


def marks(
    label: str,
    color: Color,
    height: jax.Array,
    *,
    lines: jax.Array | None = None,
    line_opacity: jax.Array | float = 1.0,
    points: jax.Array | None = None,
    point_opacity: jax.Array | float = 1.0,
    area: jax.Array | None = None,
    bold: bool = False,
) -> Marks:
    """Returns marks of A agents at their heights (A,), m.

    The arguments are the fields of `Marks`, with x and y only.

    An opacity is of the shape (A, L) or (A, P), or the same for all.
    """

    def raised(corners: jax.Array | None, *shape: int) -> jax.Array:
        if corners is None:
            corners = jnp.zeros((len(height), *shape, 2))
        z = height.reshape(-1, *[1] * (corners.ndim - 1))
        z = jnp.broadcast_to(z, (*corners.shape[:-1], 1))
        return jnp.concatenate([corners, z], axis=-1)

    def opacity(value: jax.Array | float, corners: jax.Array) -> jax.Array:
        return jnp.broadcast_to(jnp.asarray(value, jnp.float32), corners.shape[:2])

    ends = raised(lines, 0, 2)
    spots = raised(points, 0)
    return Marks(
        label,
        color,
        bold,
        lines=ends,
        line_opacity=opacity(line_opacity, ends),
        points=spots,
        point_opacity=opacity(point_opacity, spots),
        area=raised(area, 0),
    )
