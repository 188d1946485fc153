"""Scripted policies of football: move behind the ball on the line to an open part of the goal, then walk through it."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mqe_jax.planners.steering import Observation, go_to

_AIMS = jnp.array([[12.2, -0.6], [12.2, 0.0], [12.2, 0.6]])  # m, points in the goal
_GOAL = jnp.array([12.0, 0.0])  # m


def plan_defender(obs: Observation) -> jax.Array:
    """Returns both robots' actions (2, 3); the unobserved defender is assumed where its control law steers to."""
    ball = obs["ball"][:, :2]
    opponents = (0.6 * ball + 0.4 * _GOAL)[:, None]
    return jax.vmap(_play)(obs["base"], obs["mate"], opponents, ball, obs["ball_velocity"][:, :2])


def plan_1vs1(obs: Observation) -> jax.Array:
    """Returns both robots' actions (2, 3), each in its own frame."""
    far_mate = jnp.full((2, 6), 1e3)
    opponents = obs["opponents"][:, None, :2]
    return jax.vmap(_play)(obs["base"], far_mate, opponents, obs["ball"][:, :2], obs["ball_velocity"][:, :2])


def plan_2vs2(obs: Observation) -> jax.Array:
    """Returns all robots' actions (4, 3), each in its own frame."""
    opponents = obs["opponents"].reshape(-1, 2, 6)[..., :2]
    return jax.vmap(_play)(obs["base"], obs["mate"], opponents, obs["ball"][:, :2], obs["ball_velocity"][:, :2])


def _play(own: jax.Array, mate: jax.Array, opponents: jax.Array, ball: jax.Array, velocity: jax.Array) -> jax.Array:
    """Returns one robot's action (3,): the nearer of two attacks the ball, the other supports from behind it.

    Args:
        own: base information (6,).
        mate: base information (6,).
        opponents: positions (K, 2), m.
        ball: position (2,), m.
        velocity: of the ball (2,), m/s.
    """
    position, yaw = own[:2], own[5]
    near = jnp.linalg.norm(position - ball) < 0.35
    ball = ball + 0.3 * velocity
    facing = jnp.array([jnp.cos(yaw), jnp.sin(yaw)])
    offset = position - ball
    distance = jnp.linalg.norm(offset)
    # The aim with the most clearance and the least turning.
    ways = _AIMS - ball
    ways = ways / jnp.linalg.norm(ways, axis=-1, keepdims=True)
    lefts = ways[:, ::-1] * jnp.array([-1.0, 1.0])
    ahead, apart = ways @ (opponents - ball).T, jnp.abs(lefts @ (opponents - ball).T)
    free = jnp.min(jnp.where(ahead > 0, jnp.minimum(apart, 0.5), 0.5), axis=1)
    straight = ways @ (facing - offset / jnp.maximum(distance, 1.0))
    best = jnp.argmax(2 * free + straight)
    way, left = ways[best], lefts[best]
    along, aside = offset @ way, offset @ left
    lined_up = (along < -0.2) & (jnp.abs(aside) < 0.1 + 0.3 * jnp.maximum(-along - 0.3, 0.0))
    between_legs = near & (jnp.abs(aside) < 0.25) & (facing @ way > 0.5)
    push = position + 0.8 * way - 1.5 * aside * left
    behind = ball - 0.5 * way
    # From in front of the ball: first to the side, then back.
    side = jnp.sign(aside) * left
    around = jnp.where(jnp.abs(aside) < 0.3, position + 0.6 * side, behind + 0.45 * side)
    attack = jnp.where(lined_up | between_legs, push, jnp.where(along > -0.3, around, behind))
    support = ball - 1.5 * way + 0.8 * side
    nearer = distance < jnp.linalg.norm(mate[:2] - ball)
    heading = jnp.arctan2(way[1], way[0])
    return go_to(position[None], yaw[None], jnp.where(nearer, attack, support)[None], heading)[0]
