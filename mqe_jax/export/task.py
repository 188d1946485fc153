"""A task as functions of arrays by name, and their ONNX graphs, without physics and randomness.

In an environment step the graphs run in this order; the physics steps are between `skill` and
`judge`.

| graph | of | inputs |
|---|---|---|
| `policy` | a team | `obs` (A, O), or state and `team` (); `noise` (K,), recurrent states |
| `control` | the task | state, `action` (A, D), `drive` (A, D), `driven` (A,), `noise` (K,) |
| `skill` | a robot | `command` (C,), `gravity` (3,), joint states (J,), recurrent states |
| `judge` | the task | state after the step, `before_qpos`, `before_qvel`, `before_sensordata` |

The policy's output is `action` (A, D), the skill's `joint_target` (J,), rad; `TaskFunctions` has
those of the task. The state is `qpos`, `qvel`, `sensordata`, `step` (environment steps since the
reset), and where the task has them `anchors` and its own fields as `task_NAME`. Every array has a
leading batch axis N. `noise` are standard normal numbers. The next value of an input X is the
output `next_X`; recurrent states start at zero.
"""

import contextlib
import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp

from mqe_jax.acting.seats import Policy, groups_of
from mqe_jax.core.errors import InputError
from mqe_jax.core.settings import fail
from mqe_jax.envs import QuadrupedEnv
from mqe_jax.envs.observation import finite
from mqe_jax.envs.state import Moment, State
from mqe_jax.export.policy import SENSED, fill_arrays, name_arrays, sensed_shapes, skills_of
from mqe_jax.export.translate import Function
from mqe_jax.physics.robots.index import Proprioception
from mqe_jax.sensors.suite import ONBOARD

PHYSICS = ("qpos", "qvel", "sensordata")
"""Arrays of the physics state that tasks read."""

Shapes = dict[str, tuple[int, ...]]
Arrays = Mapping[str, Any]


class TaskFunctions:
    """The functions of a task, of one environment, without domain randomisation.

    InputError for another control mode than `command`, an actuator network, or episodes of several
    sizes.

    Example:
        ```python
        from mqe_jax.export.task import TaskFunctions
        from mqe_jax.export.translate import translate

        functions = TaskFunctions(mqe_jax.make("go1gate"))
        graph = translate(functions.control, functions.control_inputs, "control")
        print([output.name for output in graph.graph.output])
        ```
    """

    def __init__(self, env: QuadrupedEnv) -> None:
        if env.control != "command":
            raise InputError(
                f"control: {env.control!r} is not allowed; graphs of tasks need 'command'"
            )
        if env.params.actuator_network is not None:
            raise InputError("actuator_network: not allowed; graphs of tasks need PD control")
        if env.varies:
            raise InputError(
                "fewest_agents, fewest_sheep: not allowed; graphs of tasks need one size"
            )
        if not env.robots.alike:
            raise InputError(
                f"robots: {env.robots.identity} are not allowed; graphs of tasks need one kind"
            )
        parts = [part.name for part in env.controller.skill.parts]
        if env.controller.npc and env.npc_skill not in parts:
            raise InputError(
                f"skill: {env.params.skill!r} is not allowed; graphs of tasks need that of the "
                f"NPC robots, {env.npc_skill!r}, alone or among several"
            )
        self.env = env
        self._start = jax.jit(env.reset)(jax.random.PRNGKey(0))
        robots = env.read(self._start.data)
        result = env.result(self._start, robots, jnp.zeros((), bool))
        self.outcomes: list[str] = list(result.by_name())
        self._noise = _noise_size(lambda: env.step_npcs(self._start.data, robots, self._start.key))

    @property
    def control_inputs(self) -> Shapes:
        """Shapes of the inputs of `control` by name."""
        actions = (self.env.num_agents, self.env.action_size)
        noise = {"noise": (self._noise,)} if self._noise else {}
        own = {"action": actions, "drive": actions, "driven": actions[:1]}
        return self.state_inputs | own | noise

    @property
    def judge_inputs(self) -> Shapes:
        """Shapes of the inputs of `judge` by name."""
        return self.state_inputs | {f"before_{name}": self.state_inputs[name] for name in PHYSICS}

    def control(self, inputs: Arrays) -> dict[str, jax.Array]:
        """Returns what the skill and the physics get in a step.

        `command` (R, C), `gravity` (R, 3), `joint_position` and `joint_velocity` (R, J) are the
        skill's inputs for the R robots. Only tasks that have them return `next_qvel` (nv,), the
        velocities with those of NPCs, and `xfrc_applied` (nbody, 6), external forces, N and N m.
        `drive` replaces the actions of the agents where `driven` is 1, in the robot's own frame.
        """
        env = self.env
        state = self.state(inputs)
        robots = env.read(state.data)
        action = env.unmirror_action(env.moving(jnp.clip(inputs["action"], -1.0, 1.0)))
        action = jnp.where(inputs["driven"][:, None] > 0.5, env.moving(inputs["drive"]), action)
        commands = env.controller.skill_commands(action)
        npcs = env.npc_commands(state, robots)
        if npcs is not None:
            npcs = env.controller.skill.with_choice(env.npc_skill, npcs)
            commands = jnp.concatenate([commands, npcs])
        outputs = {"command": commands, **dict(zip(SENSED, robots.proprioception, strict=True))}
        with normal_numbers(inputs.get("noise")):
            data = env.step_npcs(state.data, robots, state.key)
        if data is not state.data:
            outputs["next_qvel"] = data.qvel
        forces = env.external_forces(state)
        if forces is not None:
            outputs["xfrc_applied"] = forces
        return outputs

    def judge(self, inputs: Arrays) -> dict[str, jax.Array]:
        """Returns the observation, the result and the task's next fields after a step.

        Outputs are `obs` (A, O), `outcome` (the values of `outcomes` as if the episode ended here)
        and `next_task_NAME`. `terminated`, `truncated`, `fell` and `collided` are 0 or 1; the last
        two say whether a fall or a collision ended the episode.
        """
        env = self.env
        after = self.state(inputs)
        before = self.state({**inputs, **{name: inputs[f"before_{name}"] for name in PHYSICS}})
        before = dataclasses.replace(before, step=after.step - 1)
        robots = env.read(after.data)
        state = env.judge(Moment(before, env.read(before.data)), Moment(after, robots))
        obs = env.observation_layout.pack(env.observe(state, robots))
        outputs = {
            "obs": finite(obs),
            "outcome": jnp.stack([state.outcome.by_name()[name] for name in self.outcomes]),
            "terminated": state.terminated,
            "truncated": state.truncated,
            "fell": state.outcome.ending["fall"],
            "collided": state.outcome.ending["collision"],
            **name_arrays("next_task", state.task),
        }
        return {name: x.astype(jnp.float32) for name, x in outputs.items()}

    def state(self, inputs: Arrays) -> State:
        """Returns the environment's state with the arrays of the inputs."""
        start = self._start
        data = start.data.replace(**{name: inputs[name] for name in PHYSICS})
        task = _like(fill_arrays("task", start.task, inputs), start.task)
        anchors = inputs.get("anchors", start.anchors)
        step = inputs["step"].astype(jnp.int32)
        return dataclasses.replace(start, data=data, anchors=anchors, task=task, step=step)

    @property
    def state_inputs(self) -> Shapes:
        """Shapes of the arrays of a state by name."""
        return {name: x.shape for name, x in state_arrays(self._start).items()}


