"""Scripted policy of Sumo Wrestling: push the opponent out of the ring sideways, to avoid slipping past it."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mqe_jax.planners.steering import Observation, go_to, pose

_CENTER = jnp.array([3.1, 0.0])  # m, of the ring
_AHEAD = 0.05  # m, forward offset of the contact point (the side between the legs) from the trunk's centre
_STAND_OFF = 0.65  # m, distance from the opponent until the robot is side on
_EDGE = (1.5, 1.64)  # m, range of the distance from the centre at which the robot turns back; grows with the opponent's


def plan_wrestling(obs: Observation) -> jax.Array:
    """Returns the robot's action (1, 3) in its own frame."""
    (position, yaw), opponent = pose(obs["base"]), obs["opponent"][:, :2]
    far = jnp.linalg.norm(opponent - _CENTER, axis=-1)
    outward = (opponent - _CENTER) / jnp.maximum(far, 1e-3)[:, None]
    left = jnp.stack([-outward[:, 1], outward[:, 0]], axis=-1)
    heading = jnp.arctan2(left[:, 1], left[:, 0])
    apart = position - opponent
    along, across = jnp.sum(apart * outward, axis=-1), jnp.sum(apart * left, axis=-1) + _AHEAD
    side_on = (jnp.abs(jnp.sin(yaw - heading)) < 0.4) & (jnp.abs(across) < 0.12)
    pushing = (side_on | ((along > -0.5) & (jnp.abs(across) < 0.25))) & (along < 0.05)
    # A robot beyond the opponent walks around it.
    lateral = jnp.where((along > -0.35) & ~pushing, jnp.where(across > 0, 0.7, -0.7), 0.0) - _AHEAD
    reach = jnp.where(pushing, 0.6, -_STAND_OFF)
    goal = opponent + reach[:, None] * outward + lateral[:, None] * left
    back = go_to(position, yaw, jnp.broadcast_to(_CENTER, position.shape), yaw)
    at_edge = jnp.linalg.norm(position - _CENTER, axis=-1) > jnp.clip(far - 0.08, *_EDGE)
    return jnp.where(at_edge[:, None], back, go_to(position, yaw, goal, heading))
