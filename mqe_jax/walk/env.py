"""Training and evaluation environment of skills that walk: one robot that tracks commands.

Slopes are rotations of gravity: a robot on an infinite slope of angle t behaves, in the frame of the slope, as one on
flat ground under gravity rotated by t. Each environment thus has its own slope without its own geometry. All positions
and velocities here are in the slope's frame.

Randomisation and rewards (`mqe_jax.walk.rewards`) follow walk-these-ways (Margolis and Agrawal, arXiv 2212.03238).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax import engines, walk_policy
from mqe_jax.actuators import Actuators
from mqe_jax.envs.randomization import Randomization, RandomizedParams, Randomizer
from mqe_jax.envs.state import with_final
from mqe_jax.precision import single
from mqe_jax.robots.index import Proprioception, RobotState, foot_positions, read_robots
from mqe_jax.robots.robot import NUM_JOINTS, Robot
from mqe_jax.rotation import euler_to_quaternion, quaternion_to_euler, rotate, rotate_inverse
from mqe_jax.scene import Scene, compile_scene
from mqe_jax.terrain import Plane, Track
from mqe_jax.train.types import Outcome
from mqe_jax.walk import trainees
from mqe_jax.walk.rewards import RewardInputs, WalkRewards, combine, reward_terms
from mqe_jax.walk.task import RANDOMIZATION, EpisodeSpec, WalkState, WalkTask, sample_spec
from mqe_jax.walk_policy import WalkMemory

if TYPE_CHECKING:
    from mujoco import mjx

GRAVITY = 9.81  # m/s^2
DT = walk_policy.STEP
_NOISE = 7919  # folded into a state's key for the noise of its observations
MOTOR_OFFSET = 0.02  # greatest offset of a joint's target under randomisation, rad
SHOVED = np.array([0.25, 0.08, 0.06])  # half-lengths of the box in the trunk's frame on which shoves act, m


class WalkEnv:
    """One robot that tracks commands on a slope under external forces; batch with `VectorEnv` or `jax.vmap`."""

    num_agents = 1
    teams = ((0,),)
    action_size = NUM_JOINTS
    state_type = WalkState

    def __init__(
        self,
        robot: Robot,
        task: WalkTask | None = None,
        *,
        skill: str = "walk",
        impl: str = "auto",
        num_envs: int = 4096,
    ) -> None:
        self.name = skill
        self.robot = robot
        self.task = task or WalkTask()
        self.trainee = trainees.make(skill, robot)
        self.observation_size = self.trainee.observation_size
        scene = Scene(
            Track(blocks=(Plane(4.0),), walled=False, num_robots=1),
            num_robots=1,
            robot=robot,
            foot_sensors=True,
            solver_iterations=self.task.solver_iterations,
        )
        self.compiled = compile_scene(scene)
        self.skill = self.trainee.skill
        self.physics = engines.make(
            self.compiled.model,
            motors=self.compiled.motors,
            impl=impl,
            num_envs=num_envs,
            contacts_per_env=16,
            max_constraints_per_env=80,
        )
        self.skill.check_period(scene.timestep, self.physics.num_substeps)
        self.index = self.compiled.index
        self.actuators = Actuators(self.physics, self.index)
        self._mass = np.asarray(self.compiled.model.body_mass)
        randomization = Randomization()
        if self.task.randomize:
            randomization = dataclasses.replace(RANDOMIZATION, action_lag=self.task.action_lag)
        self._randomizer = Randomizer(randomization, self.compiled.model, self.index, 1.0)

    def __repr__(self) -> str:
        return f"<{self.name}: {self.robot.name}, engine {self.physics.impl}>"

    @property
    def max_steps(self) -> int:
        """Steps until the time limit."""
        return round(self.task.episode_length / DT)

    @functools.cached_property
    def privileged_observation_size(self) -> int:
        """Length P of the critic's observation."""
        return jax.eval_shape(self.reset, jax.random.PRNGKey(0)).privileged_obs.shape[0]

    def with_num_envs(self, num_envs: int) -> WalkEnv:
        """Returns an environment whose Warp buffers are sized for `num_envs` environments."""
        if self.physics.holds(num_envs):
            return self
        return WalkEnv(self.robot, self.task, skill=self.skill.name, impl=self.physics.impl, num_envs=num_envs)

    # -- reset and step -----------------------------------------------------------------------------------------

    @single
    def reset(self, key: jax.Array, assistance: jax.Array | float = 0.0, spec: EpisodeSpec | None = None) -> WalkState:
        """Returns the initial state of an episode; samples a spec if none is given."""
        return with_final(self.observed(self.begin(key, assistance, spec)))

    def begin(self, key: jax.Array, assistance: jax.Array | float = 0.0, spec: EpisodeSpec | None = None) -> WalkState:
        """Returns the state of `reset` without observations."""
        keys = jax.random.split(key, 9)  # as those of `QuadrupedEnv.begin`
        next_key, spawn_key, body_key, random_key, spec_key = (keys[i] for i in (0, 2, 3, 5, 6))
        assistance = jnp.asarray(assistance, jnp.float32)
        if spec is None:
            spec = sample_spec(spec_key, self.task, self.trainee, assistance)
        offset = jnp.zeros(NUM_JOINTS)
        if self.task.randomize:
            offset = jax.random.uniform(
                jax.random.fold_in(random_key, 6), (NUM_JOINTS,), minval=-MOTOR_OFFSET, maxval=MOTOR_OFFSET
            )
        yaw_key, height_key = jax.random.split(spawn_key)
        joint_key, velocity_key = jax.random.split(body_key)
        model, index = self.compiled.model, self.index
        yaw = jax.random.uniform(yaw_key, (), minval=-jnp.pi, maxval=jnp.pi)
        # Fixed specs (evaluation) start along +x, so that slope and heading have a known relation.
        yaw = jnp.where(self.task.command_period > 0, yaw, 0.0)
        joints = self.robot.default_joints * jax.random.uniform(joint_key, (NUM_JOINTS,), minval=0.7, maxval=1.3)
        stand = self.robot.stand_height
        height = jax.random.uniform(height_key, (), minval=stand + 0.03, maxval=stand + 0.12)
        quaternion = euler_to_quaternion(jnp.stack([jnp.zeros(()), jnp.zeros(()), yaw]))
        qpos = jnp.zeros(model.nq).at[index.joint_qpos[0]].set(joints)
        qpos = qpos.at[index.base_qpos[0]].set(jnp.concatenate([jnp.stack([0.0, 0.0, height]), quaternion]))
        speed = jax.random.uniform(velocity_key, (6,), minval=-0.5, maxval=0.5)
        qvel = jnp.zeros(model.nv).at[index.base_qvel[0]].set(speed)
        ctrl = self.actuators.control(jnp.asarray(self.robot.default_joints))
        data = self.physics.init(qpos, qvel, jnp.zeros((0, 3)), ctrl)
        zero, zeros = jnp.zeros(()), jnp.zeros(NUM_JOINTS)
        memory = WalkMemory(jnp.zeros((0, walk_policy.OBSERVATION_SIZE)), zeros, zeros, zero)
        return WalkState(
            data=data,
            obs=zero,
            privileged_obs=zero,
            final_obs=zero,
            final_privileged_obs=zero,
            reward=jnp.zeros(1),
            terminated=jnp.zeros((), bool),
            truncated=jnp.zeros((), bool),
            outcome=Outcome(),
            metrics=_zero_metrics(self.task.rewards),
            spec=spec,
            slope=spec.slope,
            force=spec.force,
            shove=jnp.zeros(6),
            shove_steps=jnp.zeros((), jnp.int32),
            random=self._randomizer.sample(random_key),
            motor_offset=offset,
            memory=memory,
            mean_error=jnp.zeros(3),
            step=jnp.zeros((), jnp.int32),
            episode_steps=jnp.zeros((), jnp.int32),
            assistance=assistance,
            key=next_key,
        )

    @single
    def step(self, state: WalkState, action: jax.Array) -> WalkState:
        """Advances by one policy step with an action (1, 12)."""
        return with_final(self.observed(self.advance(state, action)))

    def advance(self, state: WalkState, action: jax.Array) -> WalkState:
        """Returns the state of `step` with the observations from before it."""
        task, index = self.task, self.index
        key, direction_key, time_key, size_key, spec_key, _ = jax.random.split(state.key, 6)
        action = jnp.clip(action[0], -walk_policy.ACTION_CLIP, walk_policy.ACTION_CLIP)
        target = self.robot.joint_targets(action)
        previous_target = self.robot.joint_targets(state.memory.action)
        earlier_target = self.robot.joint_targets(state.memory.previous_action)

        # Slope and force reach the spec's values within about half a second.
        slope = state.slope + jnp.clip(state.spec.slope - state.slope, -0.02, 0.02)
        force = state.force + jnp.clip(state.spec.force - state.force, -2.0, 2.0)
        if task.command_period > 0:
            pushed = jax.random.bernoulli(time_key, DT / task.push_period)
            size = state.spec.push * jax.random.uniform(size_key, ())
        else:
            pushed = (state.episode_steps + 1) % round(task.push_period / DT) == 0
            size = state.spec.push
        angle = jax.random.uniform(direction_key, (), maxval=2 * jnp.pi)
        push = jnp.where(pushed, size, 0.0) * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        data = state.data.replace(qvel=state.data.qvel.at[index.base_qvel[0, :2]].add(push))

        shove, shove_steps = self._shoved(state, jax.random.fold_in(time_key, 1))
        fields = self._randomizer.fields(state.random)
        forces = self._forces(data, state.random, slope, force, shove)
        applied = jnp.where(state.random.action_lag > 0, previous_target, target)
        data, _, _ = self.actuators.step(data, (), applied + state.motor_offset, fields, forces)
        robot_state = self.read(data)
        commands = state.spec.commands
        velocity, yaw_rate = heading_velocity(robot_state)
        error = jnp.stack([velocity[0] - commands[0], velocity[1] - commands[1], yaw_rate - commands[2]])
        mean_error = state.mean_error + 0.04 * (error - state.mean_error)
        gait = walk_policy.advance_gait(state.memory.gait, commands)
        memory = WalkMemory(state.memory.history, action, state.memory.action, gait)

        inputs = RewardInputs(
            robot=self.robot,
            robot_state=robot_state,
            commands=commands,
            error=error,
            mean_error=mean_error,
            phases=self.trainee.foot_phases(gait, commands),
            target=target,
            previous_target=previous_target,
            earlier_target=earlier_target,
            applied=applied,
            foot_force=self.foot_force(data),
            strength=state.random.motor_strength[0],
            tolerance=task.tolerance,
        )
        terms = reward_terms(inputs)
        reward, weighted = combine(terms, task.rewards)

        up = rotate_inverse(robot_state.quaternion, jnp.array([0.0, 0.0, 1.0]))[0]
        low = robot_state.position_w[0, 2] < self.robot.walk.min_trunk_height
        finite = jnp.all(jnp.isfinite(data.qpos)) & jnp.all(jnp.isfinite(data.qvel))
        fallen = (robot_state.trunk_force[0] > 1.0) | (up[2] < 0.5) | low | ~finite
        step, episode_steps = state.step + 1, state.episode_steps + 1
        metrics = {f"reward/{name}": value for name, value in weighted.items()} | {
            "error_vx": jnp.square(error[0]),
            "error_vy": jnp.square(error[1]),
            "error_yaw": jnp.square(error[2]),
            "diverged": (~finite).astype(jnp.float32),
        }
        spec = state.spec
        if task.command_period > 0:
            renewed = step % round(task.command_period / DT) == 0
            fresh = sample_spec(spec_key, task, self.trainee, state.assistance)
            spec = jax.tree.map(lambda new, old: jnp.where(renewed, new, old), fresh, spec)
            mean_error = jnp.where(renewed, 0.0, mean_error)
        return dataclasses.replace(
            state,
            data=data,
            reward=jnp.where(finite, reward, 0.0)[None],
            terminated=fallen,
            truncated=~fallen & (step >= self.max_steps),
            metrics=metrics,
            spec=spec,
            slope=slope,
            force=force,
            shove=shove,
            shove_steps=shove_steps,
            memory=memory,
            mean_error=mean_error,
            step=step,
            episode_steps=episode_steps,
            key=key,
        )

    # -- robot state --------------------------------------------------------------------------------------------

    def read(self, data: mjx.Data) -> RobotState:
        """Returns the robot's state."""
        return read_robots(self.index, data.qpos, data.qvel, data.sensordata)

    def foot_force(self, data: mjx.Data) -> jax.Array:
        """Returns the strongest contact force on each foot (4,), N."""
        return jnp.linalg.norm(data.sensordata[self.index.foot_force[0]], axis=-1)

    @property
    def weight(self) -> float:
        """Weight of the robot, N."""
        return GRAVITY * float(self._mass.sum())

    def power(self, state: WalkState) -> jax.Array:
        """Returns the mechanical power of the joints (), W, each joint's as a magnitude."""
        robot = self.robot
        velocity = self.read(state.data).joint_velocity[0]
        torque = robot.kp * (robot.joint_targets(state.memory.action) - self.read(state.data).joint_position[0])
        torque = jnp.clip(torque - robot.kd * velocity, -robot.torque_limit, robot.torque_limit)
        return jnp.sum(jnp.abs(torque * velocity))

    def _shoved(self, state: WalkState, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Returns force and torque of the shove in this step (6,), and the steps until it ends ()."""
        if not self.task.shove:
            return state.shove, state.shove_steps
        when_key, angle_key, up_key, size_key, length_key, point_key = jax.random.split(key, 6)
        begins = (state.shove_steps == 0) & jax.random.bernoulli(when_key, DT / self.task.shove_period)
        angle = jax.random.uniform(angle_key, (), maxval=2 * jnp.pi)
        up = jax.random.uniform(up_key, (), minval=-0.3, maxval=0.3)
        size = state.spec.shove * jax.random.uniform(size_key, ())
        force = size * jnp.stack([jnp.cos(angle), jnp.sin(angle), up])
        point = jnp.asarray(SHOVED) * jax.random.uniform(point_key, (3,), jnp.float32, -1.0, 1.0)
        arm = rotate(state.data.qpos[self.index.base_qpos[0, 3:]], point)
        length = jax.random.uniform(length_key, (), minval=self.task.shove_length[0], maxval=self.task.shove_length[1])
        current = jnp.where(state.shove_steps > 0, state.shove, 0.0)
        shove = jnp.where(begins, jnp.concatenate([force, jnp.cross(arm, force)]), current)
        steps = jnp.where(begins, jnp.round(length / DT).astype(jnp.int32), state.shove_steps)
        return shove, jnp.maximum(steps - 1, 0)

    def _forces(
        self, data: mjx.Data, random: RandomizedParams, slope: jax.Array, force: jax.Array, shove: jax.Array
    ) -> jax.Array:
        """Returns external forces on all bodies (nbody, 6), N: the slope's change of gravity, trunk force and shove."""
        trunk = int(self.index.trunk_body[0])
        turn = gravity_w(slope) - jnp.array([0.0, 0.0, -GRAVITY])
        mass = jnp.asarray(self._mass, jnp.float32).at[trunk].add(random.payload[0])
        quaternion = data.qpos[self.index.base_qpos[0, 3:]]
        yaw = quaternion_to_euler(quaternion)[2]
        along = jnp.stack([jnp.cos(yaw), jnp.sin(yaw)])
        left = jnp.stack([-jnp.sin(yaw), jnp.cos(yaw)])
        forces = jnp.zeros((len(self._mass), 6)).at[:, :3].set(mass[:, None] * turn)
        forces = forces.at[trunk, :2].add(force[0] * along + force[1] * left)
        return forces.at[trunk].add(shove) if self.task.shove else forces

    def observed(self, state: WalkState, groups: Sequence[str] = ()) -> WalkState:
        """Returns the state with the observations that belong to it."""
        robot_state = self.read(state.data)
        quaternion = robot_state.quaternion[0]
        gravity = rotate_inverse(quaternion, gravity_w(state.slope) / GRAVITY)
        sensed = Proprioception(gravity, robot_state.joint_position[0], robot_state.joint_velocity[0])
        obs = clean = self.trainee.observe(state.memory, state.spec.commands, sensed)
        if self.task.randomize:
            keys = jax.random.split(jax.random.fold_in(state.key, _NOISE), 3)
            parts = zip(sensed, (0.02, 0.005, 0.5), keys, strict=True)
            noisy = Proprioception(*(x + size * jax.random.normal(part_key, x.shape) for x, size, part_key in parts))
            obs = self.trainee.observe(state.memory, state.spec.commands, noisy)
        velocity = rotate_inverse(quaternion, robot_state.linear_velocity_w[0])
        up = rotate_inverse(quaternion, jnp.array([0.0, 0.0, 1.0]))
        feet = foot_positions(self.robot, sensed.joint_position)
        foot_height = rotate(jnp.broadcast_to(quaternion, (4, 4)), feet)[:, 2] + robot_state.position_w[0, 2]
        phases = self.trainee.foot_phases(state.memory.gait, state.spec.commands)
        random = state.random
        privileged = jnp.concatenate(
            [
                clean,
                2.0 * velocity,
                0.25 * robot_state.angular_velocity_b[0],
                up,
                5.0 * robot_state.position_w[0, 2:] - 5.0 * self.robot.stand_height,
                10.0 * foot_height,
                jnp.cos(2 * jnp.pi * phases),
                jnp.tanh(self.foot_force(state.data) / 50.0),
                2.0 * state.mean_error,
                state.force / 20.0,
                *([state.shove * jnp.array([0.02, 0.02, 0.02, 0.1, 0.1, 0.1])] if self.task.shove else []),
                *([random.action_lag[None].astype(jnp.float32)] if self.task.action_lag else []),
                state.slope * 4.0,
                random.center_of_mass[0] * 20.0,
                (random.motor_strength - 1.0) * 5.0,
                random.friction - 1.0,
                random.payload / 2.0,
            ]
        )
        obs = jnp.nan_to_num(jnp.clip(obs, -100.0, 100.0))[None]
        privileged = jnp.nan_to_num(jnp.clip(privileged, -100.0, 100.0))
        return dataclasses.replace(state, obs=obs, privileged_obs=privileged)


def gravity_w(slope: jax.Array) -> jax.Array:
    """Returns gravity (3,), m/s^2, in the frame of ground inclined by `slope` (2,), rad, along x and y."""
    angle = jnp.linalg.norm(slope + 1e-12)
    along = slope / jnp.maximum(angle, 1e-9)
    return GRAVITY * jnp.concatenate([-jnp.sin(angle) * along, -jnp.cos(angle)[None]])


def heading_velocity(robot_state: RobotState) -> tuple[jax.Array, jax.Array]:
    """Returns the first robot's velocity along its heading and to its left (2,), m/s, and yaw rate (), rad/s."""
    velocity = rotate_inverse(robot_state.quaternion[0], robot_state.linear_velocity_w[0])
    return velocity[:2], robot_state.angular_velocity_b[0, 2]


def _zero_metrics(weights: WalkRewards) -> dict[str, Any]:
    names = [f"reward/{field.name}" for field in dataclasses.fields(weights)]
    return {name: jnp.zeros(()) for name in [*names, "error_vx", "error_vy", "error_yaw", "diverged"]}
