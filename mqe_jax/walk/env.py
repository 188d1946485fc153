"""Training and evaluation environment of the walk policy: one robot that tracks commands.

Slopes are rotations of gravity: a robot on an infinite slope of angle t behaves, in the frame of the slope, as one on
flat ground under gravity rotated by t. Each environment thus has its own slope without its own geometry. All positions
and velocities here are in the slope's frame.

Randomisation and rewards (`mqe_jax.walk.rewards`) follow walk-these-ways (Margolis and Agrawal, arXiv 2212.03238).
"""

from __future__ import annotations

import dataclasses
import functools
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax import engines, walk_policy
from mqe_jax.actuators import Actuators
from mqe_jax.envs.randomization import Randomization, RandomizedParams, Randomizer
from mqe_jax.robots.index import Proprioception, RobotState, foot_positions, read_robots
from mqe_jax.robots.robot import NUM_JOINTS, Robot
from mqe_jax.rotation import euler_to_quaternion, quaternion_to_euler, rotate, rotate_inverse
from mqe_jax.scene import Scene, compile_scene
from mqe_jax.terrain import Plane, Track
from mqe_jax.walk.rewards import RewardInputs, WalkRewards, combine, reward_terms
from mqe_jax.walk.task import RANDOMIZATION, EpisodeSpec, WalkState, WalkTask, sample_spec
from mqe_jax.walk_policy import WalkMemory

if TYPE_CHECKING:
    from mujoco import mjx

GRAVITY = 9.81  # m/s^2
DT = walk_policy.STEP
MOTOR_OFFSET = 0.02  # greatest offset of a joint's target under randomisation, rad


