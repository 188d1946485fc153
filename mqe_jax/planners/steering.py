"""Steering: where to go, as actions of the `command` mode."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def go_to(position: jax.Array, yaw: jax.Array, goal: jax.Array, heading: jax.Array | float = 0.0) -> jax.Array:
    """Returns the actions (A, 3) of robots that walk to goals, facing a heading.

    Args:
        position: of the robots (A, 2), m.
        yaw: of the robots (A,), rad.
        goal: (A, 2), m.
        heading: to face, rad, environment frame.
    """
    apart = 1.5 * (goal - position)
    along = jnp.cos(yaw) * apart[:, 0] + jnp.sin(yaw) * apart[:, 1]
    left = -jnp.sin(yaw) * apart[:, 0] + jnp.cos(yaw) * apart[:, 1]
    turn = jnp.arctan2(jnp.sin(heading - yaw), jnp.cos(heading - yaw))
    return jnp.clip(jnp.stack([along / 2.0, left / 0.5, turn / 0.5], axis=-1), -1.0, 1.0)
