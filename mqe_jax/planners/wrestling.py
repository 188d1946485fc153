"""Sumo Wrestling by hand: side on, so that one does not slip past, shove the opponent out of the ring."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mqe_jax.planners.steering import go_to

_MIDDLE = jnp.array([3.1, 0.0])  # m, of the ring
_AHEAD = 0.1  # m, from the trunk's middle forward to where it meets the opponent: the shoulders push
_TURNED = 0.06  # rad, by which the side that shoves is turned towards the opponent; more or less, and it slips
_STAND_OFF = 0.65  # m, from the opponent until one stands side on
_EDGE = (1.5, 1.64)  # m, from the middle, where one turns back: the farther out the opponent is, the later


def plan_wrestling(obs: jax.Array) -> jax.Array:
    """Returns both robots' actions (2, 3) from their observations (2, 12), each in its own frame."""
    position, yaw, opponent = obs[:, :2], obs[:, 5], obs[:, 6:8]
    far = jnp.linalg.norm(opponent - _MIDDLE, axis=-1)
    outward = (opponent - _MIDDLE) / jnp.maximum(far, 1e-3)[:, None]
    left = jnp.stack([-outward[:, 1], outward[:, 0]], axis=-1)
    heading = jnp.arctan2(left[:, 1], left[:, 0]) + _TURNED
    apart = position - opponent
    along, across = jnp.sum(apart * outward, axis=-1), jnp.sum(apart * left, axis=-1) + _AHEAD
    side_on = (jnp.abs(jnp.sin(yaw - heading)) < 0.4) & (jnp.abs(across) < 0.12)
    shoving = (side_on | ((along > -0.5) & (jnp.abs(across) < 0.25))) & (along < 0.05)
    # Who has come past the opponent goes around it again.
    aside = jnp.where((along > -0.35) & ~shoving, jnp.where(across > 0, 0.7, -0.7), 0.0) - _AHEAD
    reach = jnp.where(shoving, 0.6, -_STAND_OFF)
    goal = opponent + reach[:, None] * outward + aside[:, None] * left
    back = go_to(position, yaw, jnp.broadcast_to(_MIDDLE, position.shape), yaw)
    at_edge = jnp.linalg.norm(position - _MIDDLE, axis=-1) > jnp.clip(far - 0.08, *_EDGE)
    return jnp.where(at_edge[:, None], back, go_to(position, yaw, goal, heading))
