"""The walk policy: velocity and gait commands to joint targets, for one robot.

It is that of walk-these-ways (arXiv 2212.03238). A feed-forward network takes as input the last 30
observations of 70 numbers:

| block | size | content |
|---|---|---|
| projected gravity | 3 | unit gravity vector in the trunk frame |
| commands | 15 | `COMMANDS`, each times its scale |
| joint position | 12 | minus the default angles, rad |
| joint velocity | 12 | times 0.05, rad/s |
| last action | 12 | |
| action before it | 12 | |
| clock | 4 | sine of each foot's phase, FL FR RL RR |

Its adaptation part, 2100-256-128-2, gives a latent. Its body, (2100 + 2)-512-256-128-12, gives the
action, clipped to +-10. The joint target is default + scale * action, both the robot's. ELU is
between layers. Matrix products are in float32, but in TF32 in an environment's step on an NVIDIA
GPU.

These 2100 numbers contain every action twice, constant commands 30 times, and in most gaits one
clock four times. `RestrictedWalkPolicy` computes the same actions from about two thirds of them,
with weights changed accordingly.
"""

import dataclasses
import os
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.physics.robots.index import Proprioception
from mqe_jax.physics.robots.quadruped import NUM_JOINTS
from mqe_jax.physics.robots.robot import Robot
from mqe_jax.skills import Command, Skill, register
from mqe_jax.skills.weights import ASSETS, Networks, Params, layers  # noqa: F401

HISTORY = 30
OBSERVATION_SIZE = 70
_COLUMNS = {
    "gravity": np.arange(0, 3),
    "commands": np.arange(3, 18),
    "joint_position": np.arange(18, 30),
    "joint_velocity": np.arange(30, 42),
    "action": np.arange(42, 54),
    "previous_action": np.arange(54, 66),
    "clock": np.arange(66, 70),
}
"""Positions of each block in an observation."""
LATENT_SIZE = 2
ADAPTATION_SIZES = (HISTORY * OBSERVATION_SIZE, 256, 128, LATENT_SIZE)
BODY_SIZES = (HISTORY * OBSERVATION_SIZE + LATENT_SIZE, 512, 256, 128, NUM_JOINTS)
NETWORKS = Networks("walk", "walk policy", {"adaptation": ADAPTATION_SIZES, "body": BODY_SIZES})
init_params = NETWORKS.init
load_params = NETWORKS.load
save_params = NETWORKS.save
STEP = 0.02  # s, one policy step
ACTION_CLIP = 10.0
JOINT_VELOCITY_SCALE = 0.05
PRECISION = "tensorfloat32"  # of matrix products in an environment's step; float32 on a CPU

COMMANDS = (
    Command("vx", "m/s forward", gain=2.0, limit=1.0, scale=2.0, trained=(-1.2, 1.2)),
    Command(
        "vy", "m/s to the left", gain=0.5, limit=0.5, scale=2.0, mirror=-1.0, trained=(-0.7, 0.7)
    ),
    Command("yaw_rate", "rad/s", gain=0.5, limit=0.5, scale=0.25, mirror=-1.0, trained=(-1.2, 1.2)),
    Command("body_height", "m above the robot's standing height", gain=0.12, limit=0.12, scale=2.0),
    Command("gait_frequency", "Hz", 3.0, gain=1.0, limit=1.0),
    Command("phase", "of FL and RR", 0.5),
    Command("offset", "of FL and FR"),
    Command("bound", "of FL and RL"),
    Command("duration", "fraction of the cycle in contact", 0.5),
    Command("footswing_height", "m", 0.08, gain=0.08, limit=0.08, scale=0.15),
    Command("pitch", "rad", gain=0.25, limit=0.25, scale=0.3),
    Command("roll", "rad", gain=0.1, limit=0.1, scale=0.3, mirror=-1.0),
    Command("stance_width", "m", lambda robot: robot.walk.stance_width, gain=0.1, limit=0.1),
    Command("stance_length", "m", lambda robot: robot.walk.stance_length, gain=0.06, limit=0.06),
    Command("auxiliary", "unused"),
)
COMMAND_SCALE = np.array([command.scale for command in COMMANDS], np.float32)

