"""go1revolvingdoor, the paper's Revolving Door: two robots compete to pass a narrow door.

The door is wide enough for one.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from mqe_jax.core.limits import Coordinate, Distance, Length, TimeLimit
from mqe_jax.core.settings import fail, settings_class
from mqe_jax.envs.match import Duel
from mqe_jax.envs.params import TaskParams, check_gap
from mqe_jax.envs.state import Moment, State
from mqe_jax.physics.appearance import grounds
from mqe_jax.physics.objects import Door
from mqe_jax.physics.robots.index import RobotState
from mqe_jax.physics.scene import Scene
from mqe_jax.terrain import EndWall, Gate, Plane, SpawnArea, Track

_WALL_LENGTH = 1.0  # m along x, of the block with the door at its centre


@settings_class
class DoorRewards:
    """Weights of the reward terms; each is a robot's own term minus the opponent's."""

    win: float = 10.0
    """In the step in which the robot crosses the line first, or the opponent falls."""
    approach: float = 1.0
    """Per m of decrease of the distance to the midpoint of the line."""


@settings_class
class DoorParams(TaskParams):
    """Parameters of Revolving Door."""

    episode_length: TimeLimit = 5.0
    track_width: Length = 3.5
    """Width of the track, m."""
    gap: Length = 2.0
    """Width of the gap that holds the door, m."""
    door: Door = Door()
    """The door in the gap."""
    spawn_x: Coordinate = 0.5
    """X of the robots' spawn poses, m."""
    spawn_y: Distance = 1.0
    """Distance of the robots from the centre line, m."""
    line_x: Coordinate = 3.85
    """X of the finish line, m."""
    rewards: DoorRewards = DoorRewards()
    """Weights of the reward terms."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_gap("gap", self.gap, self.track_width)
        if self.door.size[1] >= self.gap:
            fail("door.size", self.door.size, f"narrower than the gap, {self.gap}")
        if self.door.position[0] <= _WALL_LENGTH / 2:
            fail("door.position", self.door.position, f"at an x greater than {_WALL_LENGTH / 2}")


class Go1RevolvingDoor(Duel[None, DoorParams]):
    """Revolving Door.

    - Scene: a wall with a gap of 2 m that holds a door on a central hinge; both robots start on the
      same side.
    - Observation, mirrored for the second robot: own base info 6, the opponent's base info 6.
    - Reward: see `DoorRewards`; zero-sum.
    - End: a robot is past the line, a fall, or 5 s. Win: past the line first, or the opponent
      falls.

    Source: paper, section III.
    """

    name = "go1revolvingdoor"
    title = "Revolving Door"
    aim = "Be the first through the revolving door."
    symmetry = "reflect"
    Params = DoorParams

    def scene(self) -> Scene:
        params = self.params
        wall = Gate(_WALL_LENGTH, width=params.gap)
        blocks = (
            SpawnArea(params.door.position[0] - _WALL_LENGTH / 2),
            wall,
            Plane(2.5),
            EndWall(),
        )
        colors = (0, 2)
        half = params.track_width / 2
        marks = (
            *grounds.pads(self.spawn_poses(), colors),
            *grounds.finish(params.line_x, (-half, half)),
        )
        length = params.door.position[0] + 3.0
        ground = grounds.track((0.0, length), params.track_width, 2, marks, grounds.COURT)
        track = Track(blocks=blocks, width=params.track_width, wall_height=0.85, ground=ground)
        return Scene(track, num_robots=2, objects={"door": params.door}, colors=colors)

    def spawn_poses(self) -> Sequence[tuple[float, float, float]]:
        """Side by side in front of the door."""
        x = self.params.spawn_x
        y = self.params.spawn_y
        return (x, -y, 0.0), (x, y, 0.0)

    def distance(self, robot_state: RobotState) -> jax.Array:
        """Returns each robot's horizontal distance to the midpoint of the line (2,), m."""
        return jnp.linalg.norm(
            robot_state.position_w[:, :2] - jnp.array([self.params.line_x, 0.0]), axis=-1
        )

    def rewards(self, before: Moment, after: Moment, collision: jax.Array) -> dict[str, jax.Array]:
        return {
            "win": self.zero_sum(self.wins(after.state, after.robots)),
            "approach": self.zero_sum(self.distance(before.robots) - self.distance(after.robots)),
        }

    def leading(self, state: State, robot_state: RobotState) -> jax.Array:
        """A robot leads while it is past the line."""
        return robot_state.count(robot_state.position_w[:, 0] > self.params.line_x)

    def ending(self, state: State, robot_state: RobotState) -> jax.Array:
        """The episode ends when a robot is past the line."""
        return jnp.any(self.leading(state, robot_state))
