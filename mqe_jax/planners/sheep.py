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

    Each robot walks behind the sheep that are farthest from the gate, on its own side rather than on the other and
    near rather than far, and so brings them up to the others; the herd's own pull keeps it together.
    """
    position, yaw, gate, sheep = obs[:, 2:4], obs[:, 7], obs[0, 14:16], obs[0, 16:].reshape(9, 2)
    through = sheep[:, 0] > gate[0]
    way = sheep - gate - jnp.array([0.8, 0.0])
    apart = position[:, None] - sheep[None]
    near = jnp.linalg.norm(apart, axis=-1)
    own_side = _SIDE[:, None] * (sheep[:, 1] - gate[1])
    care = 5.0 * jnp.linalg.norm(way, axis=-1) + 3.5 * own_side - 1.5 * near
    share = jax.nn.softmax(jnp.where(through, -1e3, care), axis=-1)
    back = share @ way
    back /= jnp.maximum(jnp.linalg.norm(back, axis=-1, keepdims=True), 1e-3)
    goal = share @ sheep + 0.8 * back + _SIDE[:, None] * jnp.array([0.0, 0.2])
    goal = jnp.clip(goal, jnp.array([0.0, -2.6]), jnp.stack([gate[0] - 0.45, 2.6]))
    # Around sheep that are close.
    goal += jnp.sum(0.8 * jnp.maximum(0.75 / near - 1.0, 0.0)[..., None] * apart, axis=1)
    return jnp.where(jnp.all(through), 0.0, go_to(position, yaw, goal))
