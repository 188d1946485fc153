"""Control laws of the scripted NPCs: sheep and football defender.

Frame: the environment's; metre, second, radian.
"""

import jax
import jax.numpy as jnp

from mqe_jax.physics.objects import GRAVITY


def flock(
    key: jax.Array,
    position: jax.Array,
    velocity: jax.Array,
    robots: jax.Array,
    *,
    restlessness: float,
    step: float,
    friction: float = 1.0,
    top_speed: float = 2.0,
    there: jax.Array | None = None,
) -> jax.Array:
    """Returns the velocities (S, 2), m/s, of S sheep during the next environment step, s.

        v += 2 s N(0, I) + (s / 1.5) (c - p) / |c - p| + sum over robots of 0.2 r / q^1.4

    p are the sheep's positions (S, 2), m, c their centre, v their velocities, s the restlessness,
    m/s. With r = p - p_robot and q = |r squared elementwise|, robots beyond q = 9 have no effect.
    One sheep has no c. Each component is then clipped to the top speed. Half of the speed that
    ground friction removes in a step is subtracted before this and half after it: the sheep moves
    at the step's mean speed. Sheep that are not `there` (S,) stand still outside the flock; by
    default all are there. Source: paper, section III, with the constants of the released system.
    """
    half = friction * GRAVITY * step / 2
    velocity = slow_down(velocity, half)
    velocity += 2 * restlessness * jax.random.normal(key, position.shape)
    if len(position) > 1:
        taking_part = None if there is None else there[:, None]
        inward = jnp.mean(position, axis=0, where=taking_part) - position
        velocity += restlessness / 1.5 * inward / jnp.maximum(_length(inward), 1e-6)
    away = position[:, None] - robots[None]
    nearness = jnp.maximum(_length(jnp.square(away)), 1e-3)
    velocity += jnp.sum(jnp.where(nearness > 9.0, 0.0, 0.2 * away / nearness**1.4), axis=1)
    velocity = slow_down(jnp.clip(velocity, -top_speed, top_speed), half)
    return velocity if there is None else jnp.where(there[:, None], velocity, 0.0)


def slow_down(velocity: jax.Array, loss: float) -> jax.Array:
    """Reduces each speed by `loss` m/s, clamped at zero: velocities (..., 2) -> (..., 2)."""
    speed = jnp.maximum(_length(velocity), 1e-9)
    return velocity * jnp.maximum(1.0 - loss / speed, 0.0)


def defend(position: jax.Array, yaw: jax.Array, ball: jax.Array, goal: jax.Array) -> jax.Array:
    """Returns the walk commands (3,) of a robot that stays between ball and goal.

    They are vx and vy, m/s, and the yaw rate, rad/s. p is the robot's position, g the goal,
    t = 0.6 ball + 0.4 g. wrap() maps an angle to [-pi, pi].

        yaw rate = clip(wrap(angle of (p - g) - yaw), -0.3, 0.3) / 0.3   (faces away from its goal)
        vx = clip(|t - g| - |p - g|, -0.5, 0.5)                          (as far from g as t is)
        vy = -clip(distance of p to the left of the line g -> t, -0.5, 0.5)

    Positions are (2,), m, the goal's is the midpoint of its line; yaw is in rad.
    Source: paper, section III, with the constants of the released system.
    """
    own = position - goal
    target = 0.6 * (ball - goal)
    distance = jnp.linalg.norm(target)
    turn = jnp.arctan2(own[1], own[0]) - yaw
    left = (target[0] * own[1] - target[1] * own[0]) / jnp.maximum(distance, 1e-6)
    return jnp.stack(
        [
            jnp.clip(distance - jnp.linalg.norm(own), -0.5, 0.5),
            -jnp.clip(left, -0.5, 0.5),
            jnp.clip(jnp.arctan2(jnp.sin(turn), jnp.cos(turn)), -0.3, 0.3) / 0.3,
        ]
    )


def _length(vector: jax.Array) -> jax.Array:
    return jnp.linalg.norm(vector, axis=-1, keepdims=True)
