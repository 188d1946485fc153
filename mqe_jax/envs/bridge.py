"""go1bridge, the paper's Traverse Bridge: two robots meet on a bridge wide enough for one."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core.limits import Coordinate, Length, TimeLimit
from mqe_jax.core.settings import Coordinates, fail, settings_class
from mqe_jax.envs.match import Duel
from mqe_jax.envs.params import TaskParams
from mqe_jax.envs.state import Moment, State
from mqe_jax.physics.appearance import grounds
from mqe_jax.physics.objects import Platform
from mqe_jax.physics.robots.index import RobotState
from mqe_jax.physics.robots.robot import Proportions
from mqe_jax.physics.scene import Scene
from mqe_jax.sensors.scene import Entity
from mqe_jax.terrain import Plane, SpawnArea, Track


@settings_class
class BridgeRewards:
    """Weights of the reward terms; each is a robot's own term minus the opponent's."""

    win: float = 10.0
    """In steps in which the opponent is off the bridge or has fallen."""
    far_side: float = 1.0
    """In steps in which the robot is on the opponent's platform."""


@settings_class
class BridgeParams(TaskParams):
    """Parameters of Traverse Bridge."""

    episode_length: TimeLimit = 20.0
    spawn_height: Length = 1.4
    platform: tuple[Length, Length] = (1.3, 2.5)
    """Extents of both platforms along x and y, m; their long sides are perpendicular to the bridge,
    as in the paper's figure."""
    platform_x: Coordinates = (2.35, 7.65)
    """X of the platforms' centres, m."""
    top: Length = 1.02
    """Height of platforms and bridge, m."""
    bridge_width: Length = 0.7
    """Width of the bridge, m."""
    bridge_thickness: Length = 0.3
    """Thickness of the bridge, m."""
    spawn_x: Coordinates = (2.5, 7.5)
    """X of the robots' spawn poses, m. The released system spawns the first robot at 2.0, with its
    hind feet on the platform's edge; here the two poses are symmetric."""
    off_height: Coordinate = 0.5
    """Height of a trunk below which a robot counts as off the bridge, m."""
    rewards: BridgeRewards = BridgeRewards()
    """Weights of the reward terms."""

    def scaled(self, body: Proportions) -> dict[str, Any]:
        return super().scaled(body) | {"bridge_width": self.bridge_width * body.width}

    def __post_init__(self) -> None:
        super().__post_init__()
        first, second = self.platform_x
        if second - first <= self.platform[0]:
            fail(
                "platform_x",
                self.platform_x,
                f"more than a platform's length, {self.platform[0]}, apart",
            )
        away = np.abs(np.subtract(self.spawn_x, self.platform_x)).max()
        room = min(self.platform[0] / 2 - away, self.platform[1] / 2)
        if self.spawn_noise > room:
            allowed = f"at most {room:.2f}, the distance to the platform's edge"
            fail("spawn_noise", self.spawn_noise, allowed)

    @property
    def ground(self) -> float:
        return self.top


class Go1Bridge(Duel[None, BridgeParams]):
    """Traverse Bridge.

    - Scene: two platforms, 1 m high, joined by a bridge 0.7 m wide; one robot is spawned on each.
    - Observation: own base info 6, the opponent's base info 6, in the agent's own frame.
    - Reward: see `BridgeRewards`; zero-sum.
    - End: a robot is off the bridge or has fallen, or 20 s. Win: the opponent is off or has fallen,
      or at the time limit only this robot is on the other's platform.

    Source: paper, section III.
    """

    name = "go1bridge"
    title = "Traverse Bridge"
    aim = "Push the opponent off the bridge, or stand on the other side when time is up."
    Params = BridgeParams

    @property
    def center(self) -> tuple[float, float]:
        """The midpoint between the platforms, m."""
        return sum(self.params.platform_x) / 2, 0.0

    def scene(self) -> Scene:
        params = self.params
        first, second = params.platform_x
        length, width = params.platform
        objects = {
            f"platform{side}": Platform(
                center=(x, 0.0, params.top), size=(length, width, params.top)
            )
            for side, x in enumerate(params.platform_x)
        }
        middle = (*self.center, params.top)
        span = second - first - length
        objects["deck"] = Platform(
            center=middle, size=(span, params.bridge_width, params.bridge_thickness)
        )
        ends = (first + length / 2, second - length / 2)
        ground = grounds.river(
            params.platform_x, ends, (length, width, params.bridge_width), params.top
        )
        blocks = (SpawnArea(2.0, back_wall=False), Plane(8.0))
        track = Track(blocks=blocks, width=6.0, walled=False, ground=ground)
        return Scene(track, num_robots=2, objects=objects, colors=(0, 2))

    def spawn_poses(self) -> Sequence[tuple[float, float, float]]:
        """One robot on each platform, facing the bridge."""
        first, second = self.params.spawn_x
        return (first, 0.0, 0.0), (second, 0.0, np.pi)

    @property
    def entities(self) -> tuple[Entity, ...]:
        """The two platforms."""
        return Entity("platform", "platform0"), Entity("platform", "platform1")

    def rewards(self, before: Moment, after: Moment, collision: jax.Array) -> dict[str, jax.Array]:
        out = self.eliminated(after.state, after.robots)
        return {
            "win": self.zero_sum(out[::-1] & ~out),
            "far_side": self.zero_sum(self.across(after.robots)),
        }

    def eliminated(self, state: State, robot_state: RobotState) -> jax.Array:
        """Returns which robots are off the bridge or have fallen (2,) bool."""
        return self.fallen(robot_state) | robot_state.count(
            robot_state.position_w[:, 2] < self.params.off_height
        )

    def across(self, robot_state: RobotState) -> jax.Array:
        """Returns which robots are on the opponent's platform (2,) bool."""
        params = self.params
        x = robot_state.position_w[:, 0]
        height = robot_state.position_w[:, 2]
        first, second = params.platform_x
        half = params.platform[0] / 2
        reached = jnp.stack([x[0] > second - half, x[1] < first + half])
        return robot_state.count(reached & (height > params.top))

    def leading(self, state: State, robot_state: RobotState) -> jax.Array:
        """A robot leads while it is on the opponent's platform."""
        return self.across(robot_state)

    def ending(self, state: State, robot_state: RobotState) -> jax.Array:
        """The episode ends when a robot is off the bridge or has fallen."""
        return jnp.any(self.eliminated(state, robot_state))
