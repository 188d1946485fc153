"""The environment core: pure `reset` and `step` functions of one environment of several robots.

`jax.vmap` batches them.

A task is a subclass in its own file (`mqe_jax.envs.task`). This module has what all tasks share:
spawning, control, physics, randomisation, falls, collisions, the time limit, and the detection of
diverged physics.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Hashable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mqe_jax.core import keys
from mqe_jax.core.errors import InputError
from mqe_jax.core.limits import Environments
from mqe_jax.core.precision import single
from mqe_jax.core.returned import alike, check_shape, check_signatures, results, weights_of
from mqe_jax.core.settings import Parameters, check, checked, differences, fail
from mqe_jax.core.types import EXACT, Level, Outcome, RandomKey
from mqe_jax.envs.assembly import make_controller, make_scene
from mqe_jax.envs.observation import ObservationLayout, finite, observe_bodies
from mqe_jax.envs.params import P, weights_digest
from mqe_jax.envs.privileged import PrivilegedObservation
from mqe_jax.envs.randomization import Randomizer
from mqe_jax.envs.sizes import Sizes, check_sizes, hide
from mqe_jax.envs.state import ENDINGS, Moment, S, State, with_final
from mqe_jax.envs.task import Task
from mqe_jax.physics import engines
from mqe_jax.physics.actuators import NetworkActuators, load_actuator_network
from mqe_jax.physics.kinematics import poses
from mqe_jax.physics.robots.index import RobotState, read_robots, scatter
from mqe_jax.physics.rotation import euler_to_quaternion
from mqe_jax.physics.scene import build_model, compile_scene
from mqe_jax.sensors.suite import ONBOARD
from mqe_jax.skills.control import check_mode

if TYPE_CHECKING:
    from mujoco import mjx

T = TypeVar("T")


class _Recorded(type):
    """Class of environments, which know the arguments with which they were made."""

    def __call__(cls: type[T], *arguments: Any, **named: Any) -> T:
        made = type.__call__(cls, *arguments, **named)
        vars(made)["_arguments"] = arguments, named
        return made


class QuadrupedEnv(Task[S, P], metaclass=_Recorded):
    """Base of all tasks: functions of one environment.

    `jax.vmap` batches and `jax.jit` compiles them.

    Example:
        ```python
        env = mqe_jax.make("go1gate")
        state = jax.jit(env.reset)(jax.random.PRNGKey(0))  # then jax.jit(env.step)(state, action)
        ```
    """

    _arguments: tuple[tuple[Any, ...], dict[str, Any]]  # of the constructor
    _later: tuple[str, ...] = ()  # attributes that were set after it

    @single
    @checked
    def __init__(
        self,
        params: P | None = None,
        *,
        impl: str = "auto",
        control: str = "command",
        num_envs: Environments = 4096,
    ) -> None:
        check_signatures(type(self), Task)
        self.params = self.Params() if params is None else params
        self.weights = weights_of(self.params)
        offset = self.params.randomization.motor_offset
        self.control = check_mode(control)
        if offset and control == "torque":
            fail(
                "randomization.motor_offset",
                offset,
                "0 with control torque, which has no joint targets",
            )
        self.num_agents = self.params.num_agents
        check_sizes(self)
        self._scene = scene = make_scene(self)
        self.compiled = compile_scene(scene)
        self.robots = self.compiled.robots
        self.index = self.compiled.index
        self.objects = self.compiled.objects
        for name, (places, noise) in self.spreads.items():
            room = self.compiled.layout.room(places)
            what = "spawn_poses" if name == "spawn_noise" else "its places"
            if room < 0.0:
                raise InputError(f"{name}: {what} lie {-room:.2f} m outside of the outer walls")
            if noise > room:
                allowed = f"at most {room:.2f}, the distance of {what} to the nearest outer wall"
                fail(name, getattr(self.params, name), allowed)
        constraints = self.params.constraints_per_robot * scene.num_robots
        constraints += 4 * self.extra_contacts
        self.physics = engines.make(
            self.compiled.model,
            motors=self.compiled.motors,
            impl=impl,
            num_envs=num_envs,
            contacts_per_env=scene.max_contacts,
            max_constraints_per_env=constraints,
            sparse_solver=self.params.sparse_solver,
        )
        self.impl = self.physics.impl
        self.dt = float(self.compiled.model.opt.timestep) * self.physics.num_substeps
        if self.max_steps < 1:
            fail(
                "episode_length",
                self.params.episode_length,
                f"at least one environment step, {self.dt} s",
            )
        self.actuators = None
        network = self.params.actuator_network
        if network and control != "torque":
            weights = load_actuator_network(network)
            self.actuators = NetworkActuators(self.physics, self.index, self.robots, weights)
        self.controller = make_controller(self, scene, self.physics.num_substeps)
        reads = {
            "actuator_network": network if self.actuators else None,
            "skill_weights": self.params.skill_weights if self.controller.skilled else None,
        }
        found = {name: weights_digest(files) for name, files in reads.items()}
        self.digests = {name: value for name, value in found.items() if value}
        contents = [kind.digest for kind in self.robots.kinds if kind.digest]
        if contents:
            self.digests["robot"] = " ".join(contents)
        self.check_senses()
        self.sizes = Sizes(self)
        self.randomizer = Randomizer(
            self.params.randomization, self.compiled.model, self.index, self.params.friction
        )
        clock = jax.eval_shape(lambda: self.controller.clock(self.controller.reset()))
        self.privileged = PrivilegedObservation(
            self.robots,
            self.compiled.model,
            self.index,
            num_anchors=len(self.compiled.layout.anchors),
            clock_size=clock.shape[1],
            contact_forces=self.params.privileged_contact_forces,
        )

    @property
    def identity(self) -> Hashable:
        """A value that is equal for environments that act alike.

        Those of the package's tasks do if parameters, engine and the contents of weights files are
        equal, and no attribute was set later. Any other one is alike only to itself.
        """
        if not type(self).__module__.startswith("mqe_jax.") or self._later:
            return id(self)
        made = (self.params, self.impl, self.control, self.physics.num_envs)
        return type(self), *made, *sorted(self.digests.items())

    def __setattr__(self, name: str, value: Any) -> None:
        if "_arguments" in vars(self):
            vars(self)["_later"] = (*self._later, name)
        super().__setattr__(name, value)

    def __repr__(self) -> str:
        actions = f"{self.control} {self.action_size}"
        if self.control == "command":
            actions += f" ({self.skill_text})"
        agents = " vs ".join(str(len(team)) for team in self.teams)
        changed = differences(self.params, self.Params())
        if self.params.senses:
            changed["senses"] = [sensor.name for sensor in self.params.senses]
        facts = [
            f"{agents} agents",
            f"observation {self.observation_size}",
            f"action {actions}",
            f"engine {self.impl}",
            *(f"{name}={value!r}" for name, value in changed.items()),
        ]
        return f"<{self.name}: {', '.join(facts)}>"

    @property
    def skill_text(self) -> str:
        """The skill and what its commands range over, such as `walk: vx -1 to 1`."""
        if self.control != "command":
            return f"none, control {self.control}"
        return self.params.commanded_text()

    @property
    def privileged_layout(self) -> ObservationLayout:
        """The blocks of the privileged observation, in order; physical units, not normalised."""
        return self.privileged.layout

    @property
    def privileged_observation_size(self) -> int:
        """Length of the privileged observation P."""
        return self.privileged_layout.size

    @functools.cached_property
    def mj_model(self) -> mujoco.MjModel:
        """Rendering model: the physics model plus visual geoms.

        The layouts of qpos and mocap bodies are identical.
        """
        return build_model(self._scene, visual=True)[0]

    @property
    def max_steps(self) -> int:
        """Environment steps until the time limit."""
        return round(self.params.episode_length / self.dt)

    def with_num_envs(self, num_envs: int) -> QuadrupedEnv[S, P]:
        """Returns an environment whose engine holds `num_envs` environments.

        It is this one, or one with larger buffers. Errors are as of `changed`.
        """
        return self.changed({}, num_envs)

    @checked
    def changed(self, params: Parameters, num_envs: Environments = 1) -> QuadrupedEnv[S, P]:
        """Returns an environment with other parameters, whose engine holds `num_envs` environments.

        It is this one if nothing differs. Another one is made with the arguments of this one's
        constructor, in which only parameters, control mode and `num_envs` differ.

        Example:
            ```python
            env = mqe_jax.make("go1gate")
            print(env.changed({"gate_width": 0.8, "control": "position"}))
            ```

        Raises:
            InputError: for an unknown parameter or a value that is not allowed, and if another
                environment is needed but would lose an attribute that was set on this one.
        """
        others = {name: value for name, value in params.items() if name != "control"}
        control = params.get("control", self.control)
        wanted = self.params.changed(others)
        arguments: dict[str, Any] = {}
        if wanted != self.params:
            arguments["params"] = wanted
        if control != self.control:
            arguments["control"] = control
        if not self.physics.holds(num_envs):
            arguments["num_envs"] = num_envs
        if not arguments:
            return self
        differing = [*differences(wanted, self.params)]
        made = self._repeat(arguments, differing + [x for x in arguments if x != "params"])
        for name, value in differences(made.params, wanted).items():
            raise InputError(f"{name}: the constructor of {type(self).__name__} makes it {value!r}")
        return made

    def _repeat(self, changes: Mapping[str, Any], needed: Sequence[str]) -> QuadrupedEnv[S, P]:
        """Returns an environment made with changed arguments of this one's constructor.

        Errors name what `needed` it.
        """
        kind = type(self).__name__
        names = ", ".join(needed)
        if self._later:
            raise InputError(
                f"{names}: another {kind} is needed, and it would lose the attribute "
                f"{self._later[0]!r}, which was set after the constructor"
            )
        signature = inspect.signature(type(self).__init__)
        (_, *known) = signature.parameters
        first, named = self._arguments
        arguments = {**dict(zip(known, first, strict=False)), **named, **changes}
        try:
            signature.bind(self, **arguments)
        except TypeError as error:
            raise InputError(
                f"{names}: another {kind} is needed, but its constructor rejects that ({error})"
            ) from None
        return type(self)(**arguments)

    @single
    @checked
    def reset(self, key: RandomKey, assistance: Level = 0.0) -> State[S]:
        """Returns a randomised initial state.

        The task is unmodified at `assistance` 0; a curriculum passes levels up to 1.
        """
        return with_final(self.with_observations(self.begin(key, assistance)))

    def begin(self, key: jax.Array, assistance: jax.Array | float = 0.0) -> State[S]:
        """Returns the state of `reset` without observations."""
        (
            next_key,
            anchor_key,
            spawn_key,
            body_key,
            object_key,
            physics_key,
            task_key,
            size_key,
            freeze_key,
        ) = jax.random.split(key, 9)
        assistance = jnp.asarray(assistance, jnp.float32)
        anchors = self.compiled.sample_anchors(anchor_key)
        active = self.sizes.draw(size_key, assistance)
        spawn = self.sizes.line_up(self.spawn(spawn_key), active)
        qpos, qvel = self._sample_robots(spawn, body_key)
        qpos, qvel = self.reset_objects(object_key, qpos, qvel, assistance)
        ctrl = self._ctrl(jnp.asarray(self.controller.neutral))
        data = self.physics.init(qpos, qvel, self.compiled.wall_positions(anchors), ctrl)
        data = self.sizes.park(data, active)
        robot_state = self.read(data, active)
        no = jnp.zeros((), bool)
        nothing: Any = None
        state = State(
            data=data,
            groups={},
            privileged_obs=jnp.zeros((0,)),
            final_groups=None,
            final_privileged_obs=None,
            reward=jnp.zeros(self.num_agents),
            terminated=no,
            truncated=no,
            outcome=Outcome(),
            metrics={},
            step=jnp.zeros((), jnp.int32),
            anchors=anchors,
            control=self.controller.reset(),
            actuators=self.actuators.init_memory() if self.actuators else (),
            randomized=self.randomizer.sample(physics_key),
            task=nothing,
            assistance=assistance,
            frozen_steps=self._sample_frozen_steps(freeze_key, assistance, active),
            key=next_key,
            active=active,
            used=None if self.used is None else jnp.asarray(self.used),
            readings=self._reset_readings(key),
            senses=self.suite.reset() if self.params.senses else (),
        )
        state = dataclasses.replace(state, task=self.reset_task(task_key, state, robot_state))
        now = Moment(state, robot_state)
        _, logged = self.score(now, now, no)
        names = (*logged, "collision", "diverged", "overflow")
        metrics = {name: jnp.zeros(()) for name in names}
        outcome = self.result(state, robot_state, no)
        outcome = dataclasses.replace(outcome, ending=dict.fromkeys(ENDINGS, no))
        outcome = jax.tree.map(lambda x: jnp.zeros(jnp.shape(x)), outcome)
        return dataclasses.replace(state, outcome=outcome, metrics=metrics)

    def _reset_readings(self, key: jax.Array) -> Any:
        memories = {}
        for number, (name, errors) in enumerate(self.reading_errors.items()):
            memories[name] = errors.reset(jax.random.fold_in(key, keys.READINGS + number))
        return memories or ()

    @single
    def step(self, state: State[S], action: jax.Array) -> State[S]:
        """Advances one environment by one environment step with actions (A, action_size).

        They are clipped to `action_limit`.

        An episode that has ended continues unless it is reset (see `VectorEnv`). InputError for a
        state of another task or of a batch, and for an action of another shape or dtype, or that is
        not finite. In compiled code an action that is not finite ends the episode as diverged.
        """
        return with_final(self.with_observations(self.advance(state, action)))

    @jax.named_scope("task")
    def advance(self, state: State[S], action: jax.Array) -> State[S]:
        """Returns the state of `step`, still with the observations of the state before."""
        self.check_state(state)
        action = self.controller.check_action(action, self.action_size)
        bad_action = ~jnp.all(jnp.isfinite(action) | ~state.active[:, None])
        action = jnp.nan_to_num(action.astype(jnp.float32))
        action = jnp.clip(action, -self.action_limit, self.action_limit)
        still = (state.step < state.frozen_steps) | ~self.acting(state)
        own_action = jnp.where(still[:, None], 0.0, action)
        if self.used is not None:
            own_action = jnp.where(self.used, own_action, 0.0)
        action = self.unmirror_action(self.moving(own_action))
        key, push_key, _, npc_key = jax.random.split(state.key, 4)

        before = Moment(state, self.read(state.data, state.active))
        target, control = self.controller.targets(
            state.control,
            action,
            before.robots.proprioception,
            self.npc_commands(before.state, before.robots),
            state.randomized.action_lag,
        )
        if self.params.randomization.motor_offset:
            target = target + state.randomized.motor_offset
        target = self.sizes.hold(target, state.active)
        data = self.randomizer.push(state.data, state.randomized.push, push_key, self.dt)
        data = self.step_npcs(data, before.robots, npc_key)
        data = self.sizes.park(data, state.active)
        fields = self.randomizer.fields(state.randomized) | self.fields(state)
        forces = self.external_forces(state)
        if self.actuators is None:
            actuators = ()
            data, overflow = self.physics.step(
                data, self._ctrl(target), fields=fields, xfrc_applied=forces
            )
        else:
            data, actuators, overflow = self.actuators.step(
                data, state.actuators, target, fields, forces
            )
        robot_state = self.read(data, state.active)
        senses = state.senses._replace(action=own_action) if self.params.senses else ()
        moved = {"data": data, "control": control, "actuators": actuators, "senses": senses}
        state = dataclasses.replace(state, **moved, step=state.step + 1, key=key)
        state = self.judge(before, Moment(state, robot_state), bad_action)
        metrics = {**state.metrics, "overflow": overflow.astype(jnp.float32)}
        return dataclasses.replace(state, metrics=metrics)

    @jax.named_scope("task")
    def with_observations(self, state: State[S], groups: Sequence[str] = ()) -> State[S]:
        """Returns the state with its observations of the group `policy` and further groups.

        Call it once a step, as sensors have memory.
        """
        robots = self.read(state.data, state.active)
        noise = self.params.randomization.observation_noise
        seen = {}
        there = self.there(state) if self.varies else {}
        for number, (name, layout) in enumerate(self.layouts.items()):
            if name not in ("policy", *groups):
                continue
            if name == ONBOARD:
                key = jax.random.fold_in(state.key, keys.SENSING)
                blocks, senses = self.suite.observe(self.snapshot(state, robots), state.senses, key)
                state = dataclasses.replace(state, senses=senses)
            else:
                blocks = self.observe_group(name.removeprefix(EXACT), state, robots)
            if not self.robots.alike:
                blocks = {**blocks, "bodies": observe_bodies(self.robots, self.teams)}
            obs = layout.pack(blocks, self.num_agents)
            if noise and not name.startswith(EXACT):
                key = jax.random.fold_in(state.key, keys.NOISE + number)
                obs = obs + noise * layout.continuous * jax.random.normal(key, obs.shape)
            if name in self.reading_errors:
                key = jax.random.fold_in(state.key, keys.READINGS + number)
                errors = self.reading_errors[name]
                obs, memory = errors.apply(obs, state.readings[name], key, state.randomized.errors)
                state = dataclasses.replace(state, readings={**state.readings, name: memory})
            obs = hide(layout, obs, there) if there else obs
            seen[name] = jnp.where(self.observed(state)[:, None], finite(obs), 0.0)
        privileged = finite(self.observe_privileged(state, robots))
        return dataclasses.replace(state, groups=seen, privileged_obs=privileged)

    def judge(
        self, before: Moment[S], after: Moment[S], bad_action: jax.Array | bool = False
    ) -> State[S]:
        """Returns the state after a step with its own fields, reward, metrics and ending."""
        state, robot_state = after
        diverged = bad_action | self._diverged(state.data)
        touched = robot_state.trunk_force[: self.num_agents] > self.params.collision_force
        collision = jnp.any(robot_state.count(touched))
        task = alike("step_task", self.step_task(before, after), state.task)
        state = dataclasses.replace(state, task=task)
        reward, logged = self.score(before, Moment(state, robot_state), collision)
        fall = jnp.any(self.fallen(robot_state)) & self.falls_end
        crash = collision & self.params.end_on_collision
        failed = diverged | fall | crash
        decided = check_shape("ending", self.ending(state, robot_state), (), dtype=bool)
        terminated = failed | decided
        late = state.step >= self.max_steps

        def clean(x, instead=0.0):
            return jnp.where(diverged, instead, jnp.asarray(x, jnp.float32))

        outcome = self.result(state, robot_state, failed)
        draw = None if outcome.draw is None else clean(outcome.draw, 1.0)
        causes = jnp.stack([diverged, fall, crash, decided, late])
        first = (causes & (jnp.cumsum(causes) == 1)).astype(jnp.float32)
        ending = dict(zip(ENDINGS, first, strict=True))
        outcome = dataclasses.replace(jax.tree.map(clean, outcome), draw=draw, ending=ending)
        logged = {**logged, "collision": collision}
        metrics = {name: clean(value) for name, value in logged.items()}
        metrics["diverged"] = diverged.astype(jnp.float32)
        return dataclasses.replace(
            state,
            reward=clean(reward),
            terminated=terminated,
            truncated=~terminated & late,
            outcome=outcome,
            metrics=metrics,
        )

    def observe_privileged(self, state: State[S], robot_state: RobotState) -> jax.Array:
        """Returns the privileged observation (P,), in the blocks of `privileged_layout`."""
        return self.privileged.observe(robot_state, state, self.controller.clock(state.control))

    def result(self, state: State[S], robot_state: RobotState, failed: jax.Array) -> Outcome:
        """Returns the outcome of an episode that ends in this step, without the cause.

        The arguments are those of `outcome`.
        """
        values = results("outcome", self.outcome(state, robot_state, failed))
        values = {name: value[None] for name, value in values.items()}
        return Outcome(success=values.pop("success"), further=values)

    def read(self, data: mjx.Data, active: jax.Array | None = None) -> RobotState:
        """Returns the state of all robots.

        `active` (A,) says which agents take part, by default all.
        """
        return read_robots(self.index, data.qpos, data.qvel, data.sensordata, active)

    def object_pose(self, data: mjx.Data, name: str) -> jax.Array:
        """Returns position, m, and quaternion, wxyz, of an object (7,) in the environment frame.

        InputError for an unknown name.
        """
        check("name", name, Literal[tuple(self.objects)])
        found = poses(self.compiled.model, data, [self.objects[name].body])
        return jnp.concatenate(found, axis=-1)[0]

    def fallen(self, robot_state: RobotState) -> jax.Array:
        """Returns which active robots exceed the roll, pitch or height limits (R,) bool."""
        params = self.params
        height = robot_state.position_w[:, 2]
        roll = jnp.abs(robot_state.euler[:, 0])
        pitch = jnp.abs(robot_state.euler[:, 1])
        out = (roll > params.max_roll) | (pitch > params.max_pitch)
        out |= (height < self.by_height(params.min_height)) | (height > params.max_height)
        return out & robot_state.active

    def by_height(self, height: Any) -> Any:
        """Returns each robot's height, m, from one that suits the largest robot, (R,) or ().

        What is above the ground is in proportion to how high a robot stands.
        """
        stands = np.array([robot.proportions.height for robot in self.robots])
        if np.ptp(stands) == 0.0:
            return height
        ground = self.params.ground
        own = ground + (height - ground) * (stands / stands.max()).astype(np.float32)
        return jnp.where(jnp.asarray(height) > ground, own, height)

    def _ctrl(self, targets: jax.Array) -> jax.Array:
        """Returns the engine's control (nu,) from targets of all robots (R, J)."""
        return scatter(np.zeros(self.compiled.model.nu), self.index.actuator, targets)

    def _sample_robots(self, pose: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        params = self.params
        model = self.compiled.model
        index = self.index
        joint_key, velocity_key = jax.random.split(key)
        low, high = params.spawn_joint_scale
        factor = jax.random.uniform(joint_key, index.joint_qpos.shape, minval=low, maxval=high)
        table = self.robots.table
        joints = table("default_joints") * factor
        joints = jnp.clip(joints, table("joint_lower"), table("joint_upper"))
        speed = params.spawn_velocity
        velocity = jax.random.uniform(
            velocity_key, index.base_qvel.shape, minval=-speed, maxval=speed
        )
        level = jnp.zeros(len(pose))
        turn = euler_to_quaternion(jnp.stack([level, level, pose[:, 3]], axis=-1))
        height = self.by_height(pose[:, 2])
        robots = np.concatenate([index.base_qpos, index.joint_qpos], axis=-1)
        own = jnp.concatenate([pose[:, :2], height[:, None], turn, joints], axis=-1)
        qpos = scatter(model.qpos0, robots, own)
        return qpos, scatter(np.zeros(model.nv), index.base_qvel, velocity)

    def _sample_frozen_steps(
        self, key: jax.Array, assistance: jax.Array, active: jax.Array
    ) -> jax.Array:
        agent_key, time_key = jax.random.split(key)
        steps = assistance * self.params.frozen_time / self.dt * jax.random.uniform(time_key, ())
        number = 1 + jax.random.randint(agent_key, (), 0, jnp.sum(active))
        chosen = active & (jnp.cumsum(active) == number)
        return jnp.where(chosen, steps, 0.0).astype(jnp.int32)

    def check_state(self, state: State[S]) -> None:
        """Raises an InputError for anything but a state of one environment of this task."""
        names = {f"reward/{field.name}" for field in dataclasses.fields(self.weights)}
        size = self.compiled.model.nq
        if isinstance(state, State):
            shape = jnp.shape(state.data.qpos)
            if shape == (size,) and names <= set(state.metrics):
                return
            found = f"one with qpos {shape} and the metrics {', '.join(sorted(state.metrics))}"
        else:
            found = f"of type {type(state).__name__}"
        raise InputError(
            f"state: {found} is not allowed; it must be one of {self.name}, with qpos ({size},), "
            "such as `reset` returns; jax.vmap or VectorEnv steps a batch"
        )

    def _diverged(self, data: mjx.Data) -> jax.Array:
        slow = jnp.abs(data.qvel) < 1e3  # false for NaN, and so is `near`
        near = jnp.abs(data.qpos[self.index.base_qpos[:, :3]]) < 1e3
        return ~(jnp.all(jnp.isfinite(data.qpos)) & jnp.all(slow) & jnp.all(near))
