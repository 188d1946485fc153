"""Scripted policies of football.

A robot moves behind the ball, faces an open part of the goal and pushes the ball.
"""

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.policies.scripted import Observation, go_to

_GOAL_AIMS = np.array([[12.2, -0.6], [12.2, 0.0], [12.2, 0.6]], np.float32)  # m, points in the goal
_GOAL = np.array([12.0, 0.0], np.float32)  # m
# Against the defender: the ball passes it on the flank at this point (x, distance from the centre
# line), m. On the straight line to the goal, the defender would deflect it beyond the post.
_FLANK = (10.0, 1.5)
# m, further from the posts
_INNER_AIMS = np.array([[12.2, -0.55], [12.2, 0.0], [12.2, 0.55]], np.float32)
_TURN_IN = 9.4  # m, x of the ball from which it is pushed towards the goal
# m, x of the ball from which both robots attack: a failed attack leaves it at the goal line
_BOTH = 11.2
_LEAD = 0.3  # s, over which the ball's motion is predicted
_OWN_GOAL = np.array([2.5, 0.0], np.float32)  # m
_WING = 1.8  # m, y of covering robots from the line between ball and own goal
# m, distance behind the ball of the supporting robot, which stays on the centre line
_KEEP_BACK = 2.0


def plan_defender(obs: Observation) -> jax.Array:
    """Returns both robots' actions (2, 3) against the defender.

    One robot dribbles past the defender on the flank, then turns in to the goal. The robot nearer
    to the point behind the ball, as seen from the goal, attacks; the other supports. Both attack a
    ball at the goal line. Robots do not observe the defender: the policy assumes it at the target
    position of its control law.
    """
    ball = obs["ball"][0, :2]
    velocity = obs["ball_velocity"][0, :2]
    opponents = (0.6 * ball + 0.4 * _GOAL)[None]
    flank = jnp.array([_FLANK[0], jnp.where(ball[1] > 0, _FLANK[1], -_FLANK[1])])
    aims = jnp.where(ball[0] < _TURN_IN, flank, _INNER_AIMS)
    ahead = ball + _LEAD * velocity
    way = _GOAL - ball
    start = ahead - 0.6 * way / jnp.maximum(jnp.linalg.norm(way), 1e-3)
    support = jnp.array([jnp.minimum(ahead[0] - _KEEP_BACK, 9.5), 0.0])

    def play(own: jax.Array, teammate: jax.Array) -> jax.Array:
        attack, way = _attack(own, opponents, ball, velocity, aims)
        nearer = jnp.linalg.norm(own[:2] - start) < jnp.linalg.norm(teammate[:2] - start)
        return _walk(own, jnp.where(nearer | (ball[0] > _BOTH), attack, support), way)

    return jax.vmap(play)(obs["base"], obs["teammate"])


def plan_match(obs: Observation) -> jax.Array:
    """Returns the actions (T, 3) of a team in its own frame."""
    mates = obs.get("teammate", jnp.full_like(obs["base"], 1e3))  # far away without one
    mates = mates.reshape(len(mates), -1, 6)[..., :2]
    opponents = obs["opponents"].reshape(len(obs["opponents"]), -1, 6)[..., :2]
    return jax.vmap(_play)(
        obs["base"], mates, opponents, obs["ball"][:, :2], obs["ball_velocity"][:, :2]
    )


def _play(
    own: jax.Array, mates: jax.Array, opponents: jax.Array, ball: jax.Array, velocity: jax.Array
) -> jax.Array:
    """Returns one robot's action (3,) by its place in the order of distances to the ball.

    The nearest robot attacks the ball, the second one supports from behind it, and the others stand
    between ball and own goal, alternately on either side. `own` is base information (6,), `mates`
    are positions (K, 2), m; the others are those of `_attack`.
    """
    attack, way = _attack(own, opponents, ball, velocity, _GOAL_AIMS)
    ball = ball + _LEAD * velocity
    left = way[::-1] * jnp.array([-1.0, 1.0])
    offset = own[:2] - ball
    support = ball - 1.5 * way + 0.8 * jnp.sign(offset @ left) * left
    others = jnp.linalg.norm(mates - ball, axis=-1)
    place = jnp.sum(jnp.linalg.norm(offset) >= others)
    goal = jnp.where(place == 0, attack, support)
    if len(mates) > 1:
        goal = jnp.where(place > 1, _cover(place, len(mates) - 1, ball), goal)
    return _walk(own, goal, way)


def _cover(place: jax.Array, count: int, ball: jax.Array) -> jax.Array:
    """Returns the place (2,), m, of one of `count` robots that neither attack nor support.

    Its index `place` () counts from 2.
    """
    share = (place - 1) / (count + 1)  # of the way to the own goal
    side = jnp.where(place % 2 == 0, 1.0, -1.0)
    return (1.0 - share) * ball + share * _OWN_GOAL + side * jnp.array([0.0, _WING])


def _attack(
    own: jax.Array,
    opponents: jax.Array,
    ball: jax.Array,
    velocity: jax.Array,
    aims: jax.Array | np.ndarray,
) -> tuple[jax.Array, jax.Array]:
    """Returns an attacker's goal position (2,), m, and the unit vector from ball to aim (2,).

    It chooses the aim with the most clearance and the least turning.

    Args:
        own: base information (6,).
        opponents: positions (K, 2), m.
        ball: position (2,), m.
        velocity: of the ball (2,), m/s.
        aims: candidate target points of the ball (M, 2), m.
    """
    position = own[:2]
    yaw = own[5]
    near = jnp.linalg.norm(position - ball) < 0.35
    ball = ball + _LEAD * velocity
    facing = jnp.array([jnp.cos(yaw), jnp.sin(yaw)])
    offset = position - ball
    distance = jnp.linalg.norm(offset)
    # The aim with the most clearance and the least turning.
    ways = aims - ball
    ways = ways / jnp.linalg.norm(ways, axis=-1, keepdims=True)
    lefts = ways[:, ::-1] * jnp.array([-1.0, 1.0])
    ahead = ways @ (opponents - ball).T
    apart = jnp.abs(lefts @ (opponents - ball).T)
    free = jnp.min(jnp.where(ahead > 0, jnp.minimum(apart, 0.5), 0.5), axis=1)
    straight = ways @ (facing - offset / jnp.maximum(distance, 1.0))
    # not an index, which ONNX graphs cannot batch
    best = jax.nn.one_hot(jnp.argmax(2 * free + straight), len(aims))
    way = best @ ways
    left = best @ lefts
    along = offset @ way
    lateral = offset @ left
    lined_up = (along < -0.2) & (jnp.abs(lateral) < 0.1 + 0.3 * jnp.maximum(-along - 0.3, 0.0))
    between_legs = near & (jnp.abs(lateral) < 0.25) & (facing @ way > 0.5)
    push = position + 0.8 * way - 1.5 * lateral * left
    behind = ball - 0.5 * way
    # From in front of the ball: first to the side, then back.
    side = jnp.sign(lateral) * left
    around = jnp.where(jnp.abs(lateral) < 0.3, position + 0.6 * side, behind + 0.45 * side)
    return jnp.where(lined_up | between_legs, push, jnp.where(along > -0.3, around, behind)), way


def _walk(own: jax.Array, goal: jax.Array, way: jax.Array) -> jax.Array:
    """Returns one robot's action (3,) towards a goal position (2,), facing along `way` (2,)."""
    return go_to(own[None, :2], own[None, 5], goal[None], jnp.arctan2(way[1], way[0]))[0]
