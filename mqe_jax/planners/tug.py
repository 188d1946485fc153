"""Push Cylinder by hand: stand in line with the cylinder's axis, then push with all one's weight."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mqe_jax.planners.steering import go_to

_AXIS_X = 1.6  # m, of the line on which the cylinder slides


def plan_tug(obs: jax.Array) -> jax.Array:
    """Returns both robots' actions (2, 3) from their observations (2, 10), each in its own frame."""
    position, yaw, cylinder = obs[:, :2], obs[:, 5], obs[:, 6]
    aside = jnp.abs(position[:, 0] - _AXIS_X)
    # In line first: a robot that pushes beside the axis slides off.
    ahead = jnp.where(aside < 0.25, cylinder, jnp.minimum(cylinder - 1.65, position[:, 1]))
    goal = jnp.stack([jnp.full(2, _AXIS_X), ahead], axis=-1)
    return go_to(position, yaw, goal, jnp.pi / 2)