class WalkEnv:
    """One robot that tracks commands on a slope under external forces; batch with `VectorEnv` or `jax.vmap`."""

    name = "walk"
    num_agents = 1
    teams = ((0,),)
    observation_size = walk_policy.OBSERVATION_SIZE
    action_size = NUM_JOINTS

    def __init__(self, robot: Robot, task: WalkTask | None = None, *, impl: str = "auto", num_envs: int = 4096) -> None:
        self.robot = robot
        self.task = task or WalkTask()
        scene = Scene(
            Track(blocks=(Plane(4.0),), walled=False, num_robots=1),
            num_robots=1,
            robot=robot,
            foot_sensors=True,
            solver_iterations=self.task.solver_iterations,
        )
        self.compiled = compile_scene(scene)
        self.skill = walk_policy.WalkPolicy(robot)
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
        randomization = RANDOMIZATION if self.task.randomize else Randomization()
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
        return WalkEnv(self.robot, self.task, impl=self.physics.impl, num_envs=num_envs)

    # -- reset and step -----------------------------------------------------------------------------------------

    def reset(self, key: jax.Array, assistance: jax.Array | float = 0.0, spec: EpisodeSpec | None = None) -> WalkState:
        """Returns the initial state of an episode; samples a spec if none is given."""
        next_key, spec_key, random_key, pose_key, noise_key = jax.random.split(key, 5)
        assistance = jnp.asarray(assistance, jnp.float32)
        if spec is None:
            spec = sample_spec(spec_key, self.task, self.robot, 1.0 - assistance)
        offset = jnp.zeros(NUM_JOINTS)
        if self.task.randomize:
            offset = MOTOR_OFFSET * jax.random.uniform(
                jax.random.fold_in(random_key, 1), (NUM_JOINTS,), minval=-1.0, maxval=1.0
            )
        a, b, c, d = jax.random.split(pose_key, 4)
        model, index = self.compiled.model, self.index
        yaw = jax.random.uniform(a, (), minval=-jnp.pi, maxval=jnp.pi)
        # Fixed specs (evaluation) start along +x, so that slope and heading have a known relation.
        yaw = jnp.where(self.task.command_period > 0, yaw, 0.0)
        joints = self.robot.default_joints * jax.random.uniform(b, (NUM_JOINTS,), minval=0.7, maxval=1.3)
        stand = self.robot.stand_height
        height = jax.random.uniform(c, (), minval=stand + 0.03, maxval=stand + 0.12)
        quaternion = euler_to_quaternion(jnp.stack([jnp.zeros(()), jnp.zeros(()), yaw]))
        qpos = jnp.zeros(model.nq).at[index.joint_qpos[0]].set(joints)
        qpos = qpos.at[index.base_qpos[0]].set(jnp.concatenate([jnp.stack([0.0, 0.0, height]), quaternion]))
        speed = jax.random.uniform(d, (6,), minval=-0.5, maxval=0.5)
        qvel = jnp.zeros(model.nv).at[index.base_qvel[0]].set(speed)
        ctrl = self.actuators.control(jnp.asarray(self.robot.default_joints))
        data = self.physics.init(qpos, qvel, jnp.zeros((0, 3)), ctrl)
        zero, zeros = jnp.zeros(()), jnp.zeros(NUM_JOINTS)
        memory = WalkMemory(jnp.zeros((0, walk_policy.OBSERVATION_SIZE)), zeros, zeros, zero)
        state = WalkState(
            data=data,
            obs=zero,
            privileged_obs=zero,
            final_obs=zero,
            final_privileged_obs=zero,
            reward=jnp.zeros(1),
            terminated=jnp.zeros((), bool),
            truncated=jnp.zeros((), bool),
            metrics=_zero_metrics(self.task.rewards),
            spec=spec,
            slope=spec.slope,
            force=spec.force,
            random=self._randomizer.sample(random_key),
            motor_offset=offset,
            memory=memory,
            mean_error=jnp.zeros(3),
            step=jnp.zeros((), jnp.int32),
            episode_steps=jnp.zeros((), jnp.int32),
            assistance=assistance,
            key=next_key,
        )
        return self._observed(state, noise_key)

    def step(self, state: WalkState, action: jax.Array) -> WalkState:
        """Advances by one policy step with an action (1, 12)."""
        task, index = self.task, self.index
        key, direction_key, time_key, size_key, spec_key, noise_key = jax.random.split(state.key, 6)
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

        fields, forces = self._randomizer.fields(state.random), self._forces(data, state.random, slope, force)
        data, _, _ = self.actuators.step(data, (), target + state.motor_offset, fields, forces)
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
            gait=gait,
            target=target,
            previous_target=previous_target,
            earlier_target=earlier_target,
            foot_force=self.foot_force(data),
            strength=state.random.motor_strength[0],
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
            fresh = sample_spec(spec_key, task, self.robot, 1.0 - state.assistance)
            spec = jax.tree.map(lambda new, old: jnp.where(renewed, new, old), fresh, spec)
            mean_error = jnp.where(renewed, 0.0, mean_error)
        state = dataclasses.replace(
            state,
            data=data,
            reward=jnp.where(finite, reward, 0.0)[None],
            terminated=fallen,
            truncated=~fallen & (step >= self.max_steps),
            metrics=metrics,
            spec=spec,
            slope=slope,
            force=force,
            memory=memory,
            mean_error=mean_error,
            step=step,
            episode_steps=episode_steps,
            key=key,
        )
        return self._observed(state, noise_key)

    # -- robot state --------------------------------------------------------------------------------------------

    def read(self, data: mjx.Data) -> RobotState:
        """Returns the robot's state."""
        return read_robots(self.index, data.qpos, data.qvel, data.sensordata)

    def foot_force(self, data: mjx.Data) -> jax.Array:
        """Returns the strongest contact force on each foot (4,), N."""
        return jnp.linalg.norm(data.sensordata[self.index.foot_force[0]], axis=-1)

    def _forces(self, data: mjx.Data, random: RandomizedParams, slope: jax.Array, force: jax.Array) -> jax.Array:
        """Returns external forces on all bodies (nbody, 6), N: the slope's change of gravity, and the trunk force."""
        trunk = int(self.index.trunk_body[0])
        turn = gravity_w(slope) - jnp.array([0.0, 0.0, -GRAVITY])
        mass = jnp.asarray(self._mass, jnp.float32).at[trunk].add(random.payload[0])
        quaternion = data.qpos[self.index.base_qpos[0, 3:]]
        yaw = quaternion_to_euler(quaternion)[2]
        along = jnp.stack([jnp.cos(yaw), jnp.sin(yaw)])
        left = jnp.stack([-jnp.sin(yaw), jnp.cos(yaw)])
        forces = jnp.zeros((len(self._mass), 6)).at[:, :3].set(mass[:, None] * turn)
        return forces.at[trunk, :2].add(force[0] * along + force[1] * left)

    def _observed(self, state: WalkState, key: jax.Array) -> WalkState:
        robot_state = self.read(state.data)
        quaternion = robot_state.quaternion[0]
        gravity = rotate_inverse(quaternion, gravity_w(state.slope) / GRAVITY)
        sensed = Proprioception(gravity, robot_state.joint_position[0], robot_state.joint_velocity[0])
        obs = clean = walk_policy.observe(self.robot, state.memory, state.spec.commands, sensed)
        if self.task.randomize:
            parts = zip(sensed, (0.02, 0.005, 0.5), jax.random.split(key, 3), strict=True)
            noisy = Proprioception(*(x + size * jax.random.normal(part_key, x.shape) for x, size, part_key in parts))
            obs = walk_policy.observe(self.robot, state.memory, state.spec.commands, noisy)
        velocity = rotate_inverse(quaternion, robot_state.linear_velocity_w[0])
        up = rotate_inverse(quaternion, jnp.array([0.0, 0.0, 1.0]))
        feet = foot_positions(self.robot, sensed.joint_position)
        foot_height = rotate(jnp.broadcast_to(quaternion, (4, 4)), feet)[:, 2] + robot_state.position_w[0, 2]
        phases = walk_policy.foot_phases(state.memory.gait, state.spec.commands)
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
                state.slope * 4.0,
                random.center_of_mass[0] * 20.0,
                (random.motor_strength - 1.0) * 5.0,
                random.friction - 1.0,
                random.payload / 2.0,
            ]
        )
        obs = jnp.nan_to_num(jnp.clip(obs, -100.0, 100.0))[None]
        privileged = jnp.nan_to_num(jnp.clip(privileged, -100.0, 100.0))
        return dataclasses.replace(
            state, obs=obs, privileged_obs=privileged, final_obs=obs, final_privileged_obs=privileged
        )


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
