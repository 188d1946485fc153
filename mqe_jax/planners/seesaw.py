"""Scripted policy of Climb on Seesaw: one robot walks up to the platform, the other stands on the plank's near end."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mqe_jax.planners.steering import Observation, go_to, pose

_TOP = 8.1  # m, x of the climber's goal on the platform
_NEAR_END = 3.87  # m, x at which the partner has all four feet on the plank
_BEHIND = 0.9  # m, distance of the partner behind the climber
# The climber steps onto the centre of the 1 m wide plank; with the feet of one side off the plank it would tip over.
_FOOT = 2.6  # m, x of the climber's goal while it is off-centre
_ENTRY = 2.9  # m, x up to which the climber stops if it is more than _CENTRED off-centre
_CENTRED = 0.15  # m
_LOW = 4.4  # m, x up to which the climber goes back if it is more than _EDGE off-centre
_EDGE = 0.3  # m, distance from the centre line at which the outer feet are near the plank's edge


def plan_seesaw(obs: Observation) -> jax.Array:
    """Returns both robots' actions (2, 3)."""
    position, yaw = pose(obs["base"])
    x, offset = position[0, 0], jnp.abs(position[0, 1])
    off = ((x < _ENTRY) & (offset > _CENTRED)) | ((x < _LOW) & (offset > _EDGE))
    climb = jnp.where(off, _FOOT, _TOP)
    follow = jnp.minimum(x - _BEHIND, _NEAR_END)
    goal = jnp.zeros((2, 2)).at[:, 0].set(jnp.stack([climb, follow]))
    return go_to(position, yaw, goal)


def plan_seesaw_alone(obs: Observation) -> jax.Array:
    """Returns the actions (2, 3) of a climber whose partner stands still."""
    return plan_seesaw(obs).at[1].set(0.0)