def _like(arrays: Any, first: Any) -> Any:
    """Returns arrays with the types of those of `first`."""
    return jax.tree.map(lambda x, like: x.astype(like.dtype), arrays, first)


def state_arrays(state: State) -> dict[str, jax.Array]:
    """Returns the arrays of a state by name, float32; the inverse of `TaskFunctions.state`."""
    physics = {name: getattr(state.data, name) for name in PHYSICS}
    arrays = {
        **physics,
        "anchors": state.anchors,
        "step": state.step,
        **name_arrays("task", state.task),
    }
    return {name: jnp.asarray(x, jnp.float32) for name, x in arrays.items() if x.size}


def skill_function(env: QuadrupedEnv) -> tuple[Function, Shapes]:
    """Returns the skill of a task's robots as a function of one robot, and its inputs' shapes.

    InputError for unlike robots, and for robots without a skill.
    """
    groups = [*skills_of(env, env.num_agents).values()]
    if len(groups) != 1:
        found = f"{env.name}, robots {env.robots.identity}, control {env.control}"
        fail("env", found, "one of alike robots with control command")
    (group,) = groups
    skill = group.skill
    memory = name_arrays(skill.name, skill.init_memory())
    shapes = {
        "command": (len(skill.commands),),
        **sensed_shapes(env.robots),
        **{name: x.shape for name, x in memory.items()},
    }

    def act(inputs: Arrays) -> dict[str, jax.Array]:
        sensed = Proprioception(*(inputs[name] for name in SENSED))
        state = fill_arrays(skill.name, skill.init_memory(), inputs)
        command = skill.limit_turn(inputs["command"])
        target, state = skill.targets(group.params, state, command, sensed)
        return {"joint_target": target} | name_arrays(f"next_{skill.name}", state)

    return act, shapes


def policy_function(policy: Policy, functions: TaskFunctions) -> tuple[Function, Shapes]:
    """Returns a policy as a function of one team, and the shapes of its inputs.

    The function samples if `policy` does.
    """
    (group,) = groups_of([policy])
    act, shapes = _act_on_readings(policy, functions.env.group_sizes[group])
    if group == ONBOARD:
        act, shapes = _sensing(act, shapes, functions)
    return _with_noise(act, shapes)


