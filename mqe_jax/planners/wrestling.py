"""Sumo Wrestling by hand: side on, so that one does not slip past, shove the opponent out of the ring."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mqe_jax.planners.steering import go_to

_MIDDLE = jnp.array([3.1, 0.0])  # m, of the ring
_AHEAD = 0.12  # m, by which the trunk's middle is ahead of the line to the opponent: the hips push
_STAND_OFF = 0.65  # m, from the opponent until one stands side on
_EDGE = 1.52  # m, from the middle, where one turns back


def plan_wrestling(obs: jax.Array) -> jax.Array:
    """Returns both robots' actions (2, 3) from their observations (2, 12), each in its own frame."""
    position, yaw, opponent = obs[:, :2], obs[:, 5], obs[:, 6:8]
    outward = opponent - _MIDDLE
    outward = outward / jnp.maximum(jnp.linalg.norm(outward, axis=-1, keepdims=True), 1e-3)
    left = jnp.stack([-outward[:, 1], outward[:, 0]], axis=-1)
    heading = jnp.arctan2(left[:, 1], left[:, 0])
    apart = position - opponent
    along, across = jnp.sum(apart * outward, axis=-1), jnp.sum(apart * left, axis=-1) + _AHEAD
    side_on = jnp.abs(jnp.sin(yaw - heading)) < 0.3
    ready = (side_on & (jnp.abs(across) < 0.12)) | ((along > -0.5) & (jnp.abs(across) < 0.25))
    reach = jnp.where(ready, 0.6, -_STAND_OFF)[:, None]
    shove = go_to(position, yaw, opponent + reach * outward - _AHEAD * left, heading)
    back = go_to(position, yaw, jnp.broadcast_to(_MIDDLE, position.shape), yaw)
    at_edge = jnp.linalg.norm(position - _MIDDLE, axis=-1) > _EDGE
    return jnp.where(at_edge[:, None], back, shove)
