"""Climb on Seesaw by hand: one robot walks up to the platform while the other stands on the plank's near end."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mqe_jax.planners.steering import go_to

_TOP = 8.1  # m, x where the climber stops, on the platform
_NEAR_END = 3.87  # m, x where the partner stands with all four feet on the plank
_BEHIND = 0.9  # m, how far the partner keeps behind the climber


def plan_seesaw(obs: jax.Array) -> jax.Array:
    """Returns both robots' actions (2, 3) from their observations (2, 14)."""
    position, yaw = obs[:, 2:4], obs[:, 7]
    follow = jnp.minimum(position[0, 0] - _BEHIND, _NEAR_END)
    goal = jnp.array([[_TOP, 0.0], [0.0, 0.0]]).at[1, 0].set(follow)
    return go_to(position, yaw, goal)


def plan_seesaw_alone(obs: jax.Array) -> jax.Array:
    """Returns the actions (2, 3) of a climber whose partner stays where it is."""
    return plan_seesaw(obs).at[1].set(0.0)
