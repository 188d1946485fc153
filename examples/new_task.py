"""A task of one's own in five steps: a robot catches a mouse that flees from it, around a pillar.

docs/new_task.md explains the steps; `python examples/new_task.py` plays the task.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

from mqe_jax.collision import OBJECT_BIT, WALL_BIT
from mqe_jax.envs import QuadrupedEnv, State, TaskParams, VectorEnv, make, register_task
from mqe_jax.envs.observation import BASE_INFO, Block, ObservationLayout
from mqe_jax.objects import Object
from mqe_jax.planners import PLANNERS
from mqe_jax.planners.steering import go_to
from mqe_jax.robots.build import Contacts
from mqe_jax.robots.index import RobotState
from mqe_jax.scene import Scene
from mqe_jax.terrain import Block as TerrainBlock
from mqe_jax.terrain import EndWall, SpawnArea, Layout, Plane, Track, Wall, register_block
from mqe_jax.train.evaluate import evaluate

# Step 1: a terrain block says where its walls are.


@register_block("pillar")
@dataclasses.dataclass(frozen=True)
class Pillar(TerrainBlock):
    """Free ground with a square pillar in its middle.

    Attributes:
        side: of the pillar, m.
    """

    side: float = 0.4

    def layout(self, start: float, track: Track, number: int) -> Layout:
        """Lays the block out from x = `start`."""
        assert not isinstance(self.length, tuple)  # the track has fixed what was given as (easy, hard)
        length = self.length
        center = (start + length / 2, 0.0, track.wall_height / 2)
        return Layout(walls=(Wall(f"pillar{number}", center, (self.side, self.side, track.wall_height)),))


# Step 2: an object adds one body named `object/<name>`; its joints are its coordinates.


@dataclasses.dataclass(frozen=True)
class Mouse(Object):
    """A ball-shaped mouse that runs over the ground. Coordinates: x, y; velocity likewise."""

    radius: float = 0.12

    def add(self, spec: mujoco.MjSpec, visual: bool) -> None:
        """Adds the mouse."""
        body = self._body(spec, (0, 0, 0), 1.0, (0.01, 0.01, 0.01))
        self._slides(body, "xy", damping=1.0)
        self._solid(
            body, mujoco.mjtGeom.mjGEOM_SPHERE, (0.45, 0.4, 0.4, 1.0), size=(self.radius, 0, 0),
            pos=(0, 0, self.radius), contype=OBJECT_BIT, conaffinity=WALL_BIT,
        )  # fmt: skip


# Step 3: what an NPC does is a pure function of what it sees.


def flee(mouse: jax.Array, robot: jax.Array, speed: float, sight: float = 1.5) -> jax.Array:
    """Returns the velocity (2,), m/s, of a mouse at (2,), m, that runs from a robot nearer than `sight` m."""
    away = mouse - robot
    distance = jnp.maximum(jnp.linalg.norm(away), 1e-3)
    return jnp.where(distance < sight, speed * away / distance, 0.0)


# Step 4: the task: parameters, scene, reset, observation, rewards, ending.


@dataclasses.dataclass(frozen=True)
class CatchRewards:
    """Weights: `approach` per m by which the robot came closer to the mouse, `caught` while it has caught it."""

    approach: float = 1.0
    caught: float = 5.0


@dataclasses.dataclass(frozen=True)
class CatchParams(TaskParams):
    """Parameters: `reach`, m, within which the mouse is caught; `mouse_speed`, m/s; and the weights."""

    num_agents: int = 1
    reach: float = 0.45
    mouse_speed: float = 0.4
    rewards: CatchRewards = CatchRewards()


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class CatchState:
    """`distance`: of the robot to the mouse after the last step (), m."""

    distance: jax.Array


# Step 5: register it, and write a planner that shows that it can be won.


@register_task
class Go1Catch(QuadrupedEnv):
    """Catch a mouse.

    - Scene: a walled track 3 m wide with a pillar, and a mouse behind it.
    - Observation: own base info 6, mouse x, y 2.
    - Reward: see `CatchRewards`.
    - End: a fall, the mouse is caught, or 10 s. Success: it is caught.
    """

    name = "go1catch"
    title = "Catch a Mouse"
    Params: ClassVar[type[TaskParams]] = CatchParams

    def scene(self) -> Scene:
        """Says what is in the world."""
        track = Track(blocks=(SpawnArea(1.5), Pillar(2.0), Plane(1.5), EndWall()), width=3.0, num_robots=1)
        return Scene(track, num_robots=1, contacts=Contacts(object=("trunk", "foot")), objects=(Mouse("mouse"),))

    def reset_objects(self, key: jax.Array, qpos: jax.Array, qvel: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Draws where the mouse starts."""
        place = jnp.array([3.8, 0.0]) + jax.random.uniform(key, (2,), minval=-0.5, maxval=0.5)
        return qpos.at[self.objects["mouse"].qpos].set(place), qvel

    def reset_task(self, key: jax.Array, robot_state: RobotState, data: mjx.Data, anchors: jax.Array) -> CatchState:
        """Returns the task's own fields of a fresh world."""
        return CatchState(self.distance(robot_state, data))

    def step_npcs(self, data: mjx.Data, robot_state: RobotState, key: jax.Array) -> mjx.Data:
        """Lets the mouse run."""
        velocity = flee(self.object_pose(data, "mouse"), robot_state.position_w[0, :2], self.params.mouse_speed)
        return data.replace(qvel=data.qvel.at[self.objects["mouse"].qvel].set(velocity))

    def distance(self, robot_state: RobotState, data: mjx.Data) -> jax.Array:
        """Returns the horizontal distance of the robot to the mouse (), m."""
        return jnp.linalg.norm(self.object_pose(data, "mouse") - robot_state.position_w[0, :2])

    @property
    def observation_layout(self) -> ObservationLayout:
        """The blocks of an agent's observation, in order."""
        return ObservationLayout((Block("base", 6, BASE_INFO), Block("mouse", 2, "x, y, m")))

    def observe(self, state: State, robot_state: RobotState) -> dict[str, jax.Array]:
        """Returns the observation's blocks by name (1, width)."""
        return {"base": robot_state.base_info, "mouse": self.object_pose(state.data, "mouse")[None]}

    def rewards(self, state: State, robot_state: RobotState, collision: jax.Array) -> tuple[dict[str, jax.Array], Any]:
        """Returns the reward terms and the task's fields after the step."""
        distance = self.distance(robot_state, state.data)
        terms = {"approach": state.task.distance - distance, "caught": distance < self.params.reach}
        return terms, CatchState(distance)

    def ending(self, state: State, robot_state: RobotState) -> jax.Array:
        """The mouse is caught."""
        return self.distance(robot_state, state.data) < self.params.reach

    def outcome(self, state: State, robot_state: RobotState, failed: jax.Array) -> dict[str, jax.Array]:
        """Success: the mouse is caught."""
        return {"success": self.ending(state, robot_state) & ~failed}


def plan_catch(obs: jax.Array) -> jax.Array:
    """Returns the robot's action (1, 3) from its observation (1, 8): past the pillar, then after the mouse."""
    position, yaw, mouse = obs[:, :2], obs[:, 5], obs[:, 6:8]
    side = jnp.where(mouse[:, 1:] < 0, -0.7, 0.7)
    before = position[:, :1] < 3.1
    goal = jnp.where(before, jnp.concatenate([position[:, :1] + 0.6, side], axis=-1), mouse)
    apart = goal - position
    return go_to(position, yaw, goal, jnp.arctan2(apart[:, 1], apart[:, 0]))


PLANNERS[Go1Catch.name] = plan_catch


def main() -> None:
    """Plays 32 episodes with the planner and prints how many mice it caught."""
    env = VectorEnv(make("go1catch", num_envs=32), 32)
    plan = jax.vmap(plan_catch)
    result = evaluate(env, lambda obs, memory, _: (plan(obs), memory), 32, jax.random.PRNGKey(0))
    print(f"caught {result.success_rate:.0%} of 32 mice, average step reward {result.average_step_reward:.3f}")


if __name__ == "__main__":
    main()
