"""Revolving Door by hand: push one's own half of the door open, far from the hinge, and walk on through."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mqe_jax.planners.steering import go_to

_LANE = -0.62  # m, beside the hinge: a long lever, and room to the wall


def plan_revolving_door(obs: jax.Array) -> jax.Array:
    """Returns both robots' actions (2, 3) from their observations (2, 12), each in its own frame."""
    position, yaw = obs[:, :2], obs[:, 5]
    in_lane = jnp.abs(position[:, 1] - _LANE) < 0.15
    through = position[:, 0] > 2.4
    ahead = jnp.where(in_lane | through | (position[:, 0] < 1.6), position[:, 0] + 1.5, 1.7)
    return go_to(position, yaw, jnp.stack([ahead, jnp.full(2, _LANE)], axis=-1))
