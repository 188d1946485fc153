"""Parameters of the walking task, and their sampling."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Annotated

import jax
import jax.numpy as jnp
import numpy as np
from annotated_types import Ge, Le

from mqe_jax import walk_policy
from mqe_jax.envs.randomization import Randomization, RandomizedParams
from mqe_jax.envs.state import EnvironmentState
from mqe_jax.limits import Fraction, Iterations, NonNegative, Time, TimeLimit
from mqe_jax.robots.robot import Robot
from mqe_jax.settings import record
from mqe_jax.walk.rewards import WalkRewards
from mqe_jax.walk_policy import WalkMemory

if TYPE_CHECKING:
    from mujoco import mjx

LATENT_TARGET = slice(-2, None)  # of the privileged observation: friction and payload, scaled
RANDOMIZATION = Randomization(
    friction=(0.35, 1.8), payload=(-1.0, 2.5), center_of_mass=(-0.025, 0.025), motor_strength=(0.9, 1.1)
)


@record
class WalkTask:
    """Parameters of the walking task."""

    rewards: WalkRewards = WalkRewards()
    """Weights of the reward terms."""
    episode_length: TimeLimit = 20.0
    """Time limit, s."""
    command_period: Time = 8.0
    """Interval at which commands, slope and force are resampled, s; 0 never resamples."""
    max_vx: NonNegative = 1.2
    """Maximum commanded forward velocity, m/s."""
    max_vy: NonNegative = 0.7
    """Maximum commanded lateral velocity, m/s."""
    max_yaw: NonNegative = 1.2
    """Maximum commanded yaw rate, rad/s."""
    slope: Annotated[float, Ge(0), Le(1.5)] = 0.32
    """Maximum slope, rad."""
    slope_share: Fraction = 0.5
    """Fraction of the episodes' specs that have a slope."""
    force: NonNegative = 40.0
    """Maximum sustained horizontal force on the trunk, N."""
    push: NonNegative = 0.9
    """Maximum instantaneous change of the trunk's velocity, m/s."""
    push_period: TimeLimit = 4.0
    """Mean time between pushes, s."""
    randomize: bool = True
    """Whether friction, payload, centre of mass, motors and observations are randomised."""
    solver_iterations: Iterations = 4
    """Solver iterations per physics step."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class EpisodeSpec:
    """Commands and disturbances sampled for one episode."""

    commands: jax.Array
    """Commands of the walk policy (15,)."""
    slope: jax.Array
    """Inclination of the ground along x and y (2,), rad; positive in x where the ground rises towards +x."""
    force: jax.Array
    """Sustained force on the trunk (2,), N, along its heading and to its left, horizontal."""
    push: jax.Array
    """Instantaneous change of the trunk's velocity at each push (), m/s."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class WalkState(EnvironmentState):
    """State of one environment: the walk policy's observation (1, 70), noisy if randomised, and the critic's (P,).

    `LATENT_TARGET` of the latter is the regression target of the adaptation network. Slopes, forces and pushes are
    scaled by 1 - `assistance`.
    """

    data: mjx.Data
    """Physics state."""
    spec: EpisodeSpec
    """Commands and disturbances."""
    slope: jax.Array
    """Current slope, rate-limited towards the spec's (2,), rad."""
    force: jax.Array
    """Current force, rate-limited towards the spec's (2,), N."""
    random: RandomizedParams
    """Randomised physics parameters."""
    motor_offset: jax.Array
    """Offset added to the joint targets (12,), rad."""
    memory: WalkMemory
    """Recurrent state of the walk policy: gait phase and last actions; the history is empty."""
    mean_error: jax.Array
    """Exponential mean of the velocity error (vx, vy, yaw rate) (3,), m/s and rad/s."""
    episode_steps: jax.Array
    """Steps since the reset () int32."""


def sample_spec(key: jax.Array, task: WalkTask, robot: Robot, difficulty: jax.Array | float) -> EpisodeSpec:
    """Samples commands and disturbances; `difficulty` in [0, 1] scales slopes, forces and pushes."""
    keys = iter(jax.random.split(key, 24))
    uniform = lambda low, high: jax.random.uniform(next(keys), (), minval=low, maxval=high)  # noqa: E731
    chance = lambda p: jax.random.bernoulli(next(keys), p)  # noqa: E731
    velocity = jnp.stack(
        [uniform(-task.max_vx, task.max_vx), uniform(-task.max_vy, task.max_vy), uniform(-task.max_yaw, task.max_yaw)]
    )
    velocity = jnp.where(chance(0.25), velocity * jnp.array([1.0, 0.0, 0.0]), velocity)
    velocity = jnp.where(chance(0.1), jnp.zeros(3), velocity)
    names = ("trot", "pace", "bound", "pronk")
    gaits = np.array([list(walk_policy.GAITS[name].values()) for name in names], np.float32)
    gait = jnp.asarray(gaits)[jax.random.categorical(next(keys), jnp.log(jnp.array([0.6, 0.32, 0.04, 0.04])))]
    varied = chance(0.5)
    vary = lambda low, high, default: jnp.where(varied, uniform(low, high), default)  # noqa: E731
    default = walk_policy.WalkPolicy(robot).default_commands()
    width, length = robot.walk.stance_width, robot.walk.stance_length
    rest = [
        vary(-0.12, 0.06, default[3]),
        vary(1.8, 4.2, default[4]),
        *gait,
        default[8],
        vary(0.03, 0.16, default[9]),
        vary(-0.25, 0.25, default[10]),
        vary(-0.1, 0.1, default[11]),
        vary(width - 0.05, width + 0.1, default[12]),
        vary(length - 0.068, length + 0.012, default[13]),
        default[14],
    ]
    angle = uniform(-jnp.pi, jnp.pi)
    slope = jnp.where(chance(task.slope_share), uniform(0.0, task.slope), 0.0) * difficulty
    direction = uniform(-jnp.pi, jnp.pi)
    force = jnp.where(chance(0.5), uniform(0.0, task.force), 0.0) * difficulty
    return EpisodeSpec(
        commands=jnp.concatenate([velocity, jnp.stack([jnp.asarray(x, jnp.float32) for x in rest])]),
        slope=slope * jnp.stack([jnp.cos(angle), jnp.sin(angle)]),
        force=force * jnp.stack([jnp.cos(direction), jnp.sin(direction)]),
        push=jnp.asarray(task.push * difficulty),
    )
