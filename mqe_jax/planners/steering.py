"""Steering: goal positions to actions of the `command` mode."""

from __future__ import annotations

from collections.abc import Mapping

import jax
import jax.numpy as jnp

# The blocks (A, width) of one environment's observations by name.
Observation = Mapping[str, jax.Array]

GAIN = 1.5  # 1/s, commanded speed per distance from the goal


def pose(base: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns x, y (A, 2), m, and yaw (A,), rad, from base information (A, 6)."""
    return base[:, :2], base[:, 5]


def go_to(position: jax.Array, yaw: jax.Array, goal: jax.Array, heading: jax.Array | float = 0.0) -> jax.Array:
    """Returns the actions (A, 3) that steer robots to goal positions and a heading.

    Args:
        position: of the robots (A, 2), m.
        yaw: of the robots (A,), rad.
        goal: (A, 2), m.
        heading: goal yaw, rad, environment frame.
    """
    apart = GAIN * (goal - position)
    along = jnp.cos(yaw) * apart[:, 0] + jnp.sin(yaw) * apart[:, 1]
    left = -jnp.sin(yaw) * apart[:, 0] + jnp.cos(yaw) * apart[:, 1]
    turn = jnp.arctan2(jnp.sin(heading - yaw), jnp.cos(heading - yaw))
    return jnp.clip(jnp.stack([along / 2.0, left / 0.5, turn / 0.5], axis=-1), -1.0, 1.0)
