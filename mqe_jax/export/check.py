"""Compares an exported graph in onnxruntime with the exported JAX functions."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import onnx

from mqe_jax import walk_policy
from mqe_jax.control import commands_from_action
from mqe_jax.export.policy import shapes
from mqe_jax.train.policy import Policy


def largest_error(model: onnx.ModelProto, policy: Policy, env: Any, *, num_envs: int = 3, steps: int = 5) -> float:
    """Returns the largest absolute error of any output over several steps with random inputs and recurrent states."""
    import onnxruntime

    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    sizes = shapes(model)["inputs"]
    random = np.random.default_rng(0)
    compute = jax.jit(functools.partial(reference, policy, env))
    jax_memory, onnx_memory = _memory(sizes, num_envs), _memory(sizes, num_envs)
    worst = 0.0
    for _ in range(steps):
        inputs = {
            name: random.normal(size=(num_envs, *shape[1:])).astype(np.float32)
            for name, shape in sizes.items()
            if name not in jax_memory
        }
        names = [output.name for output in session.get_outputs()]
        found = dict(zip(names, session.run(names, {**inputs, **onnx_memory}), strict=True))
        expected = jax.device_get(compute({**inputs, **jax_memory}))
        worst = max(worst, *(float(np.abs(found[name] - expected[name]).max()) for name in names))
        jax_memory = {name: expected[f"next_{name}"] for name in jax_memory}
        onnx_memory = {name: found[f"next_{name}"] for name in onnx_memory}
    return worst


def reference(policy: Policy, env: Any, inputs: Mapping[str, Any]) -> dict[str, jax.Array]:
    """Returns the graph's outputs by name, computed in JAX."""
    memory = jnp.asarray(inputs["memory"]) if "memory" in inputs else ()
    action, memory = policy.act(inputs["obs"], memory, deterministic=True)
    outputs: dict[str, Any] = {"action": action}
    if "memory" in inputs:
        outputs["next_memory"] = memory
    own = jax.vmap(env.unmirror_action)(action)
    if env.control == "torque":
        outputs["torque"] = own * env.robot.torque_limit
    elif env.control == "position":
        outputs["joint_target"] = walk_policy.joint_targets(env.robot, own, env.params.position_scale)
    else:
        outputs |= _walk(env, own, inputs)
    return outputs


def _memory(sizes: Mapping[str, Any], num_envs: int) -> dict[str, np.ndarray]:
    names = [name for name in sizes if name == "memory" or name.startswith("walk_")]
    return {name: np.zeros((num_envs, *sizes[name][1:]), np.float32) for name in names}


def _walk(env: Any, action: jax.Array, inputs: Mapping[str, Any]) -> dict[str, Any]:
    default = env.controller.default_commands
    commands = jax.vmap(lambda a: commands_from_action(a, env.params.commands, default))(action)
    memory = walk_policy.WalkMemory(
        jnp.asarray(inputs["walk_history"]),
        jnp.asarray(inputs["walk_action"]),
        jnp.asarray(inputs["walk_previous_action"]),
        jnp.asarray(inputs["walk_gait"])[..., 0],
    )
    walk = jax.vmap(jax.vmap(functools.partial(walk_policy.walk, env.robot, env.controller.walk_params)))
    sensed = (inputs["gravity"], inputs["joint_position"], inputs["joint_velocity"])
    target, memory = walk(memory, commands, *map(jnp.asarray, sensed))
    return {
        "commands": commands,
        "joint_target": target,
        "next_walk_history": memory.history,
        "next_walk_action": memory.action,
        "next_walk_previous_action": memory.previous_action,
        "next_walk_gait": memory.gait[..., None],
    }
