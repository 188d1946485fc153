"""Scripted policy of Narrow Gate: the first robot passes the gate while the second waits until the gate is clear."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mqe_jax.planners.steering import Observation, go_to, pose


def plan_gate(obs: Observation) -> jax.Array:
    """Returns both robots' actions (2, 3)."""
    (position, yaw), gate = pose(obs["base"]), obs["gate"]
    before = gate - jnp.array([0.65, 0.0])
    behind = gate + jnp.array([0.75, 0.0])
    side = jnp.array([1.0, -1.0])
    wait = gate + jnp.stack([jnp.array([-0.65, -1.3]), -0.7 * side], axis=-1)  # each on its spawn side
    rest = jnp.stack([jnp.full(2, 5.3), 0.75 * side], axis=-1)
    x = position[:, 0] - gate[:, 0]
    lined_up = (jnp.abs(position[:, 1] - gate[:, 1]) < 0.1) & (x > -1.0)
    goal = jnp.where((lined_up | (x > -0.3))[:, None], behind, before)
    goal = jnp.where((x > 0.6)[:, None], rest, goal)
    free = jnp.array([True, False]) | (x[::-1] > 0.9)
    return go_to(position, yaw, jnp.where(free[:, None] | (x > 0.0)[:, None], goal, wait))
