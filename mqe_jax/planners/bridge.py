"""Traverse Bridge by hand: along the middle of the bridge, then on and on against whoever is in the way."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mqe_jax.planners.steering import go_to

_END_X = 8.0  # m, on the far platform


def plan_bridge(obs: jax.Array) -> jax.Array:
    """Returns both robots' actions (2, 3) from their observations (2, 12), each in its own frame."""
    position, yaw = obs[:, :2], obs[:, 5]
    ahead = jnp.minimum(position[:, 0] + 1.0, _END_X)
    return go_to(position, yaw, jnp.stack([ahead, jnp.zeros(2)], axis=-1))
