"""The skills that the walking task trains: observations, gaits, and goals of the rewards."""

import abc
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax import walk_policy
from mqe_jax.core.errors import known_name
from mqe_jax.physics.robots.index import Proprioception
from mqe_jax.physics.robots.robot import Robot
from mqe_jax.skills import Skill, agile
from mqe_jax.skills.weights import check_legs
from mqe_jax.walk_policy import WalkMemory, WalkPolicy

VELOCITY = ("vx", "vy", "yaw_rate")
"""Names of the commands that are a velocity."""
Draw = Callable[[float, float], jax.Array]
Chance = Callable[[float], jax.Array]


class Trainee(abc.ABC):
    """A skill as the walking environment trains it, by the commands of the walk policy (15,)."""

    skill: Skill
    observation_size: int
    """Length of the skill's own observation of one step; its network gathers a history of them."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot

    @property
    def evaluation_range(self) -> np.ndarray:
        """Lowest and highest velocity commands in evaluations (3, 2), m/s and rad/s.

        Default: those of the training.
        """
        return self.skill.trained_ranges(VELOCITY)

    @abc.abstractmethod
    def sample(self, velocity: jax.Array, uniform: Draw, chance: Chance) -> jax.Array:
        """Samples commands (15,) with a velocity (3,).

        `uniform(low, high)` and `chance(p)` draw random numbers.
        """

    @abc.abstractmethod
    def observe(self, memory: WalkMemory, commands: jax.Array, sensed: Proprioception) -> jax.Array:
        """Builds the observation of one step."""

    @abc.abstractmethod
    def foot_phases(self, gait: jax.Array, commands: jax.Array) -> jax.Array:
        """Returns each foot's phase (4,) in [0, 1), FL FR RL RR: stance below 0.5, swing above."""


class Walk(Trainee):
    """The walk policy, with gaits drawn at random."""

    observation_size = walk_policy.OBSERVATION_SIZE

    def __init__(self, robot: Robot) -> None:
        super().__init__(robot)
        self.skill = WalkPolicy(robot)

    @property
    def evaluation_range(self) -> np.ndarray:
        return np.array([(-1.0, 1.0), (-0.6, 0.6), (-1.0, 1.0)])

    def sample(self, velocity: jax.Array, uniform: Draw, chance: Chance) -> jax.Array:
        names = ("trot", "pace", "bound", "pronk")
        odds = (0.6, 0.92, 0.96)
        gaits = np.array([list(walk_policy.GAITS[name].values()) for name in names], np.float32)
        gait = jnp.asarray(gaits)[jnp.sum(uniform(0.0, 1.0) >= jnp.array(odds))]
        varied = chance(0.5)

        def vary(low: float, high: float, default: float) -> jax.Array:
            return jnp.where(varied, uniform(low, high), default)

        default = self.skill.default_commands()
        width = self.robot.walk.stance_width
        length = self.robot.walk.stance_length
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
        return jnp.concatenate([velocity, jnp.stack([jnp.asarray(x, jnp.float32) for x in rest])])

    def observe(self, memory: WalkMemory, commands: jax.Array, sensed: Proprioception) -> jax.Array:
        return walk_policy.observe(self.robot, memory, commands, sensed)

    def foot_phases(self, gait: jax.Array, commands: jax.Array) -> jax.Array:
        return walk_policy.foot_phases(gait, commands)


class Agile(Trainee):
    """The agile skill, which trots at a frequency that its velocity command decides."""

    kind = agile.AgileSkill
    observation_size = agile.FRAME_SIZE + agile.NOW_SIZE

    def __init__(self, robot: Robot) -> None:
        super().__init__(robot)
        self.skill = self.kind(robot)

    def sample(self, velocity: jax.Array, uniform: Draw, chance: Chance) -> jax.Array:
        return self.commands(velocity)

    def commands(self, velocity: jax.Array) -> jax.Array:
        """Returns the commands (15,) of the trot with a velocity (3,)."""
        default = jnp.asarray(WalkPolicy(self.robot).default_commands("trot"))
        return (
            default.at[:3]
            .set(velocity)
            .at[4]
            .set(agile.frequency(velocity, agile.tempo(self.robot)))
        )

    def observe(self, memory: WalkMemory, commands: jax.Array, sensed: Proprioception) -> jax.Array:
        frame = agile.frame(self.robot, sensed, memory.action)
        return jnp.concatenate([frame, agile.now(memory.gait, commands[:3])])

    def foot_phases(self, gait: jax.Array, commands: jax.Array) -> jax.Array:
        return agile.foot_phases(gait, commands[:3])


class Climb(Agile):
    """The agile skill of steeper slopes."""

    kind = agile.ClimbSkill


TRAINEES: dict[str, type[Trainee]] = {"walk": Walk, "agile": Agile, "climb": Climb}


def make(name: str, robot: Robot) -> Trainee:
    """Returns a skill of a robot to train.

    InputError for a name that is not in `TRAINEES`, and for a robot without four legs of three
    joints.
    """
    trainee = TRAINEES[known_name("skill: cannot be trained:", name, TRAINEES)]
    check_legs(name, robot)
    return trainee(robot)
