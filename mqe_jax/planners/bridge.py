"""Scripted policy of Traverse Bridge: along the centre line of the bridge, then past the opponent at its end."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mqe_jax.planners.steering import Observation, go_to, pose

_BRIDGE_END = 6.75  # m, x
_GOAL = jnp.array([7.65, 0.75])  # m, on the far platform, beside its centre


def plan_bridge(obs: Observation) -> jax.Array:
    """Returns both robots' actions (2, 3), each in its own frame."""
    position, yaw = pose(obs["base"])
    middle = jnp.stack([jnp.minimum(position[:, 0] + 1.0, 7.05), jnp.zeros(2)], axis=-1)
    return go_to(position, yaw, jnp.where(position[:, :1] > _BRIDGE_END, _GOAL, middle))
