"""Reward terms of skills that walk, after walk-these-ways (arXiv 2212.03238)."""

import functools

import jax
import jax.numpy as jnp

from mqe_jax.core.settings import settings_class
from mqe_jax.physics.robots.index import RobotState
from mqe_jax.physics.robots.robot import Robot
from mqe_jax.physics.rotation import (
    euler_to_quaternion,
    quaternion_to_euler,
    rotate,
    rotate_inverse,
)


@settings_class
class WalkRewards:
    """Weights of the reward terms: four positive terms, then those that go into the exponent.

    `limb_contact` counts legs whose thigh or calf touches the ground. On flat ground the knee
    touches first, so contact is inferred from the knee's height (`WalkSettings.min_knee_height`)
    without sensors.
    """

    track_velocity: float = 0.6
    track_mean_velocity: float = 0.7
    track_yaw: float = 0.5
    track_mean_yaw: float = 0.4
    swing_force: float = -4.0
    stance_speed: float = -4.0
    body_height: float = -100.0
    orientation: float = -5.0
    raibert: float = -10.0
    footswing_height: float = -30.0
    foot_slip: float = -0.04
    smoothness: float = -0.1
    second_smoothness: float = -0.1
    torque: float = -1e-4
    joint_velocity: float = -1e-4
    joint_limit: float = -10.0
    limb_contact: float = -5.0
    vertical_speed: float = -0.02
    roll_pitch_rate: float = -0.001


POSITIVE_TERMS = ("track_velocity", "track_mean_velocity", "track_yaw", "track_mean_yaw")
_BLUR = 0.07  # of a gait period: standard deviation of the smoothing of desired contacts


def desired_contact(phases: jax.Array) -> jax.Array:
    """Returns the desired contact of each foot in [0, 1] from its phase (4,).

    Lift-off and touch-down are smoothed.
    """
    cdf = functools.partial(jax.scipy.stats.norm.cdf, scale=_BLUR)
    return cdf(phases) * (1 - cdf(phases - 0.5)) + cdf(phases - 1) * (1 - cdf(phases - 1.5))


def _closeness(error: jax.Array, half: float) -> jax.Array:
    """Returns 1 at no error and 1/2 at an error (D,) of length `half`.

    It is steep near 0 and has a gradient far from it.
    """
    return 1.0 / (1.0 + jnp.sum(jnp.square(error / half)))


