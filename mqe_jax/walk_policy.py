"""The walk policy: velocity and gait commands to joint targets, for one robot (walk-these-ways, arXiv 2212.03238).

A recurrence-free network sees the last 30 observations of 70 numbers:

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
the joint target is default + `ACTION_SCALE` * action. ELU between layers. Matrix products are in float32.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import pathlib
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.robots.go1 import ACTION_SCALE, DEFAULT_JOINTS, NUM_JOINTS

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
    """One of the walk policy's commands: name, scale in the observation, default value, unit."""

    name: str
    scale: float
    default: float
    unit: str


COMMANDS = (
    Command("vx", 2.0, 0.0, "m/s forward"),
    Command("vy", 2.0, 0.0, "m/s to the left"),
    Command("yaw_rate", 0.25, 0.0, "rad/s"),
    Command("body_height", 2.0, 0.0, "m above the usual height"),
    Command("gait_frequency", 1.0, 3.0, "Hz"),
    Command("phase", 1.0, 0.5, "of FL and RR"),
    Command("offset", 1.0, 0.0, "of FL and FR"),
    Command("bound", 1.0, 0.0, "of FL and RL"),
    Command("duration", 1.0, 0.5, "share of the cycle on the ground"),
    Command("footswing_height", 0.15, 0.08, "m"),
    Command("pitch", 0.3, 0.0, "rad"),
    Command("roll", 0.3, 0.0, "rad"),
    Command("stance_width", 1.0, 0.25, "m"),
    Command("stance_length", 1.0, 0.428, "m"),
    Command("auxiliary", 1.0, 0.0, "unused"),
)
COMMAND_NAMES = tuple(command.name for command in COMMANDS)
COMMAND_SCALE = np.array([command.scale for command in COMMANDS], np.float32)
COMMAND_DEFAULT = np.array([command.default for command in COMMANDS], np.float32)

# (phase, offset, bound) of the named gaits.
GAITS = {"trot": (0.5, 0.0, 0.0), "pronk": (0.0, 0.0, 0.0), "bound": (0.0, 0.5, 0.0), "pace": (0.0, 0.0, 0.5)}


def command_index(name: str) -> int:
    """Returns the position of a command in the 15-vector."""
    if name not in COMMAND_NAMES:
        raise ValueError(f"walk command: unknown name {name!r}; allowed: {', '.join(COMMAND_NAMES)}")
    return COMMAND_NAMES.index(name)


def default_commands(gait: str = "trot", **values: float) -> np.ndarray:
    """Returns the 15 commands (15,) at their defaults, with a gait and single values replaced."""
    if gait not in GAITS:
        raise ValueError(f"gait: unknown name {gait!r}; allowed: {', '.join(GAITS)}")
    commands = COMMAND_DEFAULT.copy()
    commands[5:8] = GAITS[gait]
    for name, value in values.items():
        commands[command_index(name)] = value
    return commands


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class WalkMemory:
    """What the walk policy of one robot remembers.

    Attributes:
        history: last observations, oldest first (30, 70); zeros after a reset.
        action: last action (12,).
        previous_action: the action before it (12,).
        gait: position in the gait cycle () in [0, 1).
    """

    history: jax.Array
    action: jax.Array
    previous_action: jax.Array
    gait: jax.Array


def initial_memory() -> WalkMemory:
    """Returns the memory of one robot after a reset."""
    zeros = jnp.zeros(NUM_JOINTS)
    return WalkMemory(jnp.zeros((HISTORY, OBSERVATION_SIZE)), zeros, zeros, jnp.zeros(()))


def foot_phases(gait: jax.Array, commands: jax.Array) -> jax.Array:
    """Returns each foot's phase (4,) in [0, 1), FL FR RL RR: below 0.5 it should stand, above it should swing."""
    phase, offset, bound, duration = commands[5], commands[6], commands[7], commands[8]
    shift = jnp.stack([phase + offset + bound, offset, bound, phase])
    raw = jnp.mod(gait + shift, 1.0)
    return jnp.where(raw < duration, 0.5 * raw / duration, 0.5 + 0.5 * (raw - duration) / (1.0 - duration))