GAITS = {
    "trot": {"phase": 0.5, "offset": 0.0, "bound": 0.0},
    "pronk": {"phase": 0.0, "offset": 0.0, "bound": 0.0},
    "bound": {"phase": 0.0, "offset": 0.5, "bound": 0.0},
    "pace": {"phase": 0.0, "offset": 0.0, "bound": 0.5},
}


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class WalkMemory:
    """Recurrent state of one robot's walk policy."""

    history: jax.Array
    """Last observations, oldest first (30, 70); zeros after a reset.

    `RestrictedWalkPolicy` holds their rows (H,).
    """
    action: jax.Array
    """Last action (12,)."""
    previous_action: jax.Array
    """The action before it (12,)."""
    gait: jax.Array
    """Phase of the gait cycle () in [0, 1)."""


def _shifts(commands: Any) -> list[Any]:
    """Returns each foot's shift in the gait cycle, FL FR RL RR."""
    phase = commands[5]
    offset = commands[6]
    bound = commands[7]
    return [phase + offset + bound, offset, bound, phase]


def foot_phases(gait: jax.Array, commands: jax.Array) -> jax.Array:
    """Returns each foot's phase (4,) in [0, 1), FL FR RL RR: stance below 0.5, swing above."""
    duration = commands[8]
    raw = jnp.mod(gait + jnp.stack(_shifts(commands)), 1.0)
    stance = 0.5 * raw / duration
    swing = 0.5 + 0.5 * (raw - duration) / (1.0 - duration)
    return jnp.where(raw < duration, stance, swing)


def advance_gait(gait: jax.Array, commands: jax.Array) -> jax.Array:
    """Advances the gait phase by one policy step."""
    return jnp.mod(gait + STEP * commands[4], 1.0)


def observe(
    robot: Robot, memory: WalkMemory, commands: jax.Array, sensed: Proprioception
) -> jax.Array:
    """Builds one observation (70,), of unscaled commands (15,)."""
    clock = jnp.sin(2 * jnp.pi * foot_phases(memory.gait, commands))
    return jnp.concatenate(
        [
            sensed.gravity_b,
            commands * COMMAND_SCALE,
            sensed.joint_position - robot.default_joints,
            sensed.joint_velocity * JOINT_VELOCITY_SCALE,
            memory.action,
            memory.previous_action,
            clock,
        ]
    ).astype(jnp.float32)


def infer(
    params: Params, history: jax.Array, *, precision: str = "highest"
) -> tuple[jax.Array, jax.Array]:
    """Computes unclipped actions (..., 12) and latents (..., 2) from flattened histories (..., n).

    One product of the history computes both first layers. Two columns of weights then add the
    latent to the body's: no input of another length than the history is written. The action has no
    gradient through the latent.
    """
    adaptation = params["adaptation"]["0"]
    body = params["body"]["0"]
    inner, columns = jnp.split(body["weight"], [history.shape[-1]], axis=1)
    both = jnp.matmul(
        history, jnp.concatenate([adaptation["weight"], inner]).T, precision=precision
    )
    estimated, first = jnp.split(both, [len(adaptation["bias"])], axis=-1)
    latent = layers(params["adaptation"], estimated + adaptation["bias"], precision, first=1)
    first += body["bias"]
    for i in range(LATENT_SIZE):
        first += jax.lax.stop_gradient(latent[..., i, None]) * columns[:, i]
    return layers(params["body"], first, precision, first=1), latent


@register
class WalkPolicy(Skill):
    """The walk policy as a skill.

    Example:
        ```python
        env = mqe_jax.make("go1plane", gait="pace", commands=("vx", "body_height"))
        print(env.action_size)  # 2
        ```
    """

    name = "walk"
    commands = COMMANDS
    gaits = GAITS
    period = STEP

    def init_memory(self) -> WalkMemory:
        zeros = jnp.zeros(NUM_JOINTS)
        return WalkMemory(jnp.zeros((HISTORY, OBSERVATION_SIZE)), zeros, zeros, jnp.zeros(()))

    def targets(
        self, params: Params, memory: WalkMemory, command: jax.Array, proprioception: Proprioception
    ) -> tuple[jax.Array, WalkMemory]:
        observation = observe(self.robot, memory, command, proprioception)
        history = self._append(memory.history, observation)
        action = infer(params, history.reshape(-1), precision=PRECISION)[0]
        action = jnp.clip(action, -ACTION_CLIP, ACTION_CLIP)
        gait = advance_gait(memory.gait, command)
        return self.robot.joint_targets(action), WalkMemory(history, action, memory.action, gait)

    def _append(self, history: jax.Array, observation: jax.Array) -> jax.Array:
        """Returns the history with the newest observation and without the oldest."""
        return jnp.concatenate([history[1:], observation[None]])

    def restrict(self, varied: Sequence[str], gait: str | None) -> "WalkPolicy":
        return RestrictedWalkPolicy(self.robot, varied, gait)

    def load_params(self, path: str | os.PathLike[str] | None = None) -> Params:
        return load_params(self.robot, path)

    def clock(self, memory: WalkMemory) -> jax.Array:
        """Returns sine and cosine of the phase of the gait cycle (2,)."""
        angle = 2 * jnp.pi * memory.gait
        return jnp.stack([jnp.sin(angle), jnp.cos(angle)])


