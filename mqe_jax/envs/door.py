"""go1revolvingdoor, the paper's Revolving Door: two robots race through a door that lets one pass at a time."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from mujoco import mjx

from mqe_jax.envs.base import State
from mqe_jax.envs.match import Duel
from mqe_jax.envs.params import TaskParams
from mqe_jax.objects import Door
from mqe_jax.robots.build import Contacts
from mqe_jax.robots.index import RobotState
from mqe_jax.scene import Scene
from mqe_jax.terrain import EndWall, SpawnArea, Plane, DoorGap, Track


@dataclasses.dataclass(frozen=True)
class DoorRewards:
    """Weights of the reward terms; every side's own less the opponent's.

    Attributes:
        win: for being the first past the line, or if the opponent falls.
        approach: per m by which the robot came closer to the line's middle.
    """

    win: float = 10.0
    approach: float = 1.0


@dataclasses.dataclass(frozen=True)
class DoorParams(TaskParams):
    """Parameters of Revolving Door.

    Attributes:
        track_width: m.
        gap: width of the gap that the door stands in, m.
        door_x: of the hinge, m.
        door_size: thickness, width and height of the door, m.
        door_mass: kg.
        door_inertia: about the hinge, kg m^2.
        door_damping: of the hinge, N m s/rad.
        spawn_x: of the robots, m.
        spawn_y: distance of the robots from the middle line, m.
        line_x: who is first past it wins, m.
        rewards: weights.
    """

    episode_length: float = 5.0
    track_width: float = 3.5
    gap: float = 2.0
    door_x: float = 2.6
    door_size: tuple[float, float, float] = (0.08, 1.95, 0.8)
    door_mass: float = 4.0
    door_inertia: float = 1.232
    door_damping: float = 0.5
    spawn_x: float = 0.5
    spawn_y: float = 1.0
    line_x: float = 3.85
    rewards: DoorRewards = DoorRewards()


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class DoorState:
    """`distance`: of each robot to the middle of the line after the last step (2,), m."""

    distance: jax.Array


class Go1RevolvingDoor(Duel):
    """Revolving Door.

    - Scene: a wall with a gap of 2 m in which a door turns about its middle; both robots on the same side.
    - Observation, the first on the right in its own view: own base info 6, the other's base info 6.
    - Reward: see `DoorRewards`; zero-sum.
    - End: one is past the line, a fall, or 5 s. Win: past the line first, or the opponent falls.

    Source: paper, section III.
    """

    name = "go1revolvingdoor"
    title = "Revolving Door"
    symmetry = "reflect"
    Params: ClassVar[type[TaskParams]] = DoorParams

    def scene(self) -> Scene:
        """Says what is in the world."""
        params = self.params
        wall = DoorGap(1.0, width=params.gap)
        blocks = (SpawnArea(params.door_x - 0.5), wall, Plane(2.5), EndWall())
        door = Door(
            "door", position=(params.door_x, 0.0), size=params.door_size, mass=params.door_mass,
            inertia=params.door_inertia, damping=params.door_damping,
        )  # fmt: skip
        contacts = Contacts(robot=("trunk", "foot"), object=("trunk", "foot", "calf"))
        return Scene(
            Track(blocks=blocks, width=params.track_width, wall_height=0.85), num_robots=2, contacts=contacts,
            objects=(door,), colors=(0, 2),
        )  # fmt: skip

    def spawn_poses(self) -> Sequence[tuple[float, float, float]]:
        """Says where the robots start, x, y, yaw of each, m and rad: side by side before the door."""
        x, y = self.params.spawn_x, self.params.spawn_y
        return (x, -y, 0.0), (x, y, 0.0)

    def reset_task(self, key: jax.Array, robot_state: RobotState, data: mjx.Data, anchors: jax.Array) -> DoorState:
        """Returns the task's own fields of a fresh world."""
        return DoorState(self.distance(robot_state))

    def distance(self, robot_state: RobotState) -> jax.Array:
        """Returns each robot's horizontal distance to the middle of the line (2,), m."""
        return jnp.linalg.norm(robot_state.position_w[:, :2] - jnp.array([self.params.line_x, 0.0]), axis=-1)

    def rewards(self, state: State, robot_state: RobotState, collision: jax.Array) -> tuple[dict[str, jax.Array], Any]:
        """Returns the reward terms and the task's fields after the step."""
        distance = self.distance(robot_state)
        terms = {
            "win": self.zero_sum(self.wins(state, robot_state)),
            "approach": self.zero_sum(state.task.distance - distance),
        }
        return terms, DoorState(distance)

    def leading(self, state: State, robot_state: RobotState) -> jax.Array:
        """Past the line."""
        return robot_state.position_w[:, 0] > self.params.line_x

    def ending(self, state: State, robot_state: RobotState) -> jax.Array:
        """One is past the line."""
        return jnp.any(self.leading(state, robot_state))
