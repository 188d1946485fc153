"""A team's policy as one function and its ONNX graph, with the skill in `command` control.

Every input and output has a leading batch axis N. The input `obs` (N, A, O) is the policy's group
of observations; a robot that takes no part has zeros. Recurrent states are initialised to zero, and
each output `next_X` is the input `X` of the next step. Of a match, the graph is that of team 0.

| control | outputs besides `action` (N, A, D) and the recurrent states |
|---|---|
| `command` | `commands` (N, A, C), `joint_target` (N, A, J), rad |
| `position` | `joint_target` (N, A, J), rad |
| `torque` | `torque` (N, A, J), N m |

Further inputs in `command` control: `gravity` (N, A, 3), the unit gravity vector in the trunk
frame, `joint_position` and `joint_velocity` (N, A, J), rad and rad/s. Recurrent states: those of
the skill, of the walk policy `walk_history` (N, A, 30, 70), `walk_action`, `walk_previous_action`
(N, A, J) and `walk_gait` (N, A), and those of the network: `memory` if it is one array, else
`memory_NAME`. Unlike robots have a skill for each kind, whose states have the rows of its robots:
`walk_0_history` that of robot 0, `walk_1_history` that of robot 1. J is the largest number of
joints; entries beyond a robot's own mean nothing.
"""

import functools
import json
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import onnx

import mqe_jax
from mqe_jax import skills
from mqe_jax.acting.seats import check_policy
from mqe_jax.core.errors import InputError
from mqe_jax.core.types import rows_of
from mqe_jax.envs import QuadrupedEnv
from mqe_jax.envs.params import weights_digest
from mqe_jax.export.translate import OPSET, translate
from mqe_jax.physics.robots.fleet import Fleet, pad
from mqe_jax.physics.robots.index import Proprioception
from mqe_jax.physics.robots.robot import Robot
from mqe_jax.skills.control import Group
from mqe_jax.train.policy import TrainedPolicy

SENSED = ("gravity", "joint_position", "joint_velocity")
"""Inputs of a skill that are its robot's `Proprioception`, in this order."""


def to_onnx(policy: TrainedPolicy, env: QuadrupedEnv) -> onnx.ModelProto:
    """Returns the graph of a policy with its mean actions.

    The task defines control mode, robot and walk policy.

    Example:
        ```python
        from mqe_jax.export.policy import to_onnx

        graph = to_onnx(mqe_jax.load_policy("go1gate"), mqe_jax.make("go1gate"))
        print([output.name for output in graph.graph.output])
        ```

    Raises:
        InputError: for another task than the policy's, or a network with an operation that has no
            translation.
    """
    check_policy(policy, env)
    step = functools.partial(policy_step, policy, env)
    return translate(
        step, input_shapes(policy, env), env.name.replace("-", "_"), properties(policy, env)
    )


def input_shapes(policy: TrainedPolicy, env: QuadrupedEnv) -> dict[str, tuple[int, ...]]:
    """Returns the shapes of the inputs of `policy_step` by name, without the batch axis."""
    agents = policy.agents
    shapes: dict[str, tuple[int, ...]] = {"obs": (agents, policy.needs.dims.observation)}
    if env.control == "command":
        sensed = sensed_shapes(env.robots)
        shapes |= {name: (agents, *shape) for name, shape in sensed.items()}
        for prefix, group in skills_of(env, agents).items():
            memory = name_arrays(prefix, group.skill.init_memory())
            shapes |= {name: (len(group.robots), *x.shape) for name, x in memory.items()}
    memory = name_arrays("memory", policy.initial_memory())
    return shapes | {name: x.shape for name, x in memory.items()}


def sensed_shapes(robots: Fleet) -> dict[str, tuple[int, ...]]:
    """Returns the shapes of the inputs `SENSED` by name."""
    joints = (robots.num_joints,)
    return dict(zip(SENSED, ((3,), joints, joints), strict=True))


