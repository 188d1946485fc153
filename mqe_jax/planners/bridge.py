"""Traverse Bridge by hand: along the middle of the bridge, then past whoever stands behind its end."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mqe_jax.planners.steering import go_to

_BRIDGE_END = 6.75  # m, x
_GOAL = jnp.array([7.65, 0.75])  # m, on the far platform, beside its middle


def plan_bridge(obs: jax.Array) -> jax.Array:
    """Returns both robots' actions (2, 3) from their observations (2, 12), each in its own frame."""
    position, yaw = obs[:, :2], obs[:, 5]
    middle = jnp.stack([jnp.minimum(position[:, 0] + 1.0, 7.05), jnp.zeros(2)], axis=-1)
    return go_to(position, yaw, jnp.where(position[:, :1] > _BRIDGE_END, _GOAL, middle))
