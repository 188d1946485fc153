"""Sheep Dog by hand: the robots walk behind the sheep, one each side of the line from the gate through it."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mqe_jax.planners.steering import go_to


def plan_sheep_easy(obs: jax.Array) -> jax.Array:
    """Returns both robots' actions (2, 3) from their observations (2, 18)."""
    position, yaw, gate, sheep = obs[:, 2:4], obs[:, 7], obs[0, 14:16], obs[0, 16:18]
    return drive_one(position, yaw, gate, sheep, distance=0.8, width=0.35)


def drive_one(
    position: jax.Array, yaw: jax.Array, gate: jax.Array, sheep: jax.Array, *, distance: float, width: float
) -> jax.Array:
    """Returns actions (2, 3) that drive one sheep (2,) through the gate (2,), keeping a distance from it, m."""
    through = gate + jnp.array([0.6, 0.0])
    way = through - sheep
    way = jnp.where(jnp.linalg.norm(way) > 1e-3, way / jnp.maximum(jnp.linalg.norm(way), 1e-3), jnp.array([1.0, 0.0]))
    across = jnp.array([-way[1], way[0]])
    side = jnp.array([-1.0, 1.0])
    goal = sheep - distance * way + (side * width)[:, None] * across
    return go_to(position, yaw, goal)