def reward_terms(
    robot: Robot,
    robot_state: RobotState,
    commands: jax.Array,
    *,
    error: jax.Array,
    mean_error: jax.Array,
    phases: jax.Array,
    targets: jax.Array,
    applied: jax.Array,
    foot_force: jax.Array,
    strength: jax.Array,
    tolerance: float,
) -> dict[str, jax.Array]:
    """Computes all terms (), named as their weights in `WalkRewards`.

    `phases` are those of the feet (4,). `targets` are the joint targets of the last three steps,
    newest first (3, 12), and `applied` the one that the motors had. `tolerance` is that of
    `WalkTask`. The others are as in `WalkState`. Lengths, forces, torques and rates count relative
    to the robot's height and mass.
    """
    target, previous_target, earlier_target = targets
    size = robot.proportions.height
    weight = robot.proportions.mass
    quaternion = robot_state.quaternion[0]
    height = robot_state.position_w[0, 2]
    joint_position = robot_state.joint_position[0]
    joint_velocity = robot_state.joint_velocity[0]
    contact = desired_contact(phases)
    force = foot_force / weight
    velocity_b = rotate_inverse(quaternion, robot_state.linear_velocity_w[0])
    rate = robot_state.angular_velocity_b[0]

    feet, feet_velocity = jax.jvp(robot.foot_positions, (joint_position,), (joint_velocity,))
    feet_velocity = feet_velocity + velocity_b + jnp.cross(rate, feet)
    turn = jnp.broadcast_to(quaternion, (4, 4))
    feet_w = rotate(turn, feet)
    feet_velocity = rotate(turn, feet_velocity)
    foot_height = feet_w[:, 2] + height
    yaw = quaternion_to_euler(quaternion)[2]
    cos = jnp.cos(yaw)
    sin = jnp.sin(yaw)
    feet_heading = jnp.stack(
        [cos * feet_w[:, 0] + sin * feet_w[:, 1], -sin * feet_w[:, 0] + cos * feet_w[:, 1]], -1
    )

    # Raibert heuristic: stance corners, shifted by half of the distance travelled during stance.
    along = jnp.array([0.5, 0.5, -0.5, -0.5])
    across = jnp.array([0.5, -0.5, 0.5, -0.5])
    stance = jnp.stack([along * commands[13], across * commands[12]], -1)
    shift = jnp.abs(1.0 - 2.0 * phases) - 0.5
    speed = jnp.stack(
        [commands[0] - commands[2] * stance[:, 1], commands[1] + commands[2] * stance[:, 0]], -1
    )
    place = stance + shift[:, None] * speed * 0.5 / commands[4]
    swing = 1.0 - jnp.abs(1.0 - 2.0 * jnp.clip(2.0 * phases - 1.0, 0.0, 1.0))
    wanted_height = commands[9] * size * swing + robot.foot_radius

    up = rotate_inverse(quaternion, jnp.array([0.0, 0.0, 1.0]))
    tilt = euler_to_quaternion(jnp.stack([commands[11], commands[10], jnp.zeros(())]))
    wanted_up = rotate_inverse(tilt, jnp.array([0.0, 0.0, 1.0]))
    torque = strength * (robot.kp * (applied - joint_position) - robot.kd * joint_velocity)
    torque = jnp.clip(torque, -robot.torque_limit, robot.torque_limit)
    margin = 0.05 * (robot.joint_upper - robot.joint_lower)
    beyond = jnp.maximum(joint_position - robot.joint_upper + margin, 0)
    beyond += jnp.maximum(robot.joint_lower + margin - joint_position, 0)
    knees = rotate(turn, robot.knee_positions(joint_position))[:, 2] + height
    kneeling = jnp.maximum(robot.walk.min_knee_height - knees, 0.0) > 0
    foot_speed = jnp.sum(jnp.square(feet_velocity), axis=-1)
    foot_speed_xy = jnp.sum(jnp.square(feet_velocity[:, :2]), axis=-1)
    return {
        "track_velocity": jnp.exp(-jnp.sum(jnp.square(error[:2] / (0.5 * tolerance)))),
        "track_mean_velocity": _closeness(mean_error[:2], 0.055 * tolerance),
        "track_yaw": _closeness(error[2:], 0.14 * tolerance),
        "track_mean_yaw": _closeness(mean_error[2:], 0.055 * tolerance),
        "swing_force": jnp.mean((1 - contact) * (1 - jnp.exp(-jnp.square(force) / 100.0))),
        "stance_speed": jnp.mean(contact * (1 - jnp.exp(-foot_speed / size / 10.0))),
        "body_height": jnp.square((height - robot.stand_height - commands[3]) / size),
        "orientation": jnp.sum(jnp.square(up[:2] - wanted_up[:2])),
        "raibert": jnp.sum(jnp.square((feet_heading - place) / size)),
        "footswing_height": jnp.sum(
            (1 - contact) * jnp.square((foot_height - wanted_height) / size)
        ),
        "foot_slip": jnp.sum(jnp.where(force > 1.0, foot_speed_xy / size, 0.0)),
        "smoothness": jnp.sum(jnp.square(target - previous_target)),
        "second_smoothness": jnp.sum(jnp.square(target - 2 * previous_target + earlier_target)),
        "torque": jnp.sum(jnp.square(torque / (weight * size))),
        "joint_velocity": size * jnp.sum(jnp.square(joint_velocity)),
        "joint_limit": jnp.sum(beyond),
        "limb_contact": jnp.sum(kneeling).astype(jnp.float32),
        "vertical_speed": jnp.square(robot_state.linear_velocity_w[0, 2]) / size,
        "roll_pitch_rate": size * jnp.sum(jnp.square(rate[:2])),
    }
