"""Sumo Wrestling by hand: come at the opponent from the ring's middle and walk it out."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mqe_jax.planners.steering import go_to

_MIDDLE = jnp.array([3.1, 0.0])  # m, of the ring


def plan_wrestling(obs: jax.Array) -> jax.Array:
    """Returns both robots' actions (2, 3) from their observations (2, 12), each in its own frame."""
    position, yaw, opponent = obs[:, :2], obs[:, 5], obs[:, 6:8]
    apart = opponent - position
    heading = jnp.arctan2(apart[:, 1], apart[:, 0])
    # Stop at the line, whatever the opponent does.
    outward = opponent - _MIDDLE
    goal = _MIDDLE + outward * jnp.minimum(1.0, 1.5 / jnp.maximum(jnp.linalg.norm(outward, axis=-1), 1e-3))[:, None]
    return go_to(position, yaw, goal, heading)
