"""Scripted policy of Revolving Door: push the near half of the door open, far from the hinge, and walk through."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mqe_jax.planners.steering import Observation, go_to, pose

_LANE = -0.62  # m, y: a long lever about the hinge, clear of the wall


def plan_revolving_door(obs: Observation) -> jax.Array:
    """Returns the robot's action (1, 3) in its own frame."""
    position, yaw = pose(obs["base"])
    in_lane = jnp.abs(position[:, 1] - _LANE) < 0.15
    through = position[:, 0] > 2.4
    ahead = jnp.where(in_lane | through | (position[:, 0] < 1.6), position[:, 0] + 1.5, 1.7)
    return go_to(position, yaw, jnp.stack([ahead, jnp.full_like(ahead, _LANE)], axis=-1))
