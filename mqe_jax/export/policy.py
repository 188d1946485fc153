"""A team's policy as one function and its ONNX graph: high-level policy and, in `command` control, skill.

Every input and output has a leading batch axis N. Recurrent states are initialised to zero, and each output `next_X` is
the input `X` of the next step. Agents of a mirrored team observe in their own frame, as in the task; `action` is in
that frame, commands and joint targets are in the robots' frame.

| control | outputs besides `action` (N, A, D) and the recurrent states |
|---|---|
| `command` | `commands` (N, A, C), `joint_target` (N, A, 12), rad |
| `position` | `joint_target` (N, A, 12), rad |
| `torque` | `torque` (N, A, 12), N m |

Further inputs in `command` control: `gravity` (N, A, 3), the unit gravity vector in the trunk frame, `joint_position`
and `joint_velocity` (N, A, 12), rad and rad/s. Recurrent states: of the skill, for the walk policy `walk_history`
(N, A, 30, 70), `walk_action` and `walk_previous_action` (N, A, 12), `walk_gait` (N, A, 1); and those of the network:
`memory` if it is one array.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import onnx

import mqe_jax
from mqe_jax.errors import InputError
from mqe_jax.export.graph import OPSET
from mqe_jax.export.translate import translate
from mqe_jax.files import write_atomically
from mqe_jax.robots.robot import NUM_JOINTS
from mqe_jax.skills import Proprioception, joint_targets
from mqe_jax.train.policy import Policy


def to_onnx(policy: Policy, env: Any) -> onnx.ModelProto:
    """Returns the graph of a policy on its task, which defines control mode, robot and walk policy.

    Raises:
        InputError: for a task whose sizes differ from the policy's, or a network with an operation that has no
            translation.
    """
    sizes = (env.num_agents, env.observation_size, env.action_size)
    trained = (policy.dims.agents, policy.dims.observation, policy.dims.action)
    if sizes != trained:
        raise InputError(f"policy: trained for (agents, observation, action) {trained}, but {env.name} has {sizes}")
    step = functools.partial(policy_step, policy, env)
    return translate(step, input_shapes(policy, env), env.name.replace("-", "_"), _properties(policy, env))


def input_shapes(policy: Policy, env: Any) -> dict[str, tuple[int, ...]]:
    """Returns the shapes of the inputs of `policy_step` by name, without the batch axis."""
    robots = {"obs": (env.observation_size,)}
    if env.control == "command":
        robots |= {"gravity": (3,), "joint_position": (NUM_JOINTS,), "joint_velocity": (NUM_JOINTS,)}
        memory = env.controller.skill.init_memory()
        robots |= {name: x.shape or (1,) for name, x in _skill_memory(env, memory).items()}
    shapes = {name: (env.num_agents, *shape) for name, shape in robots.items()}
    return shapes | {name: x.shape for name, x in _network_memory(policy.initial_memory()).items()}


def policy_step(policy: Policy, env: Any, inputs: Mapping[str, jax.Array]) -> dict[str, jax.Array]:
    """Returns the outputs of one step by name, the function that the graph evaluates."""
    names = _network_memory(policy.initial_memory())
    memory = jax.tree.unflatten(jax.tree.structure(policy.initial_memory()), [inputs[name] for name in names])
    action, memory = policy.act(inputs["obs"], memory, deterministic=True)
    own = jax.vmap(env.unmirror_action)(action)
    outputs = {"action": action} | {f"next_{name}": x for name, x in _network_memory(memory).items()}
    if env.control == "torque":
        return outputs | {"torque": own * env.robot.torque_limit}
    if env.control == "position":
        return outputs | {"joint_target": joint_targets(env.robot, own, env.params.position_scale)}
    return outputs | _skill(env, own, inputs)


def _network_memory(memory: Any) -> dict[str, Any]:
    """Returns the arrays of a network's recurrent state by name."""
    leaves = jax.tree.leaves(memory)
    return {"memory" if len(leaves) == 1 else f"memory_{i}": leaf for i, leaf in enumerate(leaves)}


def _skill_memory(env: Any, memory: Any) -> dict[str, Any]:
    """Returns the arrays of a skill's recurrent state by name."""
    leaves = jax.tree_util.tree_flatten_with_path(memory)[0]
    prefix = env.controller.skill.name
    return {f"{prefix}_{jax.tree_util.keystr(path, simple=True, separator='_')}": leaf for path, leaf in leaves}


def _skill(env: Any, action: jax.Array, inputs: Mapping[str, jax.Array]) -> dict[str, jax.Array]:
    controller = env.controller
    skill, default = controller.skill, controller.default_commands
    commands = jax.vmap(lambda a: skill.commands_from_action(a, env.params.commands, default))(action)
    blank = skill.init_memory()
    # A number per robot has an axis of length 1 in the graph.
    leaves = [inputs[name] if x.shape else inputs[name][..., 0] for name, x in _skill_memory(env, blank).items()]
    memory = jax.tree.unflatten(jax.tree.structure(blank), leaves)
    act = functools.partial(skill.targets, controller.skill_params)
    sensed = Proprioception(inputs["gravity"], inputs["joint_position"], inputs["joint_velocity"])
    target, memory = jax.vmap(jax.vmap(act))(memory, commands, sensed)
    after = {f"next_{name}": x if x.ndim > 2 else x[..., None] for name, x in _skill_memory(env, memory).items()}
    return {"commands": commands, "joint_target": target, **after}


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