def advance_gait(gait: jax.Array, commands: jax.Array) -> jax.Array:
    """Moves the gait cycle on by one policy step."""
    return jnp.mod(gait + STEP * commands[4], 1.0)


def observe(
    memory: WalkMemory,
    commands: jax.Array,
    gravity_b: jax.Array,
    joint_position: jax.Array,
    joint_velocity: jax.Array,
) -> jax.Array:
    """Builds one observation (70,).

    Args:
        memory: of the robot.
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
            joint_position - DEFAULT_JOINTS,
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
    params: Params,
    memory: WalkMemory,
    commands: jax.Array,
    gravity_b: jax.Array,
    joint_position: jax.Array,
    joint_velocity: jax.Array,
) -> tuple[jax.Array, WalkMemory]:
    """Computes one robot's joint targets (12,), rad, and its next memory; arguments as in `observe`."""
    observation = observe(memory, commands, gravity_b, joint_position, joint_velocity)
    history = jnp.concatenate([memory.history[1:], observation[None]])
    flat = history.reshape(-1)
    action = jnp.clip(infer_action(params, flat, infer_latent(params, flat)), -ACTION_CLIP, ACTION_CLIP)
    return joint_targets(action), WalkMemory(history, action, memory.action, advance_gait(memory.gait, commands))


def joint_targets(action: jax.Array) -> jax.Array:
    """Turns actions (..., 12) into joint targets (..., 12), rad."""
    return jnp.asarray(DEFAULT_JOINTS) + ACTION_SCALE * action


def init_params(key: jax.Array) -> Params:
    """Draws fresh weights: He-uniform as torch's linear layers have it, a small last layer for the body."""
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


def _nested(flat: Mapping[str, np.ndarray], source: str) -> Params:
    """Checks names and shapes of flat weights and nests them."""
    params: Params = {"adaptation": {}, "body": {}}
    for name, shape in _expected_shapes().items():
        if name not in flat:
            raise ValueError(f"walk policy {source}: {name} is missing; expected {', '.join(_expected_shapes())}")
        if tuple(flat[name].shape) != shape:
            raise ValueError(f"walk policy {source}: {name} has shape {tuple(flat[name].shape)}; expected {shape}")
        part, layer, kind = name.split(".")
        params[part].setdefault(layer, {})[kind] = jnp.asarray(flat[name], jnp.float32)
    return params


DEFAULT_WEIGHTS = pathlib.Path(__file__).parent / "assets" / "walk.safetensors"


def load_params(path: str | os.PathLike[str] | None = None) -> Params:
    """Reads weights from a safetensors file; the ones that ship with the package if `path` is None.

    Raises:
        ValueError: if the file is missing, damaged, or holds other names or shapes.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    file = pathlib.Path(path) if path is not None else DEFAULT_WEIGHTS
    if not file.is_file():
        raise ValueError(f"walk policy: no file {file}; make one with 'mqe walk train' or 'mqe walk convert'")
    try:
        flat = load_file(file)
    except SafetensorError as error:
        raise ValueError(f"walk policy {file}: not a safetensors file ({error})") from None
    return _nested(flat, str(file))


def save_params(params: Params, path: str | os.PathLike[str], metadata: Mapping[str, Any] | None = None) -> None:
    """Writes weights and a description to a safetensors file, whole or not at all."""
    from safetensors.numpy import save

    flat = {
        f"{part}.{layer}.{kind}": np.ascontiguousarray(array, np.float32)
        for part, layers in params.items()
        for layer, arrays in layers.items()
        for kind, array in arrays.items()
    }
    file = pathlib.Path(path)
    temporary = file.with_name(file.name + ".tmp")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(save(flat, {"about": json.dumps(dict(metadata or {}))}))
        os.replace(temporary, file)
    except OSError as error:
        raise ValueError(f"walk policy: cannot write {file}: {error.strerror}") from None