def readings_function(policy: Policy, size: int) -> tuple[Function, Shapes]:
    """Returns a policy as a function of the observations `obs` (A, size) of a team.

    See `policy_function`.
    """
    return _with_noise(*_act_on_readings(policy, size))


def _act_on_readings(policy: Policy, size: int) -> tuple[Function, Shapes]:
    memory = jax.tree.map(lambda x: x[0], policy.initial_memory(1))
    key = jax.random.PRNGKey(0)

    def act(inputs: Arrays) -> dict[str, jax.Array]:
        state = jax.tree.map(lambda x: x[None], fill_arrays("memory", memory, inputs))
        action, state = policy.act(inputs["obs"][None], state, key)
        after = {name: x[0] for name, x in name_arrays("next_memory", state).items()}
        return {"action": action[0], **after}

    recurrent = {name: x.shape for name, x in name_arrays("memory", memory).items()}
    return act, {"obs": (policy.agents, size), **recurrent}


def _with_noise(act: Function, shapes: Shapes) -> tuple[Function, Shapes]:
    """Returns a function whose normal numbers are the input `noise` (K,), and its inputs.

    It is `act` itself if that draws none.
    """

    def act_with_noise(inputs: Arrays) -> dict[str, jax.Array]:
        with normal_numbers(inputs["noise"]):
            return dict(act(inputs))

    size = _noise_size(lambda: act({name: jnp.zeros(shape) for name, shape in shapes.items()}))
    if not size:
        return act, shapes
    return act_with_noise, shapes | {"noise": (size,)}


def _sensing(choose: Function, shapes: Shapes, functions: TaskFunctions) -> tuple[Function, Shapes]:
    """Returns the function of a state that senses and then acts for a team, and its inputs.

    The input `team` () is the number of the team. `choose` with its inputs is a policy that sees
    sensors. The recurrent states `sense_NAME` are those of all agents' sensors; the last actions
    among them are right for the team's own.
    """
    env = functions.env
    first = env.suite.reset()
    own = {name: x.shape for name, x in name_arrays("sense", first).items() if x.size}

    def act(inputs: Arrays) -> dict[str, jax.Array]:
        arrays = {name: inputs.get(name, x) for name, x in name_arrays("sense", first).items()}
        senses = _like(fill_arrays("sense", first, arrays), first)
        state = dataclasses.replace(functions.state(inputs), senses=senses)
        snapshot = env.snapshot(state, env.read(state.data))
        blocks, senses = env.suite.observe(snapshot, senses, state.key)
        every = finite(env.layouts[ONBOARD].pack(blocks, env.num_agents))
        teams = [every[team[0] : team[-1] + 1] for team in env.teams]
        outputs = choose({**inputs, "obs": jnp.where(inputs["team"] < 0.5, teams[0], teams[-1])})
        action = jnp.tile(jnp.clip(outputs["action"], -1.0, 1.0), (len(teams), 1))
        after = name_arrays("next_sense", senses._replace(action=action))
        return {**outputs, **{n: x.astype(jnp.float32) for n, x in after.items() if x.size}}

    others = {name: shape for name, shape in shapes.items() if name != "obs"}
    return act, {**functions.state_inputs, "team": (), **others, **own}


@contextlib.contextmanager
def normal_numbers(
    noise: jax.Array | None, used: Callable[[int], None] = lambda size: None
) -> Iterator[None]:
    """Within it, `jax.random.normal` returns the numbers of `noise` (K,) in order, or zeros.

    `uniform` and `bernoulli` are made of such numbers. A graph has no random keys, so its noise is
    an input. Nothing is compiled within, as JAX would keep it.
    """
    position = 0

    def normal(key: jax.Array, shape: tuple[int, ...] = (), dtype: Any = jnp.float32) -> jax.Array:
        nonlocal position
        first = position
        position = position + math.prod(shape)
        used(position)
        return jnp.zeros(shape, dtype) if noise is None else noise[first:position].reshape(shape)

    def uniform(
        key: jax.Array,
        shape: tuple[int, ...] = (),
        dtype: Any = jnp.float32,
        minval: Any = 0.0,
        maxval: Any = 1.0,
    ) -> jax.Array:
        part = 1.0 + jax.lax.erf(normal(key, shape, dtype) / math.sqrt(2.0))
        return minval + (maxval - minval) * 0.5 * part

    draws = {
        "normal": normal,
        "uniform": uniform,
        "bernoulli": lambda key, p, shape: uniform(key, shape) < p,
    }
    with jax.disable_jit(), mock.patch.multiple(jax.random, **draws):
        yield


def _noise_size(function: Callable[[], Any]) -> int:
    """Returns how many normal numbers a function draws."""
    sizes = [0]
    with normal_numbers(None, sizes.append):
        jax.eval_shape(function)
    return sizes[-1]
