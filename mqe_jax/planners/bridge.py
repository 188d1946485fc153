"""Scripted policy of Traverse Bridge: push the opponent back from the end of the bridge, then walk beside it."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mqe_jax.planners.steering import Observation, go_to, pose

_LEAD = 1.0  # m, distance of the goal ahead of the robot, for full speed while it pushes
_NEAR = 1.0  # m, distance of the opponent ahead below which the robot aims at its centre, to avoid slipping past it
_MAX_AIM = 0.1  # m, y; the feet are 0.15 m from the robot's centre, the bridge's edges 0.35 m
_OFF_BRIDGE = 7.25  # m, x, beyond which the hind feet are on the far platform
_REST = (7.6, 0.6)  # m, x and |y| of the goal on the far platform, on the side away from the opponent


def plan_bridge(obs: Observation) -> jax.Array:
    """Returns the robot's action (1, 3) in its own frame."""
    (position, yaw), opponent = pose(obs["base"]), obs["opponent"][:, :2]
    x, y = position.T
    middle = jnp.where(opponent[:, 0] - x < _NEAR, jnp.clip(opponent[:, 1], -_MAX_AIM, _MAX_AIM), 0.0)
    beside = jnp.where(y > opponent[:, 1], _REST[1], -_REST[1])
    goal_x = jnp.where(x < _REST[0] - 0.1, x + _LEAD, _REST[0])
    goal_y = jnp.where(x > _OFF_BRIDGE, beside, middle)
    return go_to(position, yaw, jnp.stack([goal_x, goal_y], axis=-1))
