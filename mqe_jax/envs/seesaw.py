"""go1seesaw, the paper's Climb on Seesaw: one robot keeps a seesaw tilted for the other.

The other robot walks up the seesaw to a platform.
"""

from typing import Any

import jax
import jax.numpy as jnp

from mqe_jax.core.limits import Coordinate, Length, TimeLimit
from mqe_jax.core.settings import fail, settings_class
from mqe_jax.envs import reward
from mqe_jax.envs.base import QuadrupedEnv
from mqe_jax.envs.observation import ObservationLayout, observe_team, team_blocks
from mqe_jax.envs.params import TaskParams
from mqe_jax.envs.state import Moment, State
from mqe_jax.physics.appearance import grounds
from mqe_jax.physics.objects import Platform, Seesaw
from mqe_jax.physics.robots.index import RobotState
from mqe_jax.physics.robots.robot import Proportions
from mqe_jax.physics.scene import Scene
from mqe_jax.terrain import EndWall, Plane, SpawnArea, Track


@settings_class
class SeesawRewards:
    """Weights of the reward terms."""

    success: float = 10.0
    """Per robot on the platform."""
    height: float = 1.0
    """Per m of the robots' summed heights above `height_base`."""
    progress: float = 5.0
    """Per m of the robots' summed displacement along x."""
    lateral_offset: float = -0.5
    """Per m^2 of the robots' summed squared distances from the centre line above
    `lateral_offset_base`."""
    collision: float = -2.0
    """In steps with any trunk contact."""
    fall: float = -2.0
    """In steps in which any robot exceeds the roll or pitch limit."""
    crowding: float = -0.25
    """Per 1 / d^2 while the distance d between the robots is below 0.5 m, once for the pair."""


@settings_class
class SeesawParams(TaskParams):
    """Parameters of Climb on Seesaw."""

    episode_length: TimeLimit = 10.0
    min_height: Coordinate = 0.08
    end_on_collision: bool = True
    gait: str | None = "pace"
    track_width: Length = 3.0
    """Track width, m."""
    plank: Seesaw = Seesaw()
    """The seesaw."""
    plank_start: Coordinate = -0.25
    """Angle at reset, rad; negative with the near end down."""
    platform: Platform = Platform(center=(8.0, 0.0, 1.0), size=(1.0, 1.0, 0.03), column=0.2)
    """The platform at the seesaw's far end."""
    on_platform: tuple[Coordinate, Coordinate] = (7.7, 1.2)
    """X and z beyond which a robot counts as on the platform, m."""
    height_base: Coordinate = 0.56
    """Summed height of the robots at which the height term is zero, m."""
    lateral_offset_base: Coordinate = 0.5
    """Summed squared distance from the centre line at which the `lateral_offset` term is zero,
    m^2."""
    rewards: SeesawRewards = SeesawRewards()
    """Weights of the reward terms."""

    def scaled(self, body: Proportions) -> dict[str, Any]:
        x, z = self.on_platform
        top = self.platform.center[2]
        heights = {"on_platform": (x, top + (z - top) * body.height)}
        return super().scaled(body) | heights | {"height_base": self.height_base * body.height}

    def __post_init__(self) -> None:
        super().__post_init__()
        if abs(self.plank_start) > self.plank.limit:
            fail("plank_start", self.plank_start, f"within +-plank.limit, {self.plank.limit}")


class Go1Seesaw(QuadrupedEnv[None, SeesawParams]):
    """Climb on Seesaw.

    - Scene: a track 3 m wide with a balanced plank whose near end is on the ground and whose far
      end reaches a platform 1 m high. A robot beyond the hinge tips the plank unless another stands
      on the near end.
    - Observation: one-hot 2, own base info 6, teammate's base info 6.
    - Reward: see `SeesawRewards`; shared.
    - End: a fall, a trunk below 0.08 m, a collision, or 10 s. Success: a robot stands on the
      platform at the end.

    Source: paper, section III and table of rewards.
    """

    name = "go1seesaw"
    title = "Climb on Seesaw"
    aim = "Get a robot onto the platform: one holds the plank down, the other climbs."
    Params = SeesawParams

    def scene(self) -> Scene:
        params = self.params
        blocks = (SpawnArea(2.0), Plane(8.0), EndWall())
        ground = grounds.climb(
            10.0, params.track_width, params.platform.center, params.platform.size
        )
        track = Track(blocks=blocks, width=params.track_width, ground=ground)
        # Plank and platform use the ground's collision bits.
        return Scene(
            track, num_robots=2, objects={"seesaw": params.plank, "platform": params.platform}
        )

    def reset_objects(
        self, key: jax.Array, qpos: jax.Array, qvel: jax.Array, assistance: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Places the plank at its initial angle, with the near end on the ground."""
        return qpos.at[self.objects["seesaw"].qpos].set(self.params.plank_start), qvel

    @property
    def observation_layout(self) -> ObservationLayout:
        return ObservationLayout(team_blocks(2))

    def observe(self, state: State, robot_state: RobotState) -> dict[str, jax.Array]:
        return observe_team(robot_state.base_info)

    def on_platform(self, robot_state: RobotState) -> jax.Array:
        """Returns which active robots are on the platform (2,) bool."""
        x, z = self.params.on_platform
        return (
            robot_state.active
            & (robot_state.position_w[:, 0] > x)
            & (robot_state.position_w[:, 2] > z)
        )

    def rewards(self, before: Moment, after: Moment, collision: jax.Array) -> dict[str, jax.Array]:
        params = self.params
        robots = after.robots
        x, y, z = robots.position_w.T
        roll = jnp.abs(robots.euler[:, 0])
        pitch = jnp.abs(robots.euler[:, 1])
        return {
            "success": jnp.sum(self.on_platform(robots)).astype(jnp.float32),
            "height": jnp.sum(robots.count(z)) - params.height_base,
            "progress": jnp.sum(robots.count(x - before.robots.position_w[:, 0])),
            "lateral_offset": jnp.sum(robots.count(jnp.square(y))) - params.lateral_offset_base,
            "collision": collision.astype(jnp.float32),
            "fall": jnp.any(
                robots.count((roll > params.max_roll) | (pitch > params.max_pitch))
            ).astype(jnp.float32),
            "crowding": reward.crowding(robots.position_w[:, :2], robots.active) / 2,
        }

    def outcome(
        self, state: State, robot_state: RobotState, failed: jax.Array
    ) -> dict[str, jax.Array]:
        """Success: a robot stands on the platform; `height`: height of the highest robot, m."""
        success = jnp.any(self.on_platform(robot_state)) & ~failed
        return {
            "success": success,
            "height": jnp.max(robot_state.count(robot_state.position_w[:, 2])),
        }
