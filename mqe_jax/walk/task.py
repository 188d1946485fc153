"""Parameters of the walking task of all skills, and their sampling."""

import dataclasses
from typing import Annotated

import jax
import jax.numpy as jnp
from annotated_types import Ge, Le

from mqe_jax.core.limits import (
    Buffer,
    Distance,
    Few,
    Force,
    Fraction,
    Iterations,
    Positive,
    Time,
    TimeLimit,
    Velocity,
)
from mqe_jax.core.settings import Range, settings_class
from mqe_jax.envs.params import TaskParams
from mqe_jax.envs.randomization import Randomization
from mqe_jax.walk.rewards import WalkRewards
from mqe_jax.walk.trainees import VELOCITY, Trainee

LATENT_TARGET = slice(-2, None)  # of the privileged observation: friction and payload, scaled
RANDOMIZATION = Randomization(
    friction=(0.35, 1.8),
    payload=(-1.0, 2.5),
    center_of_mass=(-0.025, 0.025),
    motor_strength=(0.9, 1.1),
    motor_offset=0.02,
)


@settings_class
class WalkTask:
    """Parameters of the walking task."""

    rewards: WalkRewards = WalkRewards()
    """Weights of the reward terms."""
    episode_length: TimeLimit = 20.0
    """Time limit, s."""
    command_period: Time = 8.0
    """Interval at which commands, slope and force are resampled, s; 0 never resamples."""
    start: Fraction = 1.0
    """Share of the skill's ranges from which commands are drawn at assistance 1."""
    tolerance: Positive = 1.0
    """Factor on the errors at which the tracking terms have half of their value."""
    slope: Annotated[float, Ge(0), Le(1.5)] = 0.32
    """Maximum slope, rad."""
    slope_share: Fraction = 0.5
    """Fraction of the episodes' specs that have a slope."""
    force: Force = 40.0
    """Maximum sustained horizontal force on the trunk of a Go1, N; on others in proportion to the
    mass."""
    push: Velocity = 0.9
    """Maximum instantaneous change of the trunk's velocity, m/s."""
    push_period: TimeLimit = 4.0
    """Mean time between pushes, s."""
    shove: Force = 0.0
    """Maximum force of a shove at a random point of a Go1's trunk, as by a robot or a box, N; on
    others in proportion to the mass."""
    shove_length: Range = (0.2, 1.0)
    """Duration of a shove, s."""
    shove_period: TimeLimit = 5.0
    """Mean time between shoves, s."""
    action_lag: Annotated[int, Ge(0), Le(1)] = 0
    """Maximum delay of the joint targets, steps; one sample per episode."""
    randomize: bool = True
    """Whether friction, payload, centre of mass, motors and observations are randomised."""
    solver_iterations: Iterations = 4
    """Solver iterations per physics step."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class EpisodeSpec:
    """Commands and disturbances sampled for one episode."""

    commands: jax.Array
    """Commands of the walk policy (15,): the velocity, then the gait that the rewards ask for."""
    slope: jax.Array
    """Inclination of the ground along x and y (2,), rad; positive x rises towards +x."""
    force: jax.Array
    """Sustained horizontal force on the trunk along its heading and to its left (2,), N."""
    push: jax.Array
    """Instantaneous change of the trunk's velocity at each push (), m/s."""
    shove: jax.Array
    """Maximum force of a shove (), N."""


@settings_class
class WalkParams(TaskParams):
    """Parameters of the walking environment: a `WalkTask` and what the base class needs of it."""

    num_agents: Few = 1
    spawn_noise: Distance = 0.0
    end_on_collision: bool = True
    contacts_per_robot: Buffer = 16
    constraints_per_robot: Buffer = 80
    privileged_contact_forces: bool = True
    frozen_time: Time = 0.0
    walk: WalkTask = WalkTask()
    """Parameters of the walking task."""

    @property
    def rewards(self) -> WalkRewards:
        """Weights of the reward terms."""
        return self.walk.rewards


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class WalkState:
    """The task's own state. Slopes, forces, pushes and shoves are scaled by 1 - `assistance`."""

    spec: EpisodeSpec
    """Commands and disturbances."""
    slope: jax.Array
    """Current slope (2,), rad; its rate towards the spec's is limited."""
    force: jax.Array
    """Current force (2,), N; its rate towards the spec's is limited."""
    shove: jax.Array
    """Force, N, and torque, N m, of the current shove on the trunk, world frame (6,)."""
    shove_steps: jax.Array
    """Steps until the current shove ends () int32."""
    actions: jax.Array
    """The last three actions, newest first (3, 12)."""
    gait: jax.Array
    """Phase of the gait cycle () in [0, 1)."""
    mean_error: jax.Array
    """Exponential mean of the error of vx, vy and yaw rate (3,), m/s and rad/s."""


def sample_spec(
    key: jax.Array, task: WalkTask, trainee: Trainee, assistance: jax.Array | float
) -> EpisodeSpec:
    """Samples an episode's commands and disturbances."""
    keys = iter(jax.random.split(key, 24))

    def uniform(low: float, high: float) -> jax.Array:
        return jax.random.uniform(next(keys), (), minval=low, maxval=high)

    def chance(p: float) -> jax.Array:
        return jax.random.bernoulli(next(keys), p)

    difficulty = 1.0 - assistance
    share = task.start + (1.0 - task.start) * difficulty
    ranges = trainee.skill.trained_ranges(VELOCITY)
    velocity = share * jnp.stack([uniform(low, high) for low, high in ranges])
    velocity = jnp.where(chance(0.25), velocity * jnp.array([1.0, 0.0, 0.0]), velocity)
    velocity = jnp.where(chance(0.1), jnp.zeros(3), velocity)
    if trainee.skill.turn is not None:
        excess = jnp.maximum(jnp.abs(velocity[0] * velocity[2]) / trainee.skill.turn, 1.0)
        velocity *= jnp.stack([excess**-0.5, jnp.ones(()), excess**-0.5])
    commands = trainee.sample(velocity, uniform, chance)
    angle = uniform(-jnp.pi, jnp.pi)
    slope = jnp.where(chance(task.slope_share), uniform(0.0, task.slope), 0.0) * difficulty
    direction = uniform(-jnp.pi, jnp.pi)
    force = jnp.where(chance(0.5), uniform(0.0, task.force), 0.0) * difficulty
    return EpisodeSpec(
        commands=commands,
        slope=slope * jnp.stack([jnp.cos(angle), jnp.sin(angle)]),
        force=force * jnp.stack([jnp.cos(direction), jnp.sin(direction)]),
        push=jnp.asarray(task.push * difficulty),
        shove=jnp.asarray(task.shove * difficulty),
    )
