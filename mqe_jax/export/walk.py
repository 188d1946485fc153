"""The walk policy as ONNX nodes, for A robots of N environments at once."""

from __future__ import annotations

from typing import Any

import numpy as np

from mqe_jax import walk_policy
from mqe_jax.control import COMMAND_RANGES
from mqe_jax.export.graph import Graph
from mqe_jax.robots.robot import NUM_JOINTS, Robot

_COMMANDS = len(walk_policy.COMMANDS)
# Rows: feet FL FR RL RR; columns: whether phase, offset, bound are added to the gait phase.
_SHIFTS = np.array([[1, 1, 1], [0, 1, 0], [0, 0, 1], [1, 0, 0]], np.float32)


def add_commands(graph: Graph, action: str, names: tuple[str, ...], default: np.ndarray) -> str:
    """Returns the walk commands (N, A, 15) of actions (N, A, D): those of `control.commands_from_action`."""
    scale = np.array([COMMAND_RANGES[name][0] for name in names], np.float32)
    limit = np.array([COMMAND_RANGES[name][1] for name in names], np.float32)
    place = np.zeros((len(names), _COMMANDS), np.float32)
    place[np.arange(len(names)), [walk_policy.command_index(name) for name in names]] = 1.0
    change = graph.clip(graph.op("Mul", action, graph.constant(scale)), -limit, limit)
    return graph.op("Add", graph.op("MatMul", change, graph.constant(place)), graph.constant(default))


def add_walk(graph: Graph, robot: Robot, params: walk_policy.Params, commands: str, agents: int) -> str:
    """Adds the walk policy's inputs, outputs and recurrent state; returns the joint targets (N, A, 12), rad.

    Inputs (N, A, ...): `gravity` 3, `joint_position` 12, `joint_velocity` 12, and the recurrent state: `walk_history`
    (30, 70), `walk_action` 12, `walk_previous_action` 12, `walk_gait` 1. Outputs: its next values, `next_walk_...`.
    """
    history_shape = (agents, walk_policy.HISTORY, walk_policy.OBSERVATION_SIZE)
    gravity = graph.input("gravity", (agents, 3))
    position = graph.input("joint_position", (agents, NUM_JOINTS))
    velocity = graph.input("joint_velocity", (agents, NUM_JOINTS))
    history = graph.input("walk_history", history_shape)
    last = graph.input("walk_action", (agents, NUM_JOINTS))
    before = graph.input("walk_previous_action", (agents, NUM_JOINTS))
    gait = graph.input("walk_gait", (agents, 1))
    observation = graph.concat(
        gravity,
        graph.op("Mul", commands, graph.constant(walk_policy.COMMAND_SCALE)),
        graph.op("Sub", position, graph.constant(robot.default_joints)),
        graph.op("Mul", velocity, graph.constant(walk_policy.JOINT_VELOCITY_SCALE)),
        last,
        before,
        _clock(graph, gait, commands),
    )
    kept = graph.slice(history, 1, walk_policy.HISTORY, axis=2)
    history = graph.concat(kept, graph.reshape(observation, (agents, 1, walk_policy.OBSERVATION_SIZE)), axis=2)
    flat = graph.reshape(history, (agents, walk_policy.HISTORY * walk_policy.OBSERVATION_SIZE))
    latent = _mlp(graph, params["adaptation"], flat)
    action = _mlp(graph, params["body"], graph.concat(flat, latent))
    action = graph.clip(action, -walk_policy.ACTION_CLIP, walk_policy.ACTION_CLIP)
    frequency = _command(graph, commands, "gait_frequency")
    moved = graph.op("Add", gait, graph.op("Mul", frequency, graph.constant(walk_policy.STEP)))
    graph.output("next_walk_history", history, history_shape)
    graph.output("next_walk_action", action, (agents, NUM_JOINTS))
    graph.output("next_walk_previous_action", last, (agents, NUM_JOINTS))
    graph.output("next_walk_gait", _fraction(graph, moved), (agents, 1))
    return add_joint_targets(graph, robot, action)


def add_joint_targets(graph: Graph, robot: Robot, action: str, scale: float = 1.0) -> str:
    """Returns joint targets (N, A, 12), rad: default + `scale` x the robot's scale x action."""
    scaled = graph.op("Mul", action, graph.constant(scale * robot.action_scale))
    return graph.op("Add", scaled, graph.constant(robot.default_joints))


def _command(graph: Graph, commands: str, name: str) -> str:
    index = walk_policy.command_index(name)
    return graph.slice(commands, index, index + 1, axis=2)


def _fraction(graph: Graph, x: str) -> str:
    """x modulo 1, in [0, 1) for negative values too."""
    return graph.op("Sub", x, graph.op("Floor", x))


def _clock(graph: Graph, gait: str, commands: str) -> str:
    """The sines of the feet's phases (N, A, 4): stance takes the first half of a cycle, swing the second."""
    first = walk_policy.command_index("phase")
    shift = graph.op("MatMul", graph.slice(commands, first, first + 3, axis=2), graph.constant(_SHIFTS.T))
    raw = _fraction(graph, graph.op("Add", gait, shift))
    duration = _command(graph, commands, "duration")
    one, half = graph.constant(1.0), graph.constant(0.5)
    stance = graph.op("Div", graph.op("Mul", half, raw), duration)
    late = graph.op("Mul", half, graph.op("Sub", raw, duration))
    swing = graph.op("Add", half, graph.op("Div", late, graph.op("Sub", one, duration)))
    phase = graph.op("Where", graph.op("Less", raw, duration), stance, swing)
    return graph.op("Sin", graph.op("Mul", phase, graph.constant(2 * np.pi)))


def _mlp(graph: Graph, layers: Any, x: str) -> str:
    names = sorted(layers, key=int)
    for name in names:
        x = graph.affine(x, np.asarray(layers[name]["weight"]).T, np.asarray(layers[name]["bias"]))
        x = x if name == names[-1] else graph.op("Elu", x)
    return x
