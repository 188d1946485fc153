"""The environment core: one world of robots as pure `reset` and `step` functions, batched by `jax.vmap`.

A task is a subclass in a file of its own that says, in this order: its parameters, its scene, what it draws at
reset, its observation, its reward terms and its ending. Everything that tasks share is here: spawning, control,
physics, randomisation, falls, collisions, the time limit and the guard against diverged physics.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.core import Tracer
from mujoco import mjx

from mqe_jax import robots, walk_policy
from mqe_jax.control import Controller, ControlState, check_mode, load_actuator_network
from mqe_jax.envs.observation import ObservationLayout
from mqe_jax.envs.params import TaskParams
from mqe_jax.envs.privileged import PrivilegedObservation
from mqe_jax.envs.randomization import Randomizer, World
from mqe_jax.envs.reward import weigh
from mqe_jax.physics import Physics
from mqe_jax.robots import go1
from mqe_jax.robots.index import RobotState
from mqe_jax.rotation import euler_to_quaternion
from mqe_jax.scene import Scene, build_model, compile_scene


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class State:
    """State of one world with A agents, R robots and G gates; a batch has leading axes.

    Attributes:
        data: physics state.
        obs: what the agents see now (A, O); after an auto-reset, of the fresh world.
        privileged_obs: everything in the simulator, for critics and distillation (P,).
        final_obs: what the agents saw at the end of the last step (A, O): differs from `obs` after an auto-reset.
        final_privileged_obs: likewise (P,).
        reward: (A,).
        terminated: () bool; an episode ended by its rules.
        truncated: () bool; it ended by the time limit.
        metrics: `reward/<name>`, `average_step_reward`, `success`, `diverged` and the task's own, () each.
        step: environment steps since the reset () int32.
        gates: centres of the gates (G, 2), m, environment frame.
        control: what control remembers.
        world: randomised physics.
        task: the task's own fields.
        aid: how much the world helps learning () in [0, 1]; 0 is the task itself, trainers may start higher.
        hold: environment steps for which each agent's action counts as zero (A,); zeros without aid.
        key: random key of the world.
    """

    data: mjx.Data
    obs: jax.Array
    privileged_obs: jax.Array
    final_obs: jax.Array
    final_privileged_obs: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    metrics: dict[str, jax.Array]
    step: jax.Array
    anchors: jax.Array
    control: ControlState
    world: World
    task: Any
    aid: jax.Array
    hold: jax.Array
    key: jax.Array


class QuadrupedEnv:
    """Base of all tasks; functions of one world, to be batched by `jax.vmap` and compiled by `jax.jit`.

    Attributes:
        params: the task's parameters.
        impl: physics engine: 'jax', 'warp' or 'c'.
        control: 'command', 'position' or 'torque'.
        num_agents: A.
        teams: agents of each team.
        dt: environment step, s.
    """

    name: ClassVar[str] = ""
    title: ClassVar[str] = ""
    Params: ClassVar[type[TaskParams]] = TaskParams
    metrics_if_diverged: ClassVar[Mapping[str, float]] = {}  # metrics of a diverged world that are not 0
    variable_num_agents: ClassVar[bool] = False  # whether `num_agents` may be another than the task's own
    dt = walk_policy.STEP

    def __init__(
        self,
        params: TaskParams | None = None,
        *,
        impl: str = "auto",
        control: str = "command",
        num_envs: int = 4096,
    ) -> None:
        self.params: Any = self.Params() if params is None else params
        own = self.Params().num_agents
        if self.params.num_agents != own and not self.variable_num_agents:
            raise ValueError(f"num_agents: {self.params.num_agents}; {self.name} is for {own} robots")
        self.control = check_mode(control)
        if num_envs < 1:
            raise ValueError(f"num_envs: {num_envs} must be at least 1")
        self.num_agents = self.params.num_agents
        scene = self.scene()
        network = self.params.actuator_network if control != "torque" else None
        # Robots that are no agents follow joint targets, whatever the agents do.
        torque_robots = scene.num_robots if network else self.num_agents if control == "torque" else 0
        self._scene = dataclasses.replace(
            scene, friction=self.params.friction, solver_iterations=self.params.solver_iterations,
            torque_robots=torque_robots, max_contacts=self.params.contacts_per_robot * scene.num_robots,
        )  # fmt: skip
        self.compiled = compile_scene(self._scene)
        self.index, self.objects = self.compiled.index, self.compiled.objects
        self.physics = Physics(
            self.compiled.model, impl=impl, num_envs=num_envs, contacts_per_env=self._scene.max_contacts,
            max_constraints_per_env=self.params.constraints_per_robot * scene.num_robots,
        )  # fmt: skip
        self.impl = self.physics.impl
        self.randomizer = Randomizer(self.params.randomization, self.compiled.model, self.index, self.params.friction)
        self.privileged = PrivilegedObservation(self.compiled.model, self.index, len(self.compiled.layout.anchors))
        walks = control == "command" or self._scene.num_robots > self.num_agents
        self.controller = Controller(
            mode=control, physics=self.physics, index=self.index, num_agents=self.num_agents,
            walk_params=walk_policy.load_params(self.params.walk_policy) if walks else None,
            actuator_params=load_actuator_network(network) if network else None, commands=self.params.commands,
            default_commands=walk_policy.default_commands(self.params.gait), lag=self.params.randomization.action_lag,
        )  # fmt: skip

    # -- what a task says ---------------------------------------------------------------------------------------

    def scene(self) -> Scene:
        """Says what is in the world."""
        raise TypeError(f"{type(self).__name__}: scene() is not defined")

    def spawn_poses(self) -> Sequence[tuple[float, float, float]]:
        """Says where the robots start, x, y, yaw of each, m and rad; where the track's blocks say if not here."""
        return self.compiled.layout.spawn

    def spawn(self, key: jax.Array) -> jax.Array:
        """Draws poses x, y, z, yaw (R, 4), m and rad, of all robots."""
        params = self.params
        pose = np.array([(x, y, params.spawn_height, yaw) for x, y, yaw in self.spawn_poses()], np.float32)
        noise = jax.random.uniform(key, (len(pose), 2), minval=-params.spawn_noise, maxval=params.spawn_noise)
        return jnp.asarray(pose).at[:, :2].add(noise)

    def reset_objects(self, key: jax.Array, qpos: jax.Array, qvel: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Draws where movable objects start, into qpos (nq,) and qvel (nv,)."""
        return qpos, qvel

    def reset_task(self, key: jax.Array, robot_state: RobotState, data: mjx.Data, anchors: jax.Array) -> Any:
        """Returns the task's own fields of a fresh world."""
        return None

    def npc_commands(self, state: State, robot_state: RobotState) -> jax.Array | None:
        """Returns walk commands (R - A, 15) of the robots that are no agents."""
        return None

    def unmirror_action(self, action: jax.Array) -> jax.Array:
        """Turns actions (A, action_size), each in its agent's own frame, into those that the robots carry out."""
        return action

    def step_npcs(self, data: mjx.Data, robot_state: RobotState, key: jax.Array) -> mjx.Data:
        """Moves what has a will of its own: returns the world with its velocities for the next step."""
        return data

    @property
    def observation_layout(self) -> ObservationLayout:
        """The blocks of an agent's observation, in order."""
        raise TypeError(f"{type(self).__name__}: observation_layout is not defined")

    def observe(self, state: State, robot_state: RobotState) -> dict[str, jax.Array]:
        """Returns the observation's blocks by name (A, width)."""
        raise TypeError(f"{type(self).__name__}: observe() is not defined")

    def rewards(self, state: State, robot_state: RobotState, collision: jax.Array) -> tuple[dict[str, jax.Array], Any]:
        """Returns the reward terms, () or (A,), and the task's fields after the step.

        Args:
            state: the state before the step, with the physics after it.
            robot_state: of the robots after the step.
            collision: whether any trunk touches anything () bool.
        """
        raise TypeError(f"{type(self).__name__}: rewards() is not defined")

    def ending(self, state: State, robot_state: RobotState) -> jax.Array:
        """Returns whether the task's own rules end the episode () bool."""
        return jnp.zeros((), bool)

    def outcome(self, state: State, robot_state: RobotState, failed: jax.Array) -> dict[str, jax.Array]:
        """Returns `success` () and further `success/...` measures, which count when the episode ends.

        Args:
            state: after the step.
            robot_state: of the robots.
            failed: whether the step ended by a fall, a collision or a divergence () bool.
        """
        return {"success": jnp.zeros(())}

    # -- what users call ----------------------------------------------------------------------------------------

    @property
    def teams(self) -> tuple[tuple[int, ...], ...]:
        """Agents of each team; one team where all work together."""
        return (tuple(range(self.num_agents)),)

    @property
    def action_size(self) -> int:
        """Length of an agent's action."""
        return self.controller.action_size

    @property
    def observation_size(self) -> int:
        """Length of an agent's observation."""
        return self.observation_layout.size

    @property
    def privileged_layout(self) -> ObservationLayout:
        """The blocks of the privileged observation, in order; raw units."""
        return self.privileged.layout

    @property
    def privileged_observation_size(self) -> int:
        """Length of the privileged observation."""
        return self.privileged_layout.size

    @property
    def action_space(self) -> gymnasium.spaces.Box:
        """All agents' actions (A, action_size) in [-1, 1]."""
        return gymnasium.spaces.Box(-1.0, 1.0, (self.num_agents, self.action_size), np.float32)

    @property
    def observation_space(self) -> gymnasium.spaces.Box:
        """All agents' observations (A, O)."""
        return gymnasium.spaces.Box(-np.inf, np.inf, (self.num_agents, self.observation_size), np.float32)

    @functools.cached_property
    def mj_model(self) -> mujoco.MjModel:
        """The model with everything to look at; its qpos and mocap bodies are those of the physics."""
        return build_model(self._scene, visual=True)[0]

    @property
    def max_steps(self) -> int:
        """Environment steps until the time limit."""
        return round(self.params.episode_length / self.dt)

    def with_num_envs(self, num_envs: int) -> QuadrupedEnv:
        """Returns the environment with buffers for `num_envs` worlds, which only Warp's contacts need."""
        if self.impl != "warp" or self.physics.num_envs >= num_envs:
            return self
        return type(self)(self.params, impl=self.impl, control=self.control, num_envs=num_envs)

    def reset(self, key: jax.Array, aid: jax.Array | float = 0.0) -> State:
        """Returns a freshly drawn world; needs no forward pass of the physics.

        Args:
            key: random key.
            aid: how much the world helps learning, in [0, 1]; 0 is the task itself.
        """
        keys = jax.random.split(key, 9)
        next_key, anchor_key, spawn_key, body_key, object_key, world_key, task_key, noise_key, aid_key = keys
        aid = jnp.asarray(aid, jnp.float32)
        gates = self._sample_anchors(anchor_key)
        qpos, qvel = self._sample_robots(spawn_key, body_key)
        qpos, qvel = self.reset_objects(object_key, qpos, qvel)
        ctrl = jnp.zeros(self.compiled.model.nu).at[self.index.actuator].set(self.controller.neutral)
        data = self.physics.init(qpos, qvel, self._mocap(gates), ctrl)
        robot_state = self.read(data)
        no = jnp.zeros((), bool)
        empty = jnp.zeros((0,))
        state = State(
            data=data, obs=empty, privileged_obs=empty, final_obs=empty, final_privileged_obs=empty,
            reward=jnp.zeros(self.num_agents), terminated=no, truncated=no, metrics={},
            step=jnp.zeros((), jnp.int32), anchors=gates, control=self.controller.reset(),
            world=self.randomizer.draw(world_key), task=self.reset_task(task_key, robot_state, data, gates), aid=aid,
            frozen_steps=self._sample_frozen_steps(aid_key, aid), key=next_key,
        )  # fmt: skip
        terms, _ = self.rewards(state, robot_state, no)
        _, logged = weigh(terms, self.params.rewards, self.num_agents)
        metrics = {**logged, **self.outcome(state, robot_state, no), "collision": 0.0, "diverged": 0.0}
        state = dataclasses.replace(state, metrics={name: jnp.zeros(()) for name in metrics})
        return self._observed(state, robot_state, noise_key)

    def step(self, state: State, action: jax.Array) -> State:
        """Advances one world by one environment step.

        Args:
            state: of the world; one that has ended goes on unless it is reset (see `VectorEnv`).
            action: (A, action_size), floating point, in [-1, 1] (clipped to it).

        Raises:
            ValueError: if the action has another shape or dtype, or is not finite (where that can be seen: in
                compiled code a world with such an action ends as diverged).
        """
        action = self._checked(action)
        bad_action = ~jnp.all(jnp.isfinite(action))
        action = jnp.clip(jnp.nan_to_num(action), -1.0, 1.0).astype(jnp.float32)
        action = self.unmirror_action(jnp.where((state.step < state.frozen_steps)[:, None], 0.0, action))
        key, push_key, noise_key, npc_key = jax.random.split(state.key, 4)

        before = self.read(state.data)
        target, control = self.controller.targets(
            state.control, action, before.projected_gravity, before.joint_position, before.joint_velocity,
            self.npc_commands(state, before),
        )  # fmt: skip
        data = self.step_npcs(self.randomizer.push(state.data, push_key, self.dt), before, npc_key)
        data, control = self.controller.apply(
            control,
            data,
            target,
            state.world.action_lag,
            self.randomizer.fields(state.world),
            self.external_forces(state),
        )
        robot_state = self.read(data)
        state = dataclasses.replace(state, data=data, control=control, step=state.step + 1, key=key)

        diverged = bad_action | self._diverged(data)
        collision = jnp.any(robot_state.trunk_force[: self.num_agents] > self.params.collision_force)
        terms, task = self.rewards(state, robot_state, collision)
        reward, logged = weigh(terms, self.params.rewards, self.num_agents)
        state = dataclasses.replace(state, task=task)
        failed = jnp.any(self.fallen(robot_state)) | diverged | (collision & self.params.end_on_collision)
        terminated = failed | self.ending(state, robot_state)
        metrics = {**logged, **self.outcome(state, robot_state, failed), "collision": collision}
        clean = lambda x, instead=0.0: jnp.where(diverged, instead, jnp.asarray(x, jnp.float32))  # noqa: E731
        metrics = {name: clean(value, self.metrics_if_diverged.get(name, 0.0)) for name, value in metrics.items()}
        metrics["diverged"] = diverged.astype(jnp.float32)
        state = dataclasses.replace(
            state, reward=clean(reward), terminated=terminated, metrics=metrics,
            truncated=~terminated & (state.step >= self.max_steps),
        )  # fmt: skip
        return self._observed(state, robot_state, noise_key)

    def read(self, data: mjx.Data) -> RobotState:
        """Reads all robots of one world."""
        return robots.read_robots(self.index, data.qpos, data.qvel, data.sensordata)

    def object_pose(self, data: mjx.Data, name: str) -> jax.Array:
        """Returns the coordinates of an object by name, as its class gives them."""
        return data.qpos[self.objects[name].qpos]

    def fallen(self, robot_state: RobotState) -> jax.Array:
        """Returns which robots lie on their side or back, or are too low or too high (R,) bool."""
        params = self.params
        roll, pitch = jnp.abs(robot_state.euler[:, 0]), jnp.abs(robot_state.euler[:, 1])
        height = robot_state.position_w[:, 2]
        out = (roll > params.max_roll) | (pitch > params.max_pitch)
        return out | (height < params.min_height) | (height > params.max_height)

    def external_forces(self, state: State) -> jax.Array | None:
        """Returns forces and torques on all bodies (nbody, 6), N and N m, world frame, or None."""
        return None

    # -- the common parts of reset and step ---------------------------------------------------------------------

    def _sample_anchors(self, key: jax.Array) -> jax.Array:
        mean, spread = self.compiled.anchor_mean, self.compiled.anchor_spread
        return jnp.asarray(mean, jnp.float32) + spread * jax.random.uniform(key, mean.shape, minval=-1.0)

    def _mocap(self, anchors: jax.Array) -> jax.Array:
        model = self.compiled.model
        if not model.nmocap:
            return jnp.zeros((0, 3))
        return self.compiled.wall_positions(gates)

    def _sample_robots(self, spawn_key: jax.Array, body_key: jax.Array) -> tuple[jax.Array, jax.Array]:
        params, model, index = self.params, self.compiled.model, self.index
        pose = self.spawn(spawn_key)
        joint_key, velocity_key = jax.random.split(body_key)
        low, high = params.spawn_joint_scale
        joints = go1.DEFAULT_JOINTS * jax.random.uniform(joint_key, index.joint_qpos.shape, minval=low, maxval=high)
        joints = jnp.clip(joints, go1.JOINT_LOWER, go1.JOINT_UPPER)
        speed = params.spawn_velocity
        velocity = jax.random.uniform(velocity_key, index.base_qvel.shape, minval=-speed, maxval=speed)
        level = jnp.zeros(len(pose))
        turn = euler_to_quaternion(jnp.stack([level, level, pose[:, 3]], axis=-1))
        qpos = jnp.asarray(model.qpos0, jnp.float32).at[index.joint_qpos].set(joints)
        qpos = qpos.at[index.base_qpos].set(jnp.concatenate([pose[:, :3], turn], axis=-1))
        return qpos, jnp.zeros(model.nv).at[index.base_qvel].set(velocity)

    def _sample_frozen_steps(self, key: jax.Array, aid: jax.Array) -> jax.Array:
        who_key, time_key = jax.random.split(key)
        steps = aid * self.params.frozen_time / self.dt * jax.random.uniform(time_key, ())
        who = jax.random.randint(who_key, (), 0, self.num_agents)
        return jnp.where(jnp.arange(self.num_agents) == who, steps, 0.0).astype(jnp.int32)

    def _checked(self, action: jax.Array) -> jax.Array:
        action = jnp.asarray(action)
        shape = (self.num_agents, self.action_size)
        if action.shape != shape:
            raise ValueError(f"action: shape {action.shape}; expected {shape} (agents, action size)")
        if not jnp.issubdtype(action.dtype, jnp.floating):
            raise ValueError(f"action: dtype {action.dtype}; expected a floating-point type")
        if not isinstance(action, Tracer) and not bool(jnp.all(jnp.isfinite(action))):
            raise ValueError("action: holds NaN or infinite numbers; expected numbers in [-1, 1]")
        return action

    def _diverged(self, data: mjx.Data) -> jax.Array:
        finite = jnp.all(jnp.isfinite(data.qpos)) & jnp.all(jnp.isfinite(data.qvel))
        position = data.qpos[self.index.base_qpos[:, :3]]
        return ~(finite & jnp.all(jnp.abs(data.qvel) < 1e3) & jnp.all(jnp.abs(position) < 1e3))

    def _observed(self, state: State, robot_state: RobotState, key: jax.Array) -> State:
        obs = self.observation_layout.pack(self.observe(state, robot_state))
        noise = self.params.randomization.observation_noise
        if noise:
            obs = obs + noise * jax.random.normal(key, obs.shape)
        privileged = self.privileged.observe(robot_state, state.data, state.anchors)
        obs, privileged = (jnp.clip(jnp.nan_to_num(x), -1e4, 1e4) for x in (obs, privileged))
        return dataclasses.replace(
            state, obs=obs, privileged_obs=privileged, final_obs=obs, final_privileged_obs=privileged
        )
