"""The walk policy: velocity and gait commands to joint targets, for one robot (walk-these-ways, arXiv 2212.03238).

A feed-forward network takes as input the last 30 observations of 70 numbers:

| block | size | content |
|---|---|---|
| projected gravity | 3 | unit gravity vector in the trunk frame |
| commands | 15 | `COMMANDS`, each times its scale |
| joint position | 12 | minus the default angles, rad |
| joint velocity | 12 | times 0.05, rad/s |
| last action | 12 | |
| action before it | 12 | |
| clock | 4 | sine of each foot's phase, FL FR RL RR |

adaptation 2100-256-128-2 gives a latent; body (2100 + 2)-512-256-128-12 gives the action, clipped to +-10;
the joint target is default + scale * action, both the robot's. ELU between layers. Matrix products are in float32.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import os
import pathlib
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.errors import InputError, nearest
from mqe_jax.files import write_atomically
from mqe_jax.robots.robot import NUM_JOINTS, Robot

HISTORY = 30
OBSERVATION_SIZE = 70
LATENT_SIZE = 2
ADAPTATION_SIZES = (HISTORY * OBSERVATION_SIZE, 256, 128, LATENT_SIZE)
BODY_SIZES = (HISTORY * OBSERVATION_SIZE + LATENT_SIZE, 512, 256, 128, NUM_JOINTS)
STEP = 0.02  # s, one policy step
ACTION_CLIP = 10.0
JOINT_VELOCITY_SCALE = 0.05

Params = dict[str, dict[str, dict[str, jax.Array]]]


class Command(NamedTuple):
    """One of the walk policy's commands: name, scale in the observation, default value (None: the robot's), unit."""

    name: str
    scale: float
    default: float | None
    unit: str


COMMANDS = (
    Command("vx", 2.0, 0.0, "m/s forward"),
    Command("vy", 2.0, 0.0, "m/s to the left"),
    Command("yaw_rate", 0.25, 0.0, "rad/s"),
    Command("body_height", 2.0, 0.0, "m above the robot's standing height"),
    Command("gait_frequency", 1.0, 3.0, "Hz"),
    Command("phase", 1.0, 0.5, "of FL and RR"),
    Command("offset", 1.0, 0.0, "of FL and FR"),
    Command("bound", 1.0, 0.0, "of FL and RL"),
    Command("duration", 1.0, 0.5, "fraction of the cycle in contact"),
    Command("footswing_height", 0.15, 0.08, "m"),
    Command("pitch", 0.3, 0.0, "rad"),
    Command("roll", 0.3, 0.0, "rad"),
    Command("stance_width", 1.0, None, "m"),
    Command("stance_length", 1.0, None, "m"),
    Command("auxiliary", 1.0, 0.0, "unused"),
)
COMMAND_NAMES = tuple(command.name for command in COMMANDS)
COMMAND_SCALE = np.array([command.scale for command in COMMANDS], np.float32)

# (phase, offset, bound) of the named gaits.
GAITS = {"trot": (0.5, 0.0, 0.0), "pronk": (0.0, 0.0, 0.0), "bound": (0.0, 0.5, 0.0), "pace": (0.0, 0.0, 0.5)}


def check_period(timestep: float, num_substeps: int) -> None:
    """Checks that `num_substeps` physics steps of `timestep` (s) are one policy step; raises an InputError."""
    period = timestep * num_substeps
    if not math.isclose(period, STEP):
        raise InputError(
            f"Scene.timestep: {timestep} s x {num_substeps} substeps is {period:g} s; "
            f"the walk policy's period is {STEP} s"
        )


def command_index(name: str) -> int:
    """Returns the position of a command in the 15-vector."""
    if name not in COMMAND_NAMES:
        raise InputError(
            f"walk command: unknown name {name!r}{nearest(name, COMMAND_NAMES)}; allowed: {', '.join(COMMAND_NAMES)}"
        )
    return COMMAND_NAMES.index(name)


def default_commands(robot: Robot, gait: str = "trot", **values: float) -> np.ndarray:
    """Returns the default commands of a robot (15,), with a gait and single values replaced."""
    if gait not in GAITS:
        raise InputError(f"gait: unknown name {gait!r}{nearest(gait, GAITS)}; allowed: {', '.join(GAITS)}")
    own = {"stance_width": robot.walk.stance_width, "stance_length": robot.walk.stance_length}
    commands = np.array([own.get(name, default) for name, _, default, _ in COMMANDS], np.float32)
    commands[5:8] = GAITS[gait]
    for name, value in values.items():
        commands[command_index(name)] = value
    return commands


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class WalkMemory:
    """Recurrent state of one robot's walk policy."""

    history: jax.Array
    """Last observations, oldest first (30, 70); zeros after a reset."""
    action: jax.Array
    """Last action (12,)."""
    previous_action: jax.Array
    """The action before it (12,)."""
    gait: jax.Array
    """Phase of the gait cycle () in [0, 1)."""


