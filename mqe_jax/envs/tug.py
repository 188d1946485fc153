"""go1tug, the paper's Push Cylinder: two robots push a cylinder towards each other.

The cylinder slides along one axis.
"""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core import keys
from mqe_jax.core.limits import Buffer, Distance, Length, TimeLimit
from mqe_jax.core.settings import fail, settings_class
from mqe_jax.envs.match import Duel
from mqe_jax.envs.observation import BASE, Block, ObservationLayout
from mqe_jax.envs.params import TaskParams
from mqe_jax.envs.state import Moment, State
from mqe_jax.physics.appearance import grounds
from mqe_jax.physics.objects import Cylinder
from mqe_jax.physics.robots.index import RobotState
from mqe_jax.physics.scene import Scene
from mqe_jax.terrain import EndWall, Plane, SpawnArea, Track

if TYPE_CHECKING:
    from mujoco import mjx

_START_X = 0.1  # m, x of the arena's near wall


@settings_class
class TugRewards:
    """Weights of the reward terms; each is a robot's own term minus the opponent's."""

    push: float = 10.0
    """Per m of the cylinder's position on the opponent's half, in every step; halved in steps in
    which it moves back.
    """
    approach: float = 2.0
    """Per m of decrease of the distance to the cylinder's axis."""


@settings_class
class TugParams(TaskParams):
    """Parameters of Push Cylinder."""

    episode_length: TimeLimit = 15.0
    spawn_height: Length = 0.34
    spawn_noise: Distance = 0.0
    contacts_per_robot: Buffer = 16  # on Warp also pairs that the wide cylinder comes near
    cylinder: Cylinder = Cylinder()
    """The cylinder. The arena is centred on it; its side walls are where the cylinder's reach
    ends."""
    spawn_x: Distance = 1.0
    """Half-width of the range of the robots' initial x about the arena's centre, m."""
    spawn_y: Distance = 2.5
    """Distance of the robots from the centre line, m; the first robot is on the side of negative
    y."""
    win_distance: Distance = 0.1
    """Minimum distance of the cylinder on the opponent's half at the end of the episode for a win,
    m."""
    rewards: TugRewards = TugRewards()
    """Weights of the reward terms."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.cylinder.x <= _START_X:
            fail("cylinder.x", self.cylinder.x, f"greater than that of the near wall, {_START_X}")


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TugState:
    """The task's own state."""

    previous_y: jax.Array  # y of the cylinder one step earlier (), m


class Go1Tug(Duel[TugState, TugParams]):
    """Push Cylinder.

    - Scene: a closed arena with a cylinder of 3 kg that slides along y; a robot on each side of it.
    - Observation, in the agent's own frame: own base info 6, the cylinder's y and its velocity,
      distance to its axis, its previous y.
    - Reward: see `TugRewards`; zero-sum.
    - End: a fall, or 15 s. Win: the cylinder is on the opponent's half at the end, or the opponent
      falls.

    Source: paper, section III.
    """

    name = "go1tug"
    title = "Push Cylinder"
    aim = "Have the cylinder on the opponent's half when time is up."
    Params = TugParams

    @property
    def center(self) -> tuple[float, float]:
        """The centre of the arena, m."""
        return self.params.cylinder.x, 0.0

    def scene(self) -> Scene:
        cylinder = self.params.cylinder
        length = 2 * (cylinder.x - _START_X)
        width = 2 * (cylinder.reach + cylinder.radius)
        ground = grounds.halves((_START_X, _START_X + length), (-width / 2, width / 2))
        track = Track(
            blocks=(Plane(_START_X), SpawnArea(length), EndWall()), width=width, ground=ground
        )
        return Scene(track, num_robots=2, objects={"cylinder": cylinder}, colors=(0, 2))

    def spawn_poses(self) -> Sequence[tuple[float, float, float]]:
        """One robot on each side, facing the centre."""
        x = self.center[0]
        apart = self.params.spawn_y
        return (x, -apart, 0.5 * np.pi), (x, apart, -0.5 * np.pi)

    def spawn(self, key: jax.Array) -> jax.Array:
        """Samples spawn poses as the base class does, with a wider range along x."""
        params = self.params
        shift = jax.random.uniform(key, (2,), minval=-params.spawn_x, maxval=params.spawn_x)
        return super().spawn(jax.random.fold_in(key, keys.SECOND)).at[:, 0].add(shift)

    @property
    def spreads(self) -> dict[str, tuple[Any, float]]:
        params = self.params
        return {**super().spreads, "spawn_x": ([self.center], params.spawn_x + params.spawn_noise)}

    def reset_task(self, key: jax.Array, state: State, robot_state: RobotState) -> TugState:
        return TugState(self.cylinder_y(state.data))

    def step_task(self, before: Moment[TugState], after: Moment[TugState]) -> TugState:
        return TugState(self.cylinder_y(before.state.data))

    def cylinder_y(self, data: "mjx.Data") -> jax.Array:
        """Returns the cylinder's y (), m."""
        return self.object_pose(data, "cylinder")[1]

    def distance(self, now: Moment[TugState]) -> jax.Array:
        """Returns each robot's horizontal distance to the cylinder's axis (2,), m."""
        axis = jnp.array([self.center[0], 0.0]).at[1].set(self.cylinder_y(now.state.data))
        return jnp.linalg.norm(now.robots.position_w[:, :2] - axis, axis=-1)

    @property
    def observation_layout(self) -> ObservationLayout:
        meaning = "y, m, and its velocity, m/s"
        return ObservationLayout(
            (
                BASE,
                Block("cylinder", 2, meaning, quantities=("objects", "velocity")),
                Block("distance", 1, "to the cylinder's axis, m", quantities=("objects",)),
                Block("previous_cylinder", 1, "y one step earlier, m", quantities=("objects",)),
            )
        )

    def observe(self, state: State[TugState], robot_state: RobotState) -> dict[str, jax.Array]:
        """Blocks (2, width), each in its agent's own frame."""
        speed = state.data.qvel[self.objects["cylinder"].qvel[0]]
        side = jnp.array([1.0, -1.0])
        return {
            "base": super().observe(state, robot_state)["base"],
            "cylinder": jnp.stack([side * self.cylinder_y(state.data), side * speed], axis=-1),
            "distance": self.distance(Moment(state, robot_state))[:, None],
            "previous_cylinder": (side * state.task.previous_y)[:, None],
        }

    def rewards(
        self, before: Moment[TugState], after: Moment[TugState], collision: jax.Array
    ) -> dict[str, jax.Array]:
        y = self.cylinder_y(after.state.data)
        side = jnp.array([1.0, -1.0])
        back = side * (y - self.cylinder_y(before.state.data)) < 0
        return {
            "push": self.zero_sum(jnp.maximum(side * y, 0.0) * jnp.where(back, 0.5, 1.0)),
            "approach": self.zero_sum(self.distance(before) - self.distance(after)),
        }

    def leading(self, state: State[TugState], robot_state: RobotState) -> jax.Array:
        """A robot leads while the cylinder is on the opponent's half."""
        return self.cylinder_y(state.data) * jnp.array([1.0, -1.0]) > self.params.win_distance
