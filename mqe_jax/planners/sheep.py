"""Sheep Dog by hand: drive one sheep from behind, or sweep a herd together towards the gate."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mqe_jax.planners.steering import go_to

_SIDE = jnp.array([-1.0, 1.0])  # on which side of the way each robot walks


def plan_sheep_easy(obs: jax.Array) -> jax.Array:
    """Returns both robots' actions (2, 3) from their observations (2, 18).

    They walk behind the sheep, one each side of the line from the gate through it, and stop when it is through.
    """
    position, yaw, gate, sheep = obs[:, 2:4], obs[:, 7], obs[0, 14:16], obs[0, 16:18]
    way = gate + jnp.array([0.6, 0.0]) - sheep
    way = way / jnp.maximum(jnp.linalg.norm(way), 1e-3)
    across = jnp.array([-way[1], way[0]])
    goal = sheep - 0.8 * way + (0.35 * _SIDE)[:, None] * across
    return jnp.where(sheep[0] > gate[0] + 0.4, 0.0, go_to(position, yaw, goal))


def plan_sheep_hard(obs: jax.Array) -> jax.Array:
    """Returns both robots' actions (2, 3) from their observations (2, 34).

    They come from both sides towards the gate, as a funnel before which the sheep draw together and flee.
    """
    position, yaw, gate, sheep = obs[:, 2:4], obs[:, 7], obs[0, 14:16], obs[0, 16:].reshape(9, 2)
    ahead = jnp.minimum(position[:, 0] + 0.8, gate[0] - 0.2)
    left = jnp.clip((gate[0] - ahead) / 6.0, 0.0, 1.0)
    goal = jnp.stack([ahead, gate[1] * (1.0 - left) + _SIDE * (0.45 + 1.0 * left)], axis=-1)
    action = go_to(position, yaw, goal)
    # Not into a sheep that has nowhere to go.
    apart = sheep[None] - position[:, None]
    close = jnp.any((jnp.linalg.norm(apart, axis=-1) < 0.65) & (apart[..., 0] > -0.2), axis=-1)
    return jnp.where(close[:, None], action * jnp.array([0.1, 0.3, 1.0]), action)
