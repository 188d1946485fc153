"""Scripted policy of Push Cylinder: align with the cylinder's axis, then push slightly faster than it moves."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mqe_jax.planners.steering import GAIN, Observation, go_to, pose

_AXIS_X = 1.6  # m, of the line on which the cylinder slides
_ALIGNED = 0.25  # m, distance from that line within which a robot pushes
_BEFORE = 1.65  # m, distance from the cylinder's axis at which a robot aligns
_EXCESS = 0.4  # m/s, goal speed of a pushing robot relative to the cylinder


def plan_tug(obs: Observation) -> jax.Array:
    """Returns the robot's action (1, 3) in its own frame."""
    (position, yaw), (cylinder, speed) = pose(obs["base"]), obs["cylinder"].T
    x, y = position.T
    # Align first: a robot that pushes off-axis slides along the cylinder.
    before = jnp.minimum(cylinder - _BEFORE, y)
    # Full speed against a blocked cylinder deflects the robot and tips it over.
    push = jnp.minimum(cylinder, y + (jnp.maximum(speed, 0.0) + _EXCESS) / GAIN)
    ahead = jnp.where(jnp.abs(x - _AXIS_X) < _ALIGNED, push, before)
    goal = jnp.stack([jnp.full_like(ahead, _AXIS_X), ahead], axis=-1)
    return go_to(position, yaw, goal, jnp.pi / 2)
