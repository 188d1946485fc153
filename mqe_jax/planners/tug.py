"""Scripted policy of Push Cylinder: align with the cylinder's axis, then push at full speed."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mqe_jax.planners.steering import Observation, go_to, pose

_AXIS_X = 1.6  # m, of the line on which the cylinder slides


def plan_tug(obs: Observation) -> jax.Array:
    """Returns both robots' actions (2, 3), each in its own frame."""
    (position, yaw), cylinder = pose(obs["base"]), obs["cylinder"][:, 0]
    aside = jnp.abs(position[:, 0] - _AXIS_X)
    # Align first: a robot that pushes off-axis slides along the cylinder.
    ahead = jnp.where(aside < 0.25, cylinder, jnp.minimum(cylinder - 1.65, position[:, 1]))
    goal = jnp.stack([jnp.full(2, _AXIS_X), ahead], axis=-1)
    return go_to(position, yaw, goal, jnp.pi / 2)
