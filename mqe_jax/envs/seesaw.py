"""go1seesaw, the paper's Climb on Seesaw: one robot keeps a seesaw tilted while the other walks up to a platform."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import jax
import jax.numpy as jnp

from mqe_jax.envs import reward
from mqe_jax.envs.base import QuadrupedEnv
from mqe_jax.envs.observation import PAIR, ObservationLayout, pair
from mqe_jax.envs.params import TaskParams
from mqe_jax.envs.state import Moment, State
from mqe_jax.objects import Platform, Seesaw
from mqe_jax.robots.index import RobotState
from mqe_jax.scene import Scene
from mqe_jax.settings import NonNegative, Positive, fail, record
from mqe_jax.terrain import EndWall, Plane, SpawnArea, Track

if TYPE_CHECKING:
    pass


@record
class SeesawRewards:
    """Weights of the reward terms."""

    success: float = 10.0
    """Per robot on the platform."""
    height: float = 1.0
    """Per m of the robots' summed heights above `height_base`."""
    progress: float = 5.0
    """Per m of the robots' summed displacement along x."""
    lateral_offset: float = -0.5
    """Per m^2 of the robots' summed squared distances from the centre line above `lateral_offset_base`."""
    collision: float = -2.0
    """In steps with any trunk contact."""
    fall: float = -2.0
    """In steps in which any robot exceeds the roll or pitch limit."""
    crowding: float = -0.25
    """Per 1 / d^2 while the distance d between the robots is below 0.5 m, once for the pair."""


@record
class SeesawParams(TaskParams):
    """Parameters of Climb on Seesaw."""

    episode_length: Positive = 10.0
    min_height: float = 0.08
    end_on_collision: bool = True
    gait: str = "pace"
    track_width: Positive = 3.0
    """Track width, m."""
    hinge: tuple[float, float, float] = (5.6, 0.0, 0.545)
    """Position of the plank's hinge (x, y, z), m."""
    plank_size: tuple[Positive, Positive, Positive] = (4.123, 1.0, 0.03)
    """Length, width and thickness, m."""
    plank_behind: float = 0.103
    """Distance of the plank's centre from the hinge towards the near end, m."""
    plank_mass: Positive = 100.0
    """Plank mass, kg."""
    plank_inertia: Positive = 100.0
    """Plank inertia about the hinge, kg m^2."""
    plank_limit: Positive = 0.254
    """Maximum |angle|, rad."""
    plank_damping: NonNegative = 1000.0
    """Damping of the plank's hinge, N m s/rad."""
    plank_start: float = -0.25
    """Angle at reset, rad; negative with the near end down."""
    platform: tuple[float, float, float] = (8.0, 0.0, 1.0)
    """Centre of the platform's top face (x, y, z), m."""
    platform_size: tuple[Positive, Positive, Positive] = (1.0, 1.0, 0.03)
    """Full extents, m."""
    platform_column: NonNegative = 0.2
    """Radius of the column under the platform, m."""
    on_platform: tuple[float, float] = (7.7, 1.2)
    """X and z beyond which a robot counts as on the platform, m."""
    height_base: float = 0.56
    """Summed height of the robots at which the height term is zero, m."""
    lateral_offset_base: float = 0.5
    """Summed squared distance from the centre line at which the `lateral_offset` term is zero, m^2."""
    rewards: SeesawRewards = SeesawRewards()
    """Weights of the reward terms."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if abs(self.plank_start) > self.plank_limit:
            fail("plank_start", self.plank_start, f"within +-plank_limit, {self.plank_limit}")


class Go1Seesaw(QuadrupedEnv):
    """Climb on Seesaw.

    - Scene: a track 3 m wide with a balanced plank whose near end is on the ground and whose far end reaches a
      platform 1 m high. A robot beyond the hinge tips the plank unless another stands on the near end.
    - Observation: one-hot 2, own base info 6, teammate's base info 6.
    - Reward: see `SeesawRewards`; shared.
    - End: a fall, a trunk below 0.08 m, a collision, or 10 s. Success: a robot stands on the platform at the end.

    Source: paper, section III and table of rewards.
    """

    name = "go1seesaw"
    title = "Climb on Seesaw"
    Params: ClassVar[type[TaskParams]] = SeesawParams

    def scene(self) -> Scene:
        params = self.params
        track = Track(blocks=(SpawnArea(2.0), Plane(8.0), EndWall()), width=params.track_width)
        plank = Seesaw(
            "seesaw",
            hinge=params.hinge,
            size=params.plank_size,
            behind=params.plank_behind,
            mass=params.plank_mass,
            inertia=params.plank_inertia,
            limit=params.plank_limit,
            damping=params.plank_damping,
        )
        platform = Platform(
            "platform", center=params.platform, size=params.platform_size, column=params.platform_column
        )
        # Plank and platform use the ground's collision bits.
        return Scene(track, num_robots=2, objects=(plank, platform))

    def reset_objects(
        self, key: jax.Array, qpos: jax.Array, qvel: jax.Array, assistance: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Places the plank at its initial angle, with the near end on the ground."""
        return qpos.at[self.objects["seesaw"].qpos].set(self.params.plank_start), qvel

    @property
    def observation_layout(self) -> ObservationLayout:
        return ObservationLayout(PAIR)

    def observe(self, state: State, robot_state: RobotState) -> dict[str, jax.Array]:
        return pair(robot_state.base_info)

    def on_platform(self, robot_state: RobotState) -> jax.Array:
        """Returns which robots are on the platform (2,) bool."""
        x, z = self.params.on_platform
        return (robot_state.position_w[:, 0] > x) & (robot_state.position_w[:, 2] > z)

    def rewards(self, before: Moment, after: Moment, collision: jax.Array) -> dict[str, jax.Array]:
        params = self.params
        robots = after.robots
        x, y, z = robots.position_w.T
        roll, pitch = jnp.abs(robots.euler[:, 0]), jnp.abs(robots.euler[:, 1])
        return {
            "success": jnp.sum(self.on_platform(robots)).astype(jnp.float32),
            "height": jnp.sum(z) - params.height_base,
            "progress": jnp.sum(x - before.robots.position_w[:, 0]),
            "lateral_offset": jnp.sum(jnp.square(y)) - params.lateral_offset_base,
            "collision": collision.astype(jnp.float32),
            "fall": jnp.any((roll > params.max_roll) | (pitch > params.max_pitch)).astype(jnp.float32),
            "crowding": reward.crowding(robots.position_w[:, :2]) / 2,
        }

    def outcome(self, state: State, robot_state: RobotState, failed: jax.Array) -> dict[str, jax.Array]:
        """Success: a robot stands on the platform; `success/height`: height of the highest robot, m."""
        success = jnp.any(self.on_platform(robot_state)) & ~failed
        return {"success": success, "success/height": jnp.max(robot_state.position_w[:, 2])}