def policy_step(
    policy: TrainedPolicy, env: QuadrupedEnv, inputs: Mapping[str, jax.Array]
) -> dict[str, jax.Array]:
    """Returns the outputs of a step of one environment by name.

    The graph maps this function over N.
    """
    memory = fill_arrays("memory", policy.initial_memory(), inputs)
    action, memory = policy.act(inputs["obs"], memory)
    outputs = {"action": action} | name_arrays("next_memory", memory)
    moving = env.moving(action)
    if env.control == "torque":
        limit = env.robots.table("torque_limit")[: policy.agents]
        return outputs | {"torque": moving * limit}
    if env.control == "position":
        target = env.robots.joint_targets(moving, env.params.position_scale)
        return outputs | {"joint_target": target}
    commands = env.controller.skill_commands(moving)
    sensed = Proprioception(*(inputs[name] for name in SENSED))
    targets = []
    numbers = []
    for prefix, group in skills_of(env, policy.agents).items():
        skill = group.skill
        rows = rows_of(group.robots)
        act = jax.vmap(functools.partial(skill.targets, group.params))
        memory = fill_arrays(prefix, skill.init_memory(), inputs)
        own = sensed.of(rows, skill.robot.num_joints)
        target, memory = act(memory, commands[rows] + group.shift, own)
        targets.append(pad(target, sensed.joint_position.shape[-1]))
        outputs |= name_arrays(f"next_{prefix}", memory)
        numbers += group.robots
    order = rows_of(np.argsort(numbers).tolist())
    return outputs | {"commands": commands, "joint_target": jnp.concatenate(targets)[order]}


def skills_of(env: QuadrupedEnv, agents: int) -> dict[str, Group]:
    """Returns who of the first agents uses which skill, for any commands.

    They are by the prefix of the skill's recurrent states: its name, with the number of its first
    robot if robots are unlike. Parameters are as in the files. InputError if a file has changed
    since the environment read it.
    """
    params = env.params
    if weights_digest(params.skill_weights) != env.digests.get("skill_weights"):
        raise InputError(
            f"skill_weights: {params.skill_weights} has changed since the environment read it"
        )
    unlike = len({*env.robots[:agents]}) > 1
    found = {}
    for group in env.controller.groups:
        own = tuple(number for number in group.robots if number < agents)
        if own:
            robot = group.skill.robot
            skill = skills.make(params.skill, robot)
            weights = skill.load_params(params.weights_of(robot))
            prefix = f"{skill.name}_{own[0]}" if unlike else skill.name
            found[prefix] = Group(skill, weights, own, group.shift)
    return found


def name_arrays(prefix: str, memory: Any) -> dict[str, Any]:
    """Returns the arrays of a recurrent state by name."""
    return {
        "_".join([prefix, *(jax.tree_util.keystr((key,), simple=True) for key in path)]): x
        for path, x in jax.tree_util.tree_leaves_with_path(memory)
    }


def fill_arrays(prefix: str, memory: Any, inputs: Mapping[str, jax.Array]) -> Any:
    """Returns a recurrent state of the structure of `memory` with the arrays of the inputs."""
    leaves = [inputs[name] for name in name_arrays(prefix, memory)]
    return jax.tree.unflatten(jax.tree.structure(memory), leaves)


def shapes(model: onnx.ModelProto) -> dict[str, dict[str, list[Any]]]:
    """Returns the shapes of a model's inputs and outputs by name; the batch axis is 'N'."""

    def of(values: Any) -> dict[str, list[Any]]:
        return {
            v.name: [d.dim_param or d.dim_value for d in v.type.tensor_type.shape.dim]
            for v in values
        }

    return {"inputs": of(model.graph.input), "outputs": of(model.graph.output)}


def properties(policy: TrainedPolicy, env: QuadrupedEnv) -> dict[str, str]:
    """Returns the metadata of a policy's graph."""
    blocks = env.layouts[policy.needs.group].blocks
    layout = [[block.name, block.width, block.meaning] for block in blocks]
    return {
        "mqe_jax": mqe_jax.__version__,
        "opset": str(OPSET),
        "task": env.name,
        "control": env.control,
        "robot": env.robots.identity,
        "period_s": f"{env.dt:g}",
        "group": policy.needs.group,
        "observation": json.dumps(layout),
        **joint_properties(env.robots[: policy.agents]),
        "joint_angles": "rad, in blocks of the observation minus default_joints_rad",
        "env_steps": str(policy.metadata.get("env_steps", "")),
    }


def joint_properties(team: Sequence[Robot]) -> dict[str, str]:
    """Returns the metadata on the joints of a graph's robots: one value if robots are alike."""

    def of_robots(rows: list[Any]) -> str:
        return json.dumps(rows if len({*team}) > 1 else rows[0])

    return {
        "joints": of_robots([list(robot.joint_names) for robot in team]),
        "default_joints_rad": of_robots(
            [np.round(robot.default_joints, 6).tolist() for robot in team]
        ),
        "kp_nm_per_rad": of_robots([round(robot.kp, 6) for robot in team]),
        "kd_nms_per_rad": of_robots([round(robot.kd, 6) for robot in team]),
    }
