"""The agile skill: fast velocity commands to joint targets, for one robot, by a small network.

Its memory holds frames of the last steps, the action that corresponds to the last joint targets,
and the phase of the gait cycle. A frame has 39 numbers:

| block | size | content |
|---|---|---|
| projected gravity | 3 | unit gravity vector in the trunk frame |
| joint position | 12 | minus the default angles, rad |
| joint velocity | 12 | times 0.05, rad/s |
| joint targets | 12 | of the step before, minus the default angles, over the action scale |

Input of the network: the frames of the steps `OFFSETS` before this one, oldest first (zeros before
an episode's first step), the three commands times their scale, and the clock. The clock is sine and
cosine of the phase of a trot, or zeros if the command is to stand. The trot's frequency grows with
the commanded velocity. Layers 200-256-256-128-12 with ELU give the action, clipped to +-10. The
joint target is default + scale x action.
"""

from __future__ import annotations

import dataclasses
import os

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.physics.robots.index import Proprioception
from mqe_jax.physics.robots.quadruped import NUM_JOINTS
from mqe_jax.physics.robots.robot import Robot
from mqe_jax.skills import Command, Skill, register
from mqe_jax.skills.weights import Networks, Params, layers

OFFSETS = (8, 4, 2, 1, 0)  # steps before the current one
LENGTH = max(OFFSETS) + 1
FRAME_SIZE = 3 + 3 * NUM_JOINTS
NOW_SIZE = 5  # commands and clock
NETWORKS = Networks(
    "agile",
    "agile skill",
    {"body": (len(OFFSETS) * FRAME_SIZE + NOW_SIZE, 256, 256, 128, NUM_JOINTS)},
)
STEP = 0.02  # s
ACTION_CLIP = 10.0
JOINT_VELOCITY_SCALE = 0.05
PRECISION = "tensorfloat32"  # as in the walk policy
FREQUENCY = (3.0, 4.2)  # of the trot, Hz: at rest, and from the velocity `FAST` on
FAST = np.array([2.5, 1.0, 2.5], np.float32)  # m/s forward, m/s to the left, rad/s
STAND = 0.02  # share of `FAST` below which the robot stands

COMMANDS = (
    Command("vx", "m/s forward", gain=2.0, limit=1.0, scale=2.0, trained=(-1.5, 2.5)),
    Command(
        "vy", "m/s to the left", gain=0.5, limit=0.5, scale=2.0, mirror=-1.0, trained=(-1.0, 1.0)
    ),
    Command("yaw_rate", "rad/s", gain=0.5, limit=0.5, mirror=-1.0, trained=(-2.5, 2.5)),
)
_SCALE = np.array([command.scale for command in COMMANDS], np.float32)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class AgileMemory:
    """Recurrent state of one robot's agile skill."""

    frames: jax.Array  # frames of the last steps, oldest first (9, 39); zeros after a reset
    action: jax.Array  # action that the last joint targets amount to (12,)
    gait: jax.Array  # phase of the gait cycle () in [0, 1)


def _pace(velocity: jax.Array) -> jax.Array:
    """Returns the commanded velocity (3,) as a share () of `FAST`."""
    return jnp.linalg.norm(velocity / FAST)


def stands(velocity: jax.Array) -> jax.Array:
    """Returns whether a robot with this commanded velocity (3,) should stand () bool."""
    return _pace(velocity) < STAND


def frequency(velocity: jax.Array, tempo: float = 1.0) -> jax.Array:
    """Returns the frequency () of the trot, Hz, at a commanded velocity (3,)."""
    low, high = (tempo * hertz for hertz in FREQUENCY)
    return low + (high - low) * jnp.minimum(_pace(velocity), 1.0)


def foot_phases(gait: jax.Array, velocity: jax.Array) -> jax.Array:
    """Returns each foot's phase (4,) in [0, 1), FL FR RL RR.

    Stance is below 0.5, swing above; standing is 0.25.
    """
    phases = jnp.mod(gait + jnp.array([0.5, 0.0, 0.0, 0.5]), 1.0)
    return jnp.where(stands(velocity), 0.25, phases)


