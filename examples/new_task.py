"""A custom task in five steps: a robot catches a mouse that flees from it around a pillar.

docs/task_parts.md explains the parts; `python examples/new_task.py` evaluates the scripted policy.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import mujoco

from mqe_jax.acting.evaluate import evaluate_batch
from mqe_jax.core.settings import NonNegative, Positive, PositiveInt, settings_class
from mqe_jax.envs import Moment, QuadrupedEnv, State, TaskParams, VectorEnv, make, register_task
from mqe_jax.envs.observation import BASE_INFO, Block, ObservationLayout
from mqe_jax.physics.collision import OBJECT_BIT, WALL_BIT
from mqe_jax.physics.objects import Object, add_body, add_slides, add_solid
from mqe_jax.physics.robots.index import RobotState
from mqe_jax.physics.scene import Scene
from mqe_jax.policies.scripted import Observation, go_to, pose, scripted_policy
from mqe_jax.terrain import EndWall, Layout, Plane, SpawnArea, TerrainBlock, Track, Wall

if TYPE_CHECKING:
    from mujoco import mjx

# Step 1: a terrain block defines its walls.


@dataclasses.dataclass(frozen=True)
class Pillar(TerrainBlock):
    """Free ground with a square pillar at its centre."""

    side: float = 0.4
    """Length of the pillar's sides, m."""

    def layout(self, start: float, track: Track, number: int) -> Layout:
        center = (start + self.length / 2, 0.0, track.wall_height / 2)
        size = (self.side, self.side, track.wall_height)
        return Layout(walls=(Wall(f"pillar{number}", center, size),))


# Step 2: an object adds one body named `object/<name>`; its joints are its generalised coordinates.


@settings_class
class Mouse(Object):
    """A ball-shaped mouse that slides over the ground. Coordinates: x, y; velocity likewise."""

    radius: Positive = 0.12
    """Radius, m."""

    def add(self, spec: mujoco.MjSpec, name: str, visual: bool) -> None:
        body = add_body(spec, name, (0, 0, 0), 1.0, (0.01, 0.01, 0.01))
        add_slides(body, "xy", damping=1.0)
        add_solid(
            body,
            mujoco.mjtGeom.mjGEOM_SPHERE,
            (0.45, 0.4, 0.4, 1.0),
            size=(self.radius, 0, 0),
            pos=(0, 0, self.radius),
            contype=OBJECT_BIT,
            conaffinity=WALL_BIT,
        )


# Step 3: the control law of an NPC is a pure function of arrays.


def flee(mouse: jax.Array, robot: jax.Array, speed: float, sight: float = 1.5) -> jax.Array:
    """Returns the velocity (2,), m/s, of a mouse that flees from a robot nearer than `sight`, m."""
    away = mouse - robot
    distance = jnp.maximum(jnp.linalg.norm(away), 1e-3)
    return jnp.where(distance < sight, speed * away / distance, 0.0)


# Step 4: the task: parameters, scene, reset, observation, rewards, ending.


@settings_class
class CatchRewards:
    """Weights of the reward terms."""

    approach: float = 1.0
    """Per m of decrease of the distance between robot and mouse."""
    caught: float = 5.0
    """In the step in which the robot catches the mouse."""


@settings_class
class CatchParams(TaskParams):
    """Parameters of Catch a Mouse."""

    num_agents: PositiveInt = 1
    reach: Positive = 0.45
    """Distance within which the mouse is caught, m."""
    mouse_speed: NonNegative = 0.4
    """Mouse speed, m/s."""
    rewards: CatchRewards = CatchRewards()
    """Weights of the reward terms."""


