"""Scripted policy of Climb on Seesaw: one robot walks up to the platform, the other stands on the plank's near end."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mqe_jax.planners.steering import Observation, go_to, pose

_TOP = 8.1  # m, x of the climber's goal on the platform
_NEAR_END = 3.87  # m, x at which the partner has all four feet on the plank
_BEHIND = 0.9  # m, distance of the partner behind the climber


def plan_seesaw(obs: Observation) -> jax.Array:
    """Returns both robots' actions (2, 3)."""
    position, yaw = pose(obs["base"])
    follow = jnp.minimum(position[0, 0] - _BEHIND, _NEAR_END)
    goal = jnp.array([[_TOP, 0.0], [0.0, 0.0]]).at[1, 0].set(follow)
    return go_to(position, yaw, goal)


def plan_seesaw_alone(obs: Observation) -> jax.Array:
    """Returns the actions (2, 3) of a climber whose partner stands still."""
    return plan_seesaw(obs).at[1].set(0.0)