def initial_memory() -> WalkMemory:
    """Returns the recurrent state of one robot after a reset."""
    zeros = jnp.zeros(NUM_JOINTS)
    return WalkMemory(jnp.zeros((HISTORY, OBSERVATION_SIZE)), zeros, zeros, jnp.zeros(()))


def foot_phases(gait: jax.Array, commands: jax.Array) -> jax.Array:
    """Returns each foot's phase (4,) in [0, 1), FL FR RL RR: stance below 0.5, swing above."""
    phase, offset, bound, duration = commands[5], commands[6], commands[7], commands[8]
    shift = jnp.stack([phase + offset + bound, offset, bound, phase])
    raw = jnp.mod(gait + shift, 1.0)
    return jnp.where(raw < duration, 0.5 * raw / duration, 0.5 + 0.5 * (raw - duration) / (1.0 - duration))


def advance_gait(gait: jax.Array, commands: jax.Array) -> jax.Array:
    """Advances the gait phase by one policy step."""
    return jnp.mod(gait + STEP * commands[4], 1.0)


def observe(
    robot: Robot,
    memory: WalkMemory,
    commands: jax.Array,
    gravity_b: jax.Array,
    joint_position: jax.Array,
    joint_velocity: jax.Array,
) -> jax.Array:
    """Builds one observation (70,).

    Args:
        robot: robot type.
        memory: recurrent state of its walk policy.
        commands: unscaled (15,).
        gravity_b: unit gravity vector in the trunk frame (3,).
        joint_position: (12,), rad.
        joint_velocity: (12,), rad/s.
    """
    clock = jnp.sin(2 * jnp.pi * foot_phases(memory.gait, commands))
    return jnp.concatenate(
        [
            gravity_b,
            commands * COMMAND_SCALE,
            joint_position - robot.default_joints,
            joint_velocity * JOINT_VELOCITY_SCALE,
            memory.action,
            memory.previous_action,
            clock,
        ]
    ).astype(jnp.float32)


def _mlp(layers: Mapping[str, Mapping[str, jax.Array]], x: jax.Array) -> jax.Array:
    """Applies a Sequential of linear layers (named 0, 2, 4, ...; weight (out, in)) with ELU between them."""
    names = sorted(layers, key=int)
    for name in names:
        x = jnp.matmul(x, layers[name]["weight"].T, precision="highest") + layers[name]["bias"]
        x = x if name == names[-1] else jax.nn.elu(x)
    return x


def infer_latent(params: Params, history: jax.Array) -> jax.Array:
    """Estimates the latent (..., 2) from flattened histories (..., 2100)."""
    return _mlp(params["adaptation"], history)


def infer_action(params: Params, history: jax.Array, latent: jax.Array) -> jax.Array:
    """Computes unclipped actions (..., 12) from flattened histories (..., 2100) and latents (..., 2)."""
    return _mlp(params["body"], jnp.concatenate([history, latent], axis=-1))


def walk(
    robot: Robot,
    params: Params,
    memory: WalkMemory,
    commands: jax.Array,
    gravity_b: jax.Array,
    joint_position: jax.Array,
    joint_velocity: jax.Array,
) -> tuple[jax.Array, WalkMemory]:
    """Computes one robot's joint targets (12,), rad, and the next recurrent state; arguments as in `observe`."""
    observation = observe(robot, memory, commands, gravity_b, joint_position, joint_velocity)
    history = jnp.concatenate([memory.history[1:], observation[None]])
    flat = history.reshape(-1)
    action = jnp.clip(infer_action(params, flat, infer_latent(params, flat)), -ACTION_CLIP, ACTION_CLIP)
    gait = advance_gait(memory.gait, commands)
    return joint_targets(robot, action), WalkMemory(history, action, memory.action, gait)