class Go1Catch(QuadrupedEnv[None, CatchParams]):
    """Catch a mouse.

    - Scene: a walled track 3 m wide with a pillar, and a mouse behind it.
    - Observation: own base info 6, mouse x, y 2.
    - Reward: see `CatchRewards`.
    - End: a fall, the mouse is caught, or 10 s. Success: it is caught.
    """

    name = "go1catch"
    title = "Catch a Mouse"
    aim = "Catch the mouse."
    Params = CatchParams

    def scene(self) -> Scene:
        track = Track(
            blocks=(SpawnArea(1.5), Pillar(2.0), Plane(1.5), EndWall()), width=3.0, num_robots=1
        )
        return Scene(track, num_robots=1, objects={"mouse": Mouse()})

    def reset_objects(
        self, key: jax.Array, qpos: jax.Array, qvel: jax.Array, assistance: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Samples the mouse's initial position."""
        place = jnp.array([3.8, 0.0]) + jax.random.uniform(key, (2,), minval=-0.5, maxval=0.5)
        return qpos.at[self.objects["mouse"].qpos].set(place), qvel

    def step_npcs(self, data: mjx.Data, robot_state: RobotState, key: jax.Array) -> mjx.Data:
        """Sets the mouse's velocity."""
        mouse = self.object_pose(data, "mouse")[:2]
        velocity = flee(mouse, robot_state.position_w[0, :2], self.params.mouse_speed)
        return data.replace(qvel=data.qvel.at[self.objects["mouse"].qvel].set(velocity))

    def distance(self, state: State, robot_state: RobotState) -> jax.Array:
        """Returns the horizontal distance of the robot to the mouse (), m."""
        mouse = self.object_pose(state.data, "mouse")[:2]
        return jnp.linalg.norm(mouse - robot_state.position_w[0, :2])

    @property
    def observation_layout(self) -> ObservationLayout:
        return ObservationLayout((Block("base", 6, BASE_INFO), Block("mouse", 2, "x, y, m")))

    def observe(self, state: State, robot_state: RobotState) -> dict[str, jax.Array]:
        mouse = self.object_pose(state.data, "mouse")[:2]
        return {"base": robot_state.base_info, "mouse": mouse[None]}

    def rewards(self, before: Moment, after: Moment, collision: jax.Array) -> dict[str, jax.Array]:
        distance = self.distance(after.state, after.robots)
        return {
            "approach": self.distance(before.state, before.robots) - distance,
            "caught": distance < self.params.reach,
        }

    def ending(self, state: State, robot_state: RobotState) -> jax.Array:
        """The episode ends when the mouse is caught."""
        return self.distance(state, robot_state) < self.params.reach

    def outcome(
        self, state: State, robot_state: RobotState, failed: jax.Array
    ) -> dict[str, jax.Array]:
        """Success: the mouse is caught."""
        return {"success": self.ending(state, robot_state) & ~failed}


# Step 5: a scripted policy, which shows that the task can be solved, and the registration of both.


def plan_catch(obs: Observation) -> jax.Array:
    """Returns the robot's action (1, 3): past the pillar, then towards the mouse."""
    position, yaw = pose(obs["base"])
    mouse = obs["mouse"]
    side = jnp.where(mouse[:, 1:] < 0, -0.7, 0.7)
    before = position[:, :1] < 3.1
    goal = jnp.where(before, jnp.concatenate([position[:, :1] + 0.6, side], axis=-1), mouse)
    apart = goal - position
    return go_to(position, yaw, goal, jnp.arctan2(apart[:, 1], apart[:, 0]))


register_task(Go1Catch, plan_catch)


def main() -> None:
    """Evaluates the scripted policy over 32 episodes and prints its success rate."""
    env = VectorEnv(make("go1catch", num_envs=32), 32)
    plan = jax.vmap(scripted_policy(env.env))

    def act(obs: jax.Array, memory: object, key: jax.Array) -> tuple[jax.Array, object]:
        return plan(obs), memory

    result = evaluate_batch(env, act, 32, jax.random.PRNGKey(0))
    reward = result.average_step_reward
    print(f"caught {result.success_rate:.0%} of 32 mice, average step reward {reward:.3f}")


if __name__ == "__main__":
    main()
