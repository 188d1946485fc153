"""go1tug, the paper's Push Cylinder: two robots push a cylinder, which slides one way only, towards each other."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from mqe_jax.envs.base import State
from mqe_jax.envs.match import Duel
from mqe_jax.envs.observation import BASE_INFO, Block, ObservationLayout
from mqe_jax.envs.params import TaskParams
from mqe_jax.objects import Cylinder
from mqe_jax.robots.build import Contacts
from mqe_jax.robots.index import RobotState
from mqe_jax.scene import Scene
from mqe_jax.terrain import EndWall, SpawnArea, Plane, Track

_START_X = 0.1  # m, where the arena starts


@dataclasses.dataclass(frozen=True)
class TugRewards:
    """Weights of the reward terms; every side's own less the opponent's.

    Attributes:
        push: per m that the cylinder is on the opponent's half, in every step; half of it in steps in which it moves
            back.
        approach: per m by which the robot came closer to the cylinder's axis.
    """

    push: float = 10.0
    approach: float = 2.0


@dataclasses.dataclass(frozen=True)
class TugParams(TaskParams):
    """Parameters of Push Cylinder.

    Attributes:
        arena: extents along x and y, m; it starts at x 0.1.
        radius: of the cylinder, m.
        height: of the cylinder, m.
        mass: of the cylinder, kg.
        cylinder_friction: sliding friction of the cylinder with the ground.
        spawn_x: half-width of the range in which the robots start along x, m; the first starts on the side of -y.
        spawn_y: distance of the robots from the middle line, m.
        win_by: a side wins when the cylinder is so far on the opponent's half at the end, m.
        rewards: weights.
    """

    episode_length: float = 15.0
    spawn_height: float = 0.34
    spawn_noise: float = 0.0
    arena: tuple[float, float] = (3.0, 6.0)
    radius: float = 1.2
    height: float = 0.5
    mass: float = 3.0
    cylinder_friction: float = 1.0
    spawn_x: float = 1.0
    spawn_y: float = 2.5
    win_by: float = 0.1
    rewards: TugRewards = TugRewards()


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TugState:
    """After the last step: `y` of the cylinder (), m, and each robot's `distance` to its axis (2,), m.

    `previous_y` is the cylinder's y one step before.
    """

    y: jax.Array
    previous_y: jax.Array
    distance: jax.Array


class Go1Tug(Duel):
    """Push Cylinder.

    - Scene: a closed arena with a cylinder of 3 kg that slides along y; a robot on each side of it.
    - Observation, own side first: own base info 6, the cylinder's y and speed, distance to its axis, its last y.
    - Reward: see `TugRewards`; zero-sum.
    - End: a fall, or 15 s. Win: the cylinder is on the opponent's half at the end, or the opponent falls.

    Source: paper, section III.
    """

    name = "go1tug"
    title = "Push Cylinder"
    Params: ClassVar[type[TaskParams]] = TugParams

    @property
    def center(self) -> tuple[float, float]:
        """The middle of the arena, m."""
        return _START_X + self.params.arena[0] / 2, 0.0

    def scene(self) -> Scene:
        """Says what is in the world."""
        params = self.params
        length, width = params.arena
        track = Track(blocks=(Plane(_START_X), SpawnArea(length), EndWall()), width=width)
        reach = width / 2 - params.radius
        cylinder = Cylinder(
            "cylinder", position=self.center, radius=params.radius, height=params.height, mass=params.mass,
            friction=params.cylinder_friction, reach=reach,
        )  # fmt: skip
        contacts = Contacts(robot=("trunk",), object=("trunk", "foot", "calf"))
        return Scene(track, num_robots=2, contacts=contacts, objects=(cylinder,), colors=(0, 2))

    def spawn_poses(self) -> Sequence[tuple[float, float, float]]:
        """Says where the robots start, x, y, yaw of each, m and rad: one on each side, facing the middle."""
        x, apart = self.center[0], self.params.spawn_y
        return (x, -apart, 0.5 * np.pi), (x, apart, -0.5 * np.pi)

    def spawn(self, key: jax.Array) -> jax.Array:
        """Draws poses x, y, z, yaw (2, 4), m and rad: one on each side, facing the middle."""
        params = self.params
        aside = jax.random.uniform(key, (2,), minval=-params.spawn_x, maxval=params.spawn_x)
        return super().spawn(jax.random.fold_in(key, 1)).at[:, 0].add(aside)

    def reset_task(self, key: jax.Array, robot_state: RobotState, data: mjx.Data, anchors: jax.Array) -> TugState:
        """Returns the task's own fields of a fresh world."""
        y = self.cylinder_y(data)
        return TugState(y, y, self.distance(robot_state, y))

    def cylinder_y(self, data: mjx.Data) -> jax.Array:
        """Returns the cylinder's y (), m."""
        return self.object_pose(data, "cylinder")[0]

    def distance(self, robot_state: RobotState, y: jax.Array) -> jax.Array:
        """Returns each robot's horizontal distance to the cylinder's axis (2,), m."""
        axis = jnp.array([self.center[0], 0.0]).at[1].set(y)
        return jnp.linalg.norm(robot_state.position_w[:, :2] - axis, axis=-1)

    @property
    def observation_layout(self) -> ObservationLayout:
        """The blocks of an agent's observation, in order."""
        return ObservationLayout(
            (
                Block("base", 6, BASE_INFO),
                Block("cylinder", 2, "y, m, and its velocity, m/s"),
                Block("distance", 1, "to the cylinder's axis, m"),
                Block("last_cylinder", 1, "y one step before, m"),
            )
        )

    def observe(self, state: State, robot_state: RobotState) -> dict[str, jax.Array]:
        """Returns the observation's blocks by name (2, width), each in its agent's frame."""
        speed = state.data.qvel[self.objects["cylinder"].qvel[0]]
        side = jnp.array([1.0, -1.0])
        return {
            "base": super().observe(state, robot_state)["base"],
            "cylinder": jnp.stack([side * self.cylinder_y(state.data), side * speed], axis=-1),
            "distance": self.distance(robot_state, self.cylinder_y(state.data))[:, None],
            "last_cylinder": (side * state.task.previous_y)[:, None],
        }

    def rewards(self, state: State, robot_state: RobotState, collision: jax.Array) -> tuple[dict[str, jax.Array], Any]:
        """Returns the reward terms and the task's fields after the step."""
        y, side = self.cylinder_y(state.data), jnp.array([1.0, -1.0])
        back = side * (y - state.task.y) < 0
        distance = self.distance(robot_state, y)
        terms = {
            "push": self.zero_sum(jnp.maximum(side * y, 0.0) * jnp.where(back, 0.5, 1.0)),
            "approach": self.zero_sum(state.task.distance - distance),
        }
        return terms, TugState(y, state.task.y, distance)

    def leading(self, state: State, robot_state: RobotState) -> jax.Array:
        """The cylinder is on the opponent's half."""
        return self.cylinder_y(state.data) * jnp.array([1.0, -1.0]) > self.params.win_by
