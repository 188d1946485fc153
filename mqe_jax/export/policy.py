"""A team's policy as one ONNX graph: the high-level policy and, in `command` control, the walk policy.

Every input and output has a leading batch axis N. Recurrent states are initialised to zero, and each output `next_X` is
the input `X` of the next step. Agents of a mirrored team observe in their own frame, as in the task; `action` is in
that frame, commands and joint targets are in the robots' frame.

| control | outputs besides `action` (N, A, D) and the recurrent states |
|---|---|
| `command` | `commands` (N, A, 15), `joint_target` (N, A, 12), rad |
| `position` | `joint_target` (N, A, 12), rad |
| `torque` | `torque` (N, A, 12), N m |
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import onnx

import mqe_jax
from mqe_jax import walk_policy
from mqe_jax.errors import InputError
from mqe_jax.export.actor import add_actor
from mqe_jax.export.graph import OPSET, Graph
from mqe_jax.export.walk import add_commands, add_joint_targets, add_walk
from mqe_jax.files import write_atomically
from mqe_jax.robots.robot import NUM_JOINTS
from mqe_jax.train.policy import Policy


def to_onnx(policy: Policy, env: Any) -> onnx.ModelProto:
    """Returns the graph of a policy on its task.

    Args:
        policy: with the network `actor_critic`.
        env: the policy's task, which defines control mode, robot and walk policy.

    Raises:
        InputError: for another network, or a task whose sizes differ from the policy's.
    """
    sizes = (env.num_agents, env.observation_size, env.action_size)
    trained = (policy.dims.agents, policy.dims.observation, policy.dims.action)
    if sizes != trained:
        raise InputError(f"policy: trained for (agents, observation, action) {trained}, but {env.name} has {sizes}")
    graph = Graph(env.name.replace("-", "_"))
    agents, robot = env.num_agents, env.robot
    action = add_actor(graph, policy)
    graph.output("action", action, (agents, env.action_size))
    own = _unmirrored(graph, action, env)
    if env.control == "command":
        commands = add_commands(graph, own, tuple(env.params.commands), env.controller.default_commands)
        graph.output("commands", commands, (agents, len(walk_policy.COMMANDS)))
        target = add_walk(graph, robot, env.controller.walk_params, commands, agents)
        graph.output("joint_target", target, (agents, NUM_JOINTS))
    elif env.control == "position":
        target = add_joint_targets(graph, robot, own, env.params.position_scale)
        graph.output("joint_target", target, (agents, NUM_JOINTS))
    else:
        limit = graph.constant(robot.torque_limit)
        graph.output("torque", graph.op("Mul", own, limit), (agents, NUM_JOINTS))
    return graph.model(_properties(policy, env))


def save_onnx(model: onnx.ModelProto, path: Path) -> None:
    """Writes a model atomically; InputError if the file cannot be written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, model.SerializeToString())
    except OSError as error:
        raise InputError(f"onnx: cannot write {path} ({error.strerror})") from None


def shapes(model: onnx.ModelProto) -> dict[str, dict[str, list[Any]]]:
    """Returns the shapes of a model's inputs and outputs by name; the batch axis is 'N'."""

    def of(values: Any) -> dict[str, list[Any]]:
        return {v.name: [d.dim_param or d.dim_value for d in v.type.tensor_type.shape.dim] for v in values}

    return {"inputs": of(model.graph.input), "outputs": of(model.graph.output)}


def _unmirrored(graph: Graph, action: str, env: Any) -> str:
    """Applies the task's linear map from the agents' frames to the robots' (N, A, D)."""
    size = env.action_size
    basis = [env.unmirror_action(jnp.tile(row, (env.num_agents, 1))) for row in jnp.eye(size)]
    matrices = np.stack([np.asarray(rows) for rows in basis], axis=1)  # (A, D, D), rows by basis vector
    if np.array_equal(matrices, np.tile(np.eye(size), (env.num_agents, 1, 1))):
        return action
    return graph.affine(action, matrices, np.zeros(size, np.float32))


def _properties(policy: Policy, env: Any) -> dict[str, str]:
    """Returns the metadata of the model as strings, JSON-encoded where structured."""
    layout = [[block.name, block.width, block.meaning] for block in env.observation_layout.blocks]
    return {
        "mqe_jax": mqe_jax.__version__,
        "opset": str(OPSET),
        "task": env.name,
        "control": env.control,
        "robot": env.robot.name,
        "period_s": f"{env.dt:g}",
        "observation": json.dumps(layout),
        "joints": json.dumps("FL FR RL RR; hip, thigh, calf"),
        "default_joints_rad": json.dumps([round(float(x), 6) for x in env.robot.default_joints]),
        "env_steps": str(policy.metadata.get("env_steps", "")),
    }
