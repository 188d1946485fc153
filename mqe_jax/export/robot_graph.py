"""The graph of one robot: from its own readings to its own actions, as its team's policy does.

| input | output | |
|---|---|---|
| `obs` (N, 1, O) | `action` (N, 1, D) | the robot's row of the policy's group; actions in [-1, 1] |
| `noise` (N, K) | | standard normal numbers, of a policy that samples |
| `memory`, `memory_NAME` | `next_memory`, ... | recurrent state, zero at an episode's start |

`skill_onnx` has the graph of its skill: from commands and joints to joint targets.
"""

import dataclasses
import json
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import onnx
from onnx import helper

from mqe_jax.acting.seats import check_policy
from mqe_jax.core.settings import fail, to_mapping
from mqe_jax.core.types import observations, shapes_of
from mqe_jax.envs import QuadrupedEnv, VectorEnv
from mqe_jax.export.check import LARGEST_ERROR, STEPS, Arrays, check_errors, verify
from mqe_jax.export.policy import joint_properties, properties
from mqe_jax.export.task import Shapes, readings_function, skill_function
from mqe_jax.export.translate import translate
from mqe_jax.train.policy import TrainedPolicy, template

VELOCITY = ("vx", "vy", "yaw_rate")
"""Commands that a robot's velocity has, in this order."""


def robot_onnx(policy: TrainedPolicy, env: QuadrupedEnv) -> onnx.ModelProto:
    """Returns the graph of any robot of a policy's team.

    Its actions are means if those of the policy are.

    Raises:
        InputError: for another task than the policy's, a policy whose robots do not share a
            network, or an operation that has no translation.
    """
    check_policy(policy, env)
    act, sizes = readings_function(_one_robot(policy), policy.needs.dims.observation)
    about = properties(policy, env) | {
        "needs": json.dumps(to_mapping(policy.needs)),
        "actions": "mean" if policy.deterministic else "sampled",
        **_velocity(env),
    }
    return translate(act, sizes, f"{env.name.replace('-', '_')}_robot", about)


def _velocity(env: QuadrupedEnv) -> dict[str, str]:
    """Returns how actions become velocities, if these are what actions set (`Robot.velocity`)."""
    commander = env.controller
    if env.control != "command" or commander.commands != VELOCITY:
        return {}
    about = {
        "default": commander.limits[:, 0] - commander.changes[:, 0],
        "slopes": commander.slopes,
        "limits": commander.limits,
    }
    return {"velocity": json.dumps({name: x.tolist() for name, x in about.items()})}


def verify_robot(policy: TrainedPolicy, env: QuadrupedEnv) -> tuple[onnx.ModelProto, float]:
    """Returns the graph of `robot_onnx` and its largest error against JAX in `STEPS` steps.

    Raises:
        InputError: as `robot_onnx`, for a policy whose robots need what others sense, or an error
            above `LARGEST_ERROR`.
    """
    model = robot_onnx(policy, env)
    inputs, outputs, apart = _record(policy, env)
    if apart > LARGEST_ERROR:
        fail(
            "network",
            policy.config.network.name,
            "one whose robots act on their own readings only (--per-robot)",
        )
    return model, check_errors(model, inputs, outputs, f"{STEPS} steps of {env.name}")


def skill_onnx(env: QuadrupedEnv) -> onnx.ModelProto:
    """Returns the graph of the skill of a task's robots, which must be alike.

    `joint_position` and `joint_target` are angles in rad, not minus the stance. The graph bounds
    turns as the simulation does (`Skill.turn`). At an episode's start, the inputs with the skill's
    name are zero; then they are the outputs `next_NAME`. The metadata has the joints, their stance
    and gains, and the default of each command.
    """
    function, sizes = skill_function(env)
    skill = env.controller.skill
    random = np.random.default_rng(0)
    given = {
        name: random.normal(size=(STEPS, *size)).astype(np.float32) for name, size in sizes.items()
    }
    model = verify(function, sizes, skill.name, given)
    names = [command.name for command in skill.commands]
    defaults = dict(zip(names, env.controller.default_commands.tolist(), strict=True))
    about = joint_properties(env.robots) | {"default_commands": json.dumps(defaults)}
    helper.set_model_props(model, about)
    return model


def _one_robot(policy: TrainedPolicy) -> TrainedPolicy:
    """Returns the policy of a team of one.

    It acts as each robot of a team whose robots do not see each other.
    """
    if policy.agents == 1:
        return policy
    network = policy.config.network
    if network.mixes_agents:
        allowed = "one whose robots act on their own readings only (--per-robot)"
        fail("network", network.name, allowed)
    needs = dataclasses.replace(policy.needs, dims=policy.dims._replace(agents=1, values=1))
    expected = template(needs.dims, policy.config.network)["params"]
    if shapes_of(policy.params) != shapes_of(expected):
        fail("policy", policy, "one whose robots share a network (--per-robot)")
    return dataclasses.replace(policy, needs=needs)


def _record(policy: TrainedPolicy, env: QuadrupedEnv) -> tuple[Arrays, Arrays, float]:
    """Returns inputs and outputs of a robot's function by name, leading axis robots and steps.

    The third value is the largest difference of its actions from those that the policy computes for
    the team.
    """
    agents = policy.agents
    size = policy.needs.dims.observation
    group = policy.needs.group
    batch = VectorEnv(env, 1, final=()).with_groups(policy.groups)
    team, team_sizes = readings_function(policy, size)
    robot, sizes = readings_function(_one_robot(policy), size)

    def empty(sizes: Shapes, *lead: int) -> dict[str, jax.Array]:
        return {n: jnp.zeros((*lead, *x)) for n, x in sizes.items() if n.startswith("memory")}

    @jax.jit
    def advance(state: Any, memories: Any, noise: jax.Array) -> Any:
        seen = observations(state).group(group)[0, :agents]
        inputs = {"obs": seen[:, None], **memories[0]}
        team_inputs = {"obs": seen, **memories[1]}
        if "noise" in sizes:
            inputs["noise"] = noise
            team_inputs["noise"] = noise.reshape(-1)
        outputs = jax.vmap(robot)(inputs)
        together = team(team_inputs)
        action = jnp.zeros((1, env.num_agents, env.action_size))
        state = batch.step(state, action.at[0, :agents].set(together["action"]))
        kept = 1.0 - (state.terminated | state.truncated)[0]
        own = {name: kept * outputs[f"next_{name}"] for name in memories[0]}
        common = {name: kept * together[f"next_{name}"] for name in memories[1]}
        return inputs, outputs, together["action"], state, [own, common]

    random = np.random.default_rng(0)
    rows = []
    apart = 0.0
    state = jax.jit(batch.reset)(jax.random.PRNGKey(0))
    memories = [empty(sizes, agents), empty(team_sizes)]
    for _ in range(STEPS):
        noise = random.standard_normal((agents, *sizes.get("noise", (0,))), np.float32)
        inputs, outputs, action, state, memories = advance(state, memories, noise)
        rows.append(jax.device_get((inputs, outputs)))
        apart = max(apart, float(jnp.abs(outputs["action"][:, 0] - action).max()))
    return *jax.tree.map(lambda *x: np.concatenate(x), *rows), apart
