"""Training and evaluation environment of skills that walk: one robot that tracks commands.

Slopes are rotations of gravity, so each environment has its own without its own geometry. All
positions and velocities here are in the slope's frame. Randomisation and rewards follow
walk-these-ways (arXiv 2212.03238).
"""

import dataclasses
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax import walk_policy
from mqe_jax.core import keys
from mqe_jax.core.settings import override
from mqe_jax.envs.base import QuadrupedEnv
from mqe_jax.envs.observation import Block, ObservationLayout
from mqe_jax.envs.randomization import Randomization
from mqe_jax.envs.reward import weigh
from mqe_jax.envs.state import Moment, State
from mqe_jax.physics.robots.index import Proprioception, RobotState
from mqe_jax.physics.robots.quadruped import NUM_JOINTS
from mqe_jax.physics.robots.robot import Proportions, Robot
from mqe_jax.physics.rotation import quaternion_to_euler, rotate, rotate_inverse
from mqe_jax.physics.scene import Scene
from mqe_jax.terrain import Plane, Track
from mqe_jax.walk import trainees
from mqe_jax.walk.rewards import POSITIVE_TERMS, reward_terms
from mqe_jax.walk.task import (
    RANDOMIZATION,
    EpisodeSpec,
    WalkParams,
    WalkState,
    WalkTask,
    sample_spec,
)
from mqe_jax.walk_policy import WalkMemory

if TYPE_CHECKING:
    from mujoco import mjx

GRAVITY = 9.81  # m/s^2
DT = walk_policy.STEP
SHOVED = np.array([0.25, 0.08, 0.06])  # half-lengths of the box of the trunk to shove, m
_UP = np.array([0.0, 0.0, 1.0], np.float32)


