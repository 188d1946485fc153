"""Narrow Gate by hand: the first robot goes through, the second waits until it is out of the way."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mqe_jax.planners.steering import go_to


def plan_gate(obs: jax.Array) -> jax.Array:
    """Returns both robots' actions (2, 3) from their observations (2, 16)."""
    position, yaw, gate = obs[:, 2:4], obs[:, 7], obs[:, 14:16]
    before = gate - jnp.array([0.65, 0.0])
    behind = gate + jnp.array([0.75, 0.0])
    side = jnp.array([1.0, -1.0])
    wait = gate + jnp.stack([jnp.array([-0.65, -1.3]), -0.7 * side], axis=-1)  # each on the side where it starts
    rest = jnp.stack([jnp.full(2, 5.3), 0.75 * side], axis=-1)
    x = position[:, 0] - gate[:, 0]
    lined_up = (jnp.abs(position[:, 1] - gate[:, 1]) < 0.1) & (x > -1.0)
    goal = jnp.where((lined_up | (x > -0.3))[:, None], behind, before)
    goal = jnp.where((x > 0.6)[:, None], rest, goal)
    free = jnp.array([True, False]) | (x[::-1] > 0.9)
    return go_to(position, yaw, jnp.where(free[:, None] | (x > 0.0)[:, None], goal, wait))
