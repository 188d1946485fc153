"""Scripted policies of Push Cylinder, Revolving Door, Sumo Wrestling and Traverse Bridge."""

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.policies.scripted import GAIN, Observation, go_to, pose

# Push Cylinder: align with the cylinder's axis, then push slightly faster than it moves.
_AXIS_X = 1.6  # m, of the line on which the cylinder slides
_ALIGNED = 0.25  # m, distance from that line within which a robot pushes
_BEFORE = 1.65  # m, distance from the cylinder's axis at which a robot aligns
_EXCESS = 0.4  # m/s, goal speed of a pushing robot relative to the cylinder


def plan_tug(obs: Observation) -> jax.Array:
    """Returns the robot's action (1, 3) in its own frame."""
    (position, yaw) = pose(obs["base"])
    (cylinder, speed) = obs["cylinder"].T
    x, y = position.T
    # Align first: a robot that pushes off-axis slides along the cylinder.
    before = jnp.minimum(cylinder - _BEFORE, y)
    # Full speed against a blocked cylinder deflects the robot and tips it over.
    push = jnp.minimum(cylinder, y + (jnp.maximum(speed, 0.0) + _EXCESS) / GAIN)
    ahead = jnp.where(jnp.abs(x - _AXIS_X) < _ALIGNED, push, before)
    goal = jnp.stack([jnp.full_like(ahead, _AXIS_X), ahead], axis=-1)
    return go_to(position, yaw, goal, jnp.pi / 2)


# Revolving Door: push the near half of the door open, far from the hinge, and walk through.
_LANE = -0.62  # m, y: a long lever about the hinge, clear of the wall


def plan_revolving_door(obs: Observation) -> jax.Array:
    """Returns the robot's action (1, 3) in its own frame."""
    position, yaw = pose(obs["base"])
    in_lane = jnp.abs(position[:, 1] - _LANE) < 0.15
    through = position[:, 0] > 2.4
    ahead = jnp.where(in_lane | through | (position[:, 0] < 1.6), position[:, 0] + 1.5, 1.7)
    return go_to(position, yaw, jnp.stack([ahead, jnp.full_like(ahead, _LANE)], axis=-1))


# Sumo Wrestling: push the opponent out of the ring sideways, to avoid slipping past it.
_CENTER = np.array([3.1, 0.0], np.float32)  # m, of the ring
# m, forward offset of the contact point (the side between the legs) from the trunk's centre
_AHEAD = 0.05
_STAND_OFF = 0.65  # m, distance from the opponent until the robot is side on
# m, range of the distance from the centre at which the robot turns back; grows with the opponent's
_EDGE = (1.5, 1.64)


def plan_wrestling(obs: Observation) -> jax.Array:
    """Returns a team's actions (T, 3) in its own frame.

    Each robot of a larger team meets the nearest opponent.
    """
    (position, yaw) = pose(obs["base"])
    opponent = _nearest(obs)
    far = jnp.linalg.norm(opponent - _CENTER, axis=-1)
    outward = (opponent - _CENTER) / jnp.maximum(far, 1e-3)[:, None]
    left = jnp.stack([-outward[:, 1], outward[:, 0]], axis=-1)
    heading = jnp.arctan2(left[:, 1], left[:, 0])
    apart = position - opponent
    along = jnp.sum(apart * outward, axis=-1)
    across = jnp.sum(apart * left, axis=-1) + _AHEAD
    side_on = (jnp.abs(jnp.sin(yaw - heading)) < 0.4) & (jnp.abs(across) < 0.12)
    pushing = (side_on | ((along > -0.5) & (jnp.abs(across) < 0.25))) & (along < 0.05)
    # A robot beyond the opponent walks around it.
    lateral = jnp.where((along > -0.35) & ~pushing, jnp.where(across > 0, 0.7, -0.7), 0.0) - _AHEAD
    reach = jnp.where(pushing, 0.6, -_STAND_OFF)
    goal = opponent + reach[:, None] * outward + lateral[:, None] * left
    back = go_to(position, yaw, jnp.broadcast_to(_CENTER, position.shape), yaw)
    at_edge = jnp.linalg.norm(position - _CENTER, axis=-1) > jnp.clip(far - 0.08, *_EDGE)
    return jnp.where(at_edge[:, None], back, go_to(position, yaw, goal, heading))


def _nearest(obs: Observation) -> jax.Array:
    """Returns the position (T, 2), m, of the nearest opponent that is still in."""
    if "opponent" in obs:
        return obs["opponent"][:, :2]
    # base information, and whether it is in
    opponents = obs["opponents"].reshape(len(obs["base"]), -1, 7)
    apart = jnp.linalg.norm(opponents[..., :2] - obs["base"][:, None, :2], axis=-1)
    apart = jnp.where(opponents[..., 6] > 0.5, apart, 1e3)
    # as an index ONNX graphs cannot batch it
    chosen = jax.nn.one_hot(jnp.argmin(apart, axis=-1), apart.shape[-1])
    return jnp.sum(chosen[..., None] * opponents[..., :2], axis=-2)


# Traverse Bridge: push the opponent back from the end of the bridge, then walk beside it.
_LEAD = 1.0  # m, distance of the goal ahead of the robot, for full speed while it pushes
# m, distance of the opponent ahead below which the robot aims at its centre, not to slip past it
_NEAR = 1.0
_MAX_AIM = 0.1  # m, y; the feet are 0.15 m from the robot's centre, the bridge's edges 0.35 m
_OFF_BRIDGE = 7.25  # m, x, beyond which the hind feet are on the far platform
# m, x and |y| of the goal on the far platform, on the side away from the opponent
_REST = (7.6, 0.6)


def plan_bridge(obs: Observation) -> jax.Array:
    """Returns the robot's action (1, 3) in its own frame."""
    (position, yaw) = pose(obs["base"])
    opponent = obs["opponent"][:, :2]
    x, y = position.T
    middle = jnp.where(
        opponent[:, 0] - x < _NEAR, jnp.clip(opponent[:, 1], -_MAX_AIM, _MAX_AIM), 0.0
    )
    beside = jnp.where(y > opponent[:, 1], _REST[1], -_REST[1])
    goal_x = jnp.where(x < _REST[0] - 0.1, x + _LEAD, _REST[0])
    goal_y = jnp.where(x > _OFF_BRIDGE, beside, middle)
    return go_to(position, yaw, jnp.stack([goal_x, goal_y], axis=-1))