def advance_gait(gait: jax.Array, velocity: jax.Array, tempo: float = 1.0) -> jax.Array:
    """Advances the gait phase by one step."""
    return jnp.mod(gait + STEP * frequency(velocity, tempo), 1.0)


def tempo(robot: Robot) -> float:
    """Returns the factor on the trot's frequency: that of a pendulum as long as the legs."""
    return robot.proportions.height**-0.5


def frame(robot: Robot, sensed: Proprioception, action: jax.Array) -> jax.Array:
    """Builds a frame (39,); `action` (12,) are the last joint targets as an action."""
    position = sensed.joint_position - robot.default_joints
    velocity = sensed.joint_velocity * JOINT_VELOCITY_SCALE
    return jnp.concatenate([sensed.gravity_b, position, velocity, action]).astype(jnp.float32)


def now(gait: jax.Array, velocity: jax.Array) -> jax.Array:
    """Returns scaled commands and clock (5,)."""
    angle = 2 * jnp.pi * gait
    clock = jnp.where(stands(velocity), 0.0, jnp.stack([jnp.sin(angle), jnp.cos(angle)]))
    return jnp.concatenate([velocity * _SCALE, clock]).astype(jnp.float32)


def infer(params: Params, inputs: jax.Array, *, precision: str = "highest") -> jax.Array:
    """Computes unclipped actions (..., 12) from inputs of the network (..., 200)."""
    return layers(params["body"], inputs, precision)


def _slowed(command: Command, factor: float) -> Command:
    """Returns a command of velocity with smaller ranges; turns keep theirs."""
    if command.name == "yaw_rate" or command.trained is None:
        return command
    low, high = command.trained
    return command._replace(
        gain=factor * command.gain,
        limit=factor * command.limit,
        trained=(factor * low, factor * high),
    )


@register
class AgileSkill(Skill):
    """The agile skill."""

    name = "agile"
    networks = NETWORKS
    commands = COMMANDS
    period = STEP
    turn = 3.0

    def __init__(self, robot: Robot) -> None:
        super().__init__(robot)
        slow = min(robot.proportions.height, 1.0) ** 0.5  # smaller robots walk slower
        if slow < 1.0:
            self.commands = tuple(_slowed(command, slow) for command in COMMANDS)

    def init_memory(self) -> AgileMemory:
        return AgileMemory(jnp.zeros((LENGTH, FRAME_SIZE)), jnp.zeros(NUM_JOINTS), jnp.zeros(()))

    def targets(
        self,
        params: Params,
        memory: AgileMemory,
        command: jax.Array,
        proprioception: Proprioception,
    ) -> tuple[jax.Array, AgileMemory]:
        newest = frame(self.robot, proprioception, memory.action)
        frames = jnp.concatenate([memory.frames[1:], newest[None]])
        chosen = frames[LENGTH - 1 - np.array(OFFSETS)]
        inputs = jnp.concatenate([chosen.ravel(), now(memory.gait, command)])
        action = jnp.clip(infer(params, inputs, precision=PRECISION), -ACTION_CLIP, ACTION_CLIP)
        gait = advance_gait(memory.gait, command, tempo(self.robot))
        return self.robot.joint_targets(action), AgileMemory(frames, action, gait)

    def load_params(self, path: str | os.PathLike[str] | None = None) -> Params:
        return self.networks.load(self.robot, path)

    def clock(self, memory: AgileMemory) -> jax.Array:
        """Returns sine and cosine of the phase of the gait cycle (2,)."""
        angle = 2 * jnp.pi * memory.gait
        return jnp.stack([jnp.sin(angle), jnp.cos(angle)])


@register
class ClimbSkill(AgileSkill):
    """The agile skill, trained on slopes of up to 17 degrees in place of 9."""

    name = "climb"
    networks = dataclasses.replace(NETWORKS, skill="climb", title="climb skill")