def joint_targets(robot: Robot, action: jax.Array, scale: float = 1.0) -> jax.Array:
    """Computes joint targets (..., 12), rad, from actions (..., 12): default + `scale` x the robot's scale x action."""
    return jnp.asarray(robot.default_joints) + scale * robot.action_scale * action


def init_params(key: jax.Array) -> Params:
    """Samples initial weights: uniform as in torch's linear layers, the body's last layer scaled by 0.1."""
    params: Params = {}
    for part, sizes in (("adaptation", ADAPTATION_SIZES), ("body", BODY_SIZES)):
        layers = {}
        for index, (n_in, n_out) in enumerate(itertools.pairwise(sizes)):
            key, w_key, b_key = jax.random.split(key, 3)
            bound = n_in**-0.5
            last = part == "body" and index == len(sizes) - 2
            weight = jax.random.uniform(w_key, (n_out, n_in), minval=-bound, maxval=bound) * (0.1 if last else 1.0)
            bias = jax.random.uniform(b_key, (n_out,), minval=-bound, maxval=bound) * (0.0 if last else 1.0)
            layers[str(2 * index)] = {"weight": weight, "bias": bias}
        params[part] = layers
    return params


def _expected_shapes() -> dict[str, tuple[int, ...]]:
    shapes: dict[str, tuple[int, ...]] = {}
    for part, sizes in (("adaptation", ADAPTATION_SIZES), ("body", BODY_SIZES)):
        for index, (n_in, n_out) in enumerate(itertools.pairwise(sizes)):
            shapes[f"{part}.{2 * index}.weight"] = (n_out, n_in)
            shapes[f"{part}.{2 * index}.bias"] = (n_out,)
    return shapes


def nested_params(flat: Mapping[str, np.ndarray], source: str) -> Params:
    """Returns flat weights as nested float32 arrays.

    Raises:
        InputError: for missing names or other shapes; the message starts with `source`.
    """
    params: Params = {"adaptation": {}, "body": {}}
    for name, shape in _expected_shapes().items():
        if name not in flat:
            raise InputError(f"walk policy {source}: {name} is missing; expected {', '.join(_expected_shapes())}")
        if tuple(flat[name].shape) != shape:
            raise InputError(f"walk policy {source}: {name} has shape {tuple(flat[name].shape)}; expected {shape}")
        part, layer, kind = name.split(".")
        params[part].setdefault(layer, {})[kind] = jnp.asarray(flat[name], jnp.float32)
    return params


ASSETS = pathlib.Path(__file__).parent / "assets"


def load_params(robot: Robot, path: str | os.PathLike[str] | None = None) -> Params:
    """Reads weights as float32 from a safetensors file; those shipped for the robot if `path` is None.

    Raises:
        InputError: if the file is missing, damaged, or holds other names or shapes.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    file = pathlib.Path(path) if path is not None else ASSETS / robot.walk.weights
    train = f"train it with 'mqe walk train --robot {robot.name}'"
    if not file.is_file() and path is None:
        raise InputError(
            f"walk policy: no weights are shipped for {robot.name} (assets/{file.name}); {train} and give them as "
            "walk_policy=FILE, or use control 'position' or 'torque'"
        )
    if not file.is_file():
        raise InputError(f"walk policy: no file {file}; {train} or convert official weights with 'mqe walk convert'")
    try:
        flat = load_file(file)
    except SafetensorError as error:
        raise InputError(f"walk policy {file}: not a safetensors file ({error})") from None
    return nested_params(flat, str(file))


def save_params(
    params: Params, path: str | os.PathLike[str], metadata: Mapping[str, Any] | None = None, *, half: bool = False
) -> None:
    """Writes weights and metadata to a safetensors file, atomically; with `half`, rounded to float16 (3.6 MB)."""
    from safetensors.numpy import save

    flat = {
        f"{part}.{layer}.{kind}": np.ascontiguousarray(array, np.float16 if half else np.float32)
        for part, layers in params.items()
        for layer, arrays in layers.items()
        for kind, array in arrays.items()
    }
    file = pathlib.Path(path)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(file, save(flat, {"about": json.dumps(dict(metadata or {}))}))
    except OSError as error:
        raise InputError(f"walk policy: cannot write {file}: {error.strerror}") from None