class RestrictedWalkPolicy(WalkPolicy):
    """The walk policy if only some commands vary: the same actions from a shorter history.

    The history is the end of a stream of rows, one per observation. A row has a one and the
    observation, without constant commands and without the action before the last one, which the
    previous row has. If all feet are in step or half a cycle apart, a row has only the first foot's
    clock, which the others equal except for the sign.
    """

    def __init__(self, robot: Robot, varied: Sequence[str], gait: str | None) -> None:
        """Creates the skill; commands that are not in `varied` always have the gait's defaults."""
        super().__init__(robot)
        changing = np.unique(self.index(varied))
        default = self.default_commands(gait)
        shifts = np.array(_shifts(default))
        halves = 2 * (shifts - shifts[0])  # half cycles after the first foot
        steady = default[8] == 0.5 and not {5, 6, 7, 8} & {*changing.tolist()}
        alike = steady and not (halves % 1).any()
        clock = _COLUMNS["clock"]
        if alike:
            clock = clock[:1]
        sensed = [_COLUMNS[name] for name in ("gravity", "joint_position", "joint_velocity")]
        self._kept = np.concatenate(
            [_COLUMNS["commands"][changing], *sensed, clock, _COLUMNS["action"]]
        )
        self._width = 1 + len(self._kept)
        constant = COMMAND_SCALE * default
        constant[changing] = 0.0
        self._observation = np.zeros((OBSERVATION_SIZE, self._width), np.float32)  # times a row
        self._observation[_COLUMNS["commands"], 0] = constant
        self._observation[self._kept, 1:] = np.eye(len(self._kept))
        if alike:
            self._observation[_COLUMNS["clock"], -NUM_JOINTS - 1] = (-1) ** halves
        least = HISTORY * self._width + NUM_JOINTS  # the rows, and the last action before them
        self._size = least + -least % 16  # 64 bytes: products of aligned rows are faster

    def init_memory(self) -> WalkMemory:
        return dataclasses.replace(super().init_memory(), history=jnp.zeros(self._size))

    def _append(self, history: jax.Array, observation: jax.Array) -> jax.Array:
        extended = jnp.concatenate([history, jnp.ones(1), observation[self._kept]])[self._width :]
        # Written once instead of once for each of its readers; on a CPU that is slower.
        return jax.lax.platform_dependent(
            extended, cpu=lambda x: x, default=jax.lax.optimization_barrier
        )

    def load_params(self, path: str | os.PathLike[str] | None = None) -> Params:
        return self.fold_history(super().load_params(path))

    def fold_history(self, params: Params) -> Params:
        """Returns weights that compute the actions of `params` from histories of rows.

        In the first layers, the weights of both occurrences of an action are added. Those of
        constant commands, times their values, become the weight of the row's one. Those of equal
        clocks become one.
        """
        params = {part: dict(chain) for part, chain in params.items()}
        for chain in params.values():
            weight = np.asarray(chain["0"]["weight"])
            window, rest = np.split(weight, [HISTORY * OBSERVATION_SIZE], axis=1)
            window = window.reshape(-1, HISTORY, OBSERVATION_SIZE)
            rows = np.zeros((len(weight), HISTORY + 1, self._width), np.float32)
            rows[:, 1:] = window @ self._observation
            rows[:, :-1, -NUM_JOINTS:] += window[..., _COLUMNS["previous_action"]]
            history = rows.reshape(len(weight), -1)[:, -self._size :]
            folded = jax.device_put(np.concatenate([history, rest], axis=1))
            chain["0"] = {**chain["0"], "weight": folded}
        return params
