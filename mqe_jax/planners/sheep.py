"""Scripted policies of Sheep Dog: drive one sheep from behind, or gather a flock towards the gate."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mqe_jax.planners.steering import Observation, go_to, pose

_SIDE = jnp.array([-1.0, 1.0])  # side of the sheep's path on which each robot walks


def plan_sheep_easy(obs: Observation) -> jax.Array:
    """Returns both robots' actions (2, 3).

    They walk behind the sheep, on either side of the line from the gate through it, and stop when it is through.
    """
    (position, yaw), gate, sheep = pose(obs["base"]), obs["gate"][0], obs["sheep"][0]
    way = gate + jnp.array([0.6, 0.0]) - sheep
    way = way / jnp.maximum(jnp.linalg.norm(way), 1e-3)
    across = jnp.array([-way[1], way[0]])
    goal = sheep - 0.8 * way + (0.35 * _SIDE)[:, None] * across
    return jnp.where(sheep[0] > gate[0] + 0.4, 0.0, go_to(position, yaw, goal))


def plan_sheep_hard(obs: Observation) -> jax.Array:
    """Returns both robots' actions (2, 3).

    Each robot walks behind a weighted mean of the sheep positions; weights are larger for sheep far from the gate, on
    the robot's side and close to it. Stragglers are thus driven back to the flock, whose cohesion keeps it together.
    """
    (position, yaw), gate, sheep = pose(obs["base"]), obs["gate"][0], obs["sheep"][0].reshape(-1, 2)
    through = sheep[:, 0] > gate[0]
    way = sheep - gate - jnp.array([0.8, 0.0])
    apart = position[:, None] - sheep[None]
    near = jnp.linalg.norm(apart, axis=-1)
    own_side = _SIDE[:, None] * (sheep[:, 1] - gate[1])
    score = 5.0 * jnp.linalg.norm(way, axis=-1) + 3.5 * own_side - 1.5 * near
    weight = jax.nn.softmax(jnp.where(through, -1e3, score), axis=-1)
    back = weight @ way
    back /= jnp.maximum(jnp.linalg.norm(back, axis=-1, keepdims=True), 1e-3)
    goal = weight @ sheep + 0.8 * back + _SIDE[:, None] * jnp.array([0.0, 0.2])
    goal = jnp.clip(goal, jnp.array([0.0, -2.6]), jnp.stack([gate[0] - 0.45, 2.6]))
    # Repulsion from close sheep.
    goal += jnp.sum(0.8 * jnp.maximum(0.75 / near - 1.0, 0.0)[..., None] * apart, axis=1)
    return jnp.where(jnp.all(through), 0.0, go_to(position, yaw, goal))