class WalkEnv(QuadrupedEnv[WalkState, WalkParams]):
    """One robot that tracks commands on a slope under external forces.

    - Action: joint targets, as the skill's network gives them.
    - Observation: the skill's own of one step, with noise if randomised.
    - Reward: see `mqe_jax.walk.rewards`.
    - End: a trunk that touches the ground, tilts by 60 degrees or is too low, or the time limit.
    """

    Params = WalkParams
    action_limit = walk_policy.ACTION_CLIP

    def __init__(
        self,
        robot: Robot,
        task: WalkTask | None = None,
        *,
        skill: str = "walk",
        impl: str = "auto",
        num_envs: int = 4096,
    ) -> None:
        self.task = task or WalkTask()
        self.trainee = trainees.make(skill, robot)
        self.name = skill  # pyright: ignore[reportAttributeAccessIssue]
        self.skill = self.trainee.skill
        self.body = robot.proportions
        lagged = dataclasses.replace(RANDOMIZATION, action_lag=self.task.action_lag)
        if self.body != Proportions():
            payload = tuple(self.body.mass * x for x in RANDOMIZATION.payload or ())
            shift = tuple(self.body.length * x for x in RANDOMIZATION.center_of_mass or ())
            lagged = dataclasses.replace(lagged, payload=payload, center_of_mass=shift)
        changes = {
            "skill": skill,
            "episode_length": self.task.episode_length,
            "solver_iterations": self.task.solver_iterations,
            "randomization": lagged if self.task.randomize else Randomization(),
            "walk": self.task,
        }
        params = override(WalkParams.suited(robot.call), changes)
        super().__init__(params, impl=impl, control="position", num_envs=num_envs)
        self.skill.check_period(self.compiled.scene.timestep, self.physics.num_substeps)

    @property
    def robot(self) -> Robot:
        """The robot."""
        return self.robots[0]

    def scene(self) -> Scene:
        return Scene(Track(blocks=(Plane(4.0),), walled=False, num_robots=1), num_robots=1)

    def spawn(self, key: jax.Array) -> jax.Array:
        """Samples the robot's pose.

        In evaluations, which never resample commands, it starts along +x. The slope's direction
        is then that of the heading.
        """
        yaw_key, height_key = jax.random.split(key)
        turn = jnp.pi if self.task.command_period > 0 else 0.0
        yaw = jax.random.uniform(yaw_key, (), minval=-turn, maxval=turn)
        stand = self.robot.stand_height
        low, high = (stand + self.body.height * above for above in (0.03, 0.12))
        height = jax.random.uniform(height_key, (), minval=low, maxval=high)
        return jnp.stack([jnp.zeros(()), jnp.zeros(()), height, yaw])[None]

    def reset_task(self, key: jax.Array, state: State, robot_state: RobotState) -> WalkState:
        spec = sample_spec(key, self.task, self.trainee, state.assistance)
        return WalkState(
            spec=spec,
            slope=spec.slope,
            force=spec.force,
            shove=jnp.zeros(6),
            shove_steps=jnp.zeros((), jnp.int32),
            actions=jnp.zeros((3, NUM_JOINTS)),
            gait=jnp.zeros(()),
            mean_error=jnp.zeros(3),
        )

    def with_spec(self, state: State[WalkState], spec: EpisodeSpec) -> State[WalkState]:
        """Returns an initial state with another spec, without observations."""
        walk = dataclasses.replace(state.task, spec=spec, slope=spec.slope, force=spec.force)
        return dataclasses.replace(state, task=walk)

    def advance(self, state: State[WalkState], action: jax.Array) -> State[WalkState]:
        """Changes slope, force, push and shove, then advances the environment."""
        task = self.task
        walk = state.task
        _, direction_key, time_key, size_key, _, _ = jax.random.split(state.key, 6)
        if task.command_period > 0:
            pushed = jax.random.bernoulli(time_key, DT / task.push_period)
            size = walk.spec.push * jax.random.uniform(size_key, ())
        else:
            pushed = (state.step + 1) % round(task.push_period / DT) == 0
            size = walk.spec.push
        angle = jax.random.uniform(direction_key, (), maxval=2 * jnp.pi)
        push = jnp.where(pushed, size, 0.0) * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        data = state.data.replace(qvel=state.data.qvel.at[self.index.base_qvel[0, :2]].add(push))
        shove, shove_steps = self._shove(state, jax.random.fold_in(time_key, keys.SECOND))
        newest = jnp.clip(action, -self.action_limit, self.action_limit)
        walk = dataclasses.replace(
            walk,
            # Slope and force reach the spec's values within about half a second.
            slope=walk.slope + jnp.clip(walk.spec.slope - walk.slope, -0.02, 0.02),
            force=walk.force + jnp.clip(walk.spec.force - walk.force, -2.0, 2.0),
            shove=shove,
            shove_steps=shove_steps,
            actions=jnp.concatenate([newest, walk.actions[:-1]]),
            gait=walk_policy.advance_gait(walk.gait, walk.spec.commands),
        )
        return super().advance(dataclasses.replace(state, data=data, task=walk), action)

    def _shove(self, state: State[WalkState], key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Returns a step's force and torque of the shove (6,), and the steps until it ends ()."""
        walk = state.task
        if not self.task.shove:
            return walk.shove, walk.shove_steps
        when_key, angle_key, up_key, size_key, length_key, point_key = jax.random.split(key, 6)
        shoved = jax.random.bernoulli(when_key, DT / self.task.shove_period)
        begins = (walk.shove_steps == 0) & shoved
        angle = jax.random.uniform(angle_key, (), maxval=2 * jnp.pi)
        up = jax.random.uniform(up_key, (), minval=-0.3, maxval=0.3)
        size = self.body.mass * walk.spec.shove * jax.random.uniform(size_key, ())
        force = size * jnp.stack([jnp.cos(angle), jnp.sin(angle), up])
        half = SHOVED * [self.body.length, self.body.width, self.body.height]
        point = jnp.asarray(half) * jax.random.uniform(point_key, (3,), jnp.float32, -1.0, 1.0)
        arm = rotate(state.data.qpos[self.index.base_qpos[0, 3:]], point)
        length = jax.random.uniform(
            length_key, (), minval=self.task.shove_length[0], maxval=self.task.shove_length[1]
        )
        current = jnp.where(walk.shove_steps > 0, walk.shove, 0.0)
        shove = jnp.where(begins, jnp.concatenate([force, jnp.cross(arm, force)]), current)
        steps = jnp.where(begins, jnp.round(length / DT).astype(jnp.int32), walk.shove_steps)
        return shove, jnp.maximum(steps - 1, 0)

    def external_forces(self, state: State[WalkState]) -> jax.Array:
        """Returns the external forces and torques on all bodies (nbody, 6).

        The slope changes gravity on all bodies. Force and shove act on the trunk.
        """
        trunk = int(self.index.trunk_body[0])
        walk = state.task
        mass = jnp.asarray(self.compiled.model.body_mass, jnp.float32)
        mass = mass.at[trunk].add(state.randomized.payload[0])
        turn = gravity_w(walk.slope) - jnp.array([0.0, 0.0, -GRAVITY])
        yaw = quaternion_to_euler(state.data.qpos[self.index.base_qpos[0, 3:]])[2]
        along = jnp.stack([jnp.cos(yaw), jnp.sin(yaw)])
        left = jnp.stack([-jnp.sin(yaw), jnp.cos(yaw)])
        forces = jnp.zeros((len(mass), 6)).at[:, :3].set(mass[:, None] * turn)
        push = walk.force[0] * along + walk.force[1] * left
        forces = forces.at[trunk, :2].add(self.body.mass * push)
        return forces.at[trunk].add(walk.shove) if self.task.shove else forces

    def step_task(self, before: Moment[WalkState], after: Moment[WalkState]) -> WalkState:
        task = self.task
        walk = after.state.task
        _, mean_error = self._errors(before, after)
        if not task.command_period:
            return dataclasses.replace(walk, mean_error=mean_error)
        renewed = after.state.step % round(task.command_period / DT) == 0
        key = jax.random.split(before.state.key, 6)[4]
        fresh = sample_spec(key, task, self.trainee, after.state.assistance)
        spec = jax.tree.map(lambda new, old: jnp.where(renewed, new, old), fresh, walk.spec)
        return dataclasses.replace(walk, spec=spec, mean_error=jnp.where(renewed, 0.0, mean_error))

    def _errors(
        self, before: Moment[WalkState], after: Moment[WalkState]
    ) -> tuple[jax.Array, jax.Array]:
        """Returns the velocity error of a step, and the mean error after it (3,)."""
        velocity, rate = heading_velocity(after.robots)
        walk = before.state.task
        error = jnp.append(velocity, rate) - walk.spec.commands[:3]
        return error, walk.mean_error + 0.04 * (error - walk.mean_error)

    def score(
        self, before: Moment[WalkState], after: Moment[WalkState], collision: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Returns the reward, and what is logged.

        The reward is (sum of positive terms) x exp(sum of the others) x the time of a step.
        """
        walk = before.state.task
        random = after.state.randomized
        error, mean_error = self._errors(before, after)
        targets = self.robot.joint_targets(walk.actions)
        terms = reward_terms(
            self.robot,
            after.robots,
            walk.spec.commands,
            error=error,
            mean_error=mean_error,
            phases=self.trainee.foot_phases(walk.gait, walk.spec.commands),
            targets=targets,
            applied=jnp.where(random.action_lag > 0, targets[1], targets[0]),
            foot_force=self.foot_force(after.state.data),
            strength=random.motor_strength[0],
            tolerance=self.task.tolerance,
        )
        _, logged = weigh(terms, self.weights, self.teams, after.state.active)
        positive = sum(logged[f"reward/{name}"] for name in POSITIVE_TERMS)
        negative = sum(logged[f"reward/{name}"] for name in terms if name not in POSITIVE_TERMS)
        reward = DT * positive * jnp.exp(negative)
        logged |= dict(zip(("error_vx", "error_vy", "error_yaw"), jnp.square(error), strict=True))
        return reward[None], {**logged, "average_step_reward": reward}

    def fallen(self, robot_state: RobotState) -> jax.Array:
        tilted = rotate_inverse(robot_state.quaternion, jnp.asarray(_UP))[:, 2] < 0.5
        return tilted | (robot_state.position_w[:, 2] < self.robot.walk.min_trunk_height)

    def outcome(
        self, state: State, robot_state: RobotState, failed: jax.Array
    ) -> dict[str, jax.Array]:
        """Success: the robot has not fallen."""
        return {"success": 1.0 - jnp.asarray(failed, jnp.float32)}

    @property
    def observation_layout(self) -> ObservationLayout:
        return ObservationLayout(
            (Block("skill", self.trainee.observation_size, "the skill's own, of one step"),)
        )

    def observe(self, state: State[WalkState], robot_state: RobotState) -> dict[str, jax.Array]:
        sensed = self._sense(state, robot_state)
        if self.task.randomize:
            noise_keys = jax.random.split(jax.random.fold_in(state.key, keys.NOISE), 3)
            parts = zip(sensed, (0.02, 0.005, 0.5), noise_keys, strict=True)
            noisy = [x + size * jax.random.normal(key, x.shape) for x, size, key in parts]
            sensed = Proprioception(*noisy)
        return {"skill": self._skill_observation(state.task, sensed)[None]}

    def _sense(self, state: State[WalkState], robot_state: RobotState) -> Proprioception:
        gravity = rotate_inverse(robot_state.quaternion[0], gravity_w(state.task.slope) / GRAVITY)
        return Proprioception(gravity, robot_state.joint_position[0], robot_state.joint_velocity[0])

    def _skill_observation(self, walk: WalkState, sensed: Proprioception) -> jax.Array:
        memory = WalkMemory(
            jnp.zeros((0, walk_policy.OBSERVATION_SIZE)),
            walk.actions[0],
            walk.actions[1],
            walk.gait,
        )
        return self.trainee.observe(memory, walk.spec.commands, sensed)

    @property
    def privileged_layout(self) -> ObservationLayout:
        def privileged(key: jax.Array) -> dict[str, jax.Array]:
            state = self.begin(key)
            return self._privileged(state, self.read(state.data))

        shapes = jax.eval_shape(privileged, jax.random.PRNGKey(0))
        return ObservationLayout(tuple(Block(name, len(x)) for name, x in shapes.items()))

    def observe_privileged(self, state: State[WalkState], robot_state: RobotState) -> jax.Array:
        return jnp.concatenate(list(self._privileged(state, robot_state).values()))

    def _privileged(self, state: State[WalkState], robot_state: RobotState) -> dict[str, jax.Array]:
        """Returns the scaled blocks of the critic's observation, `LATENT_TARGET` last."""
        walk = state.task
        random = state.randomized
        quaternion = robot_state.quaternion[0]
        height = robot_state.position_w[0, 2:]
        feet = rotate(
            jnp.broadcast_to(quaternion, (4, 4)),
            self.robot.foot_positions(robot_state.joint_position[0]),
        )
        phases = self.trainee.foot_phases(walk.gait, walk.spec.commands)
        optional = {}
        if self.task.shove:
            scale = jnp.array([0.02, 0.02, 0.02, 0.1, 0.1, 0.1])
            optional["shove"] = walk.shove / self.body.mass * scale
        if self.task.action_lag:
            optional["action_lag"] = random.action_lag[None].astype(jnp.float32)
        return {
            "skill": self._skill_observation(walk, self._sense(state, robot_state)),
            "linear_velocity": 2.0 * rotate_inverse(quaternion, robot_state.linear_velocity_w[0]),
            "angular_velocity": 0.25 * robot_state.angular_velocity_b[0],
            "up": rotate_inverse(quaternion, jnp.asarray(_UP)),
            "height": (5.0 * height - 5.0 * self.robot.stand_height) / self.body.height,
            "foot_height": 10.0 * (feet[:, 2] + height) / self.body.height,
            "phases": jnp.cos(2 * jnp.pi * phases),
            "foot_force": jnp.tanh(self.foot_force(state.data) / (50.0 * self.body.mass)),
            "mean_error": 2.0 * walk.mean_error,
            "force": walk.force / 20.0,
            **optional,
            "slope": walk.slope * 4.0,
            "center_of_mass": random.center_of_mass[0] * (20.0 / self.body.length),
            "motor_strength": (random.motor_strength - 1.0) * 5.0,
            "friction": random.friction - 1.0,
            "payload": random.payload / (2.0 * self.body.mass),
        }

    @property
    def weight(self) -> float:
        """Weight of the robot, N."""
        return GRAVITY * float(self.compiled.model.body_mass.sum())

    def power(self, state: State[WalkState]) -> jax.Array:
        """Returns the mechanical power of the joints (), W: the sum of their magnitudes."""
        robot = self.robot
        robot_state = self.read(state.data)
        velocity = robot_state.joint_velocity[0]
        error = robot.joint_targets(state.task.actions[0]) - robot_state.joint_position[0]
        torque = robot.kp * error
        torque = jnp.clip(torque - robot.kd * velocity, -robot.torque_limit, robot.torque_limit)
        return jnp.sum(jnp.abs(torque * velocity))

    def foot_force(self, data: "mjx.Data") -> jax.Array:
        """Returns the strongest contact force on each foot (4,), N."""
        return jnp.linalg.norm(data.sensordata[self.index.foot_force[0]], axis=-1)


def gravity_w(slope: jax.Array) -> jax.Array:
    """Returns gravity (3,), m/s^2, in the frame of an inclined ground.

    `slope` (2,), rad, is the ground's inclination along x and y.
    """
    angle = jnp.linalg.norm(slope + 1e-12)
    along = slope / jnp.maximum(angle, 1e-9)
    return GRAVITY * jnp.concatenate([-jnp.sin(angle) * along, -jnp.cos(angle)[None]])


def heading_velocity(robot_state: RobotState) -> tuple[jax.Array, jax.Array]:
    """Returns the first robot's velocity along its heading and to its left (2,), and its yaw rate.

    In m/s and rad/s.
    """
    velocity = rotate_inverse(robot_state.quaternion[0], robot_state.linear_velocity_w[0])
    return velocity[:2], robot_state.angular_velocity_b[0, 2]
