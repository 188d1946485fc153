"""go1wrestling, the paper's Sumo Wrestling: two robots try to push each other out of a ring or tip each other over."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core.limits import Distance, Length, Positive, TimeLimit
from mqe_jax.core.settings import fail, record
from mqe_jax.envs.match import Duel
from mqe_jax.envs.params import TaskParams, check_above
from mqe_jax.envs.state import Moment, State
from mqe_jax.physics.appearance import grounds
from mqe_jax.physics.objects import Platform, Ring
from mqe_jax.physics.robots.index import RobotState
from mqe_jax.physics.scene import Scene
from mqe_jax.sensors.scene import Entity
from mqe_jax.terrain import Plane, SpawnArea, Track


@record
class WrestlingRewards:
    """Weights of the reward terms; `win` is zero-sum, the others are for training alone."""

    win: float = 10.0
    """When the opponent falls or leaves the ring, which ends the episode; minus the same of the opponent."""
    push: float = 0.0
    """Per m of increase of the opponent's distance from the ring's centre."""
    approach: float = 0.0
    """Per m of decrease of the distance between the robots."""


@record
class WrestlingParams(TaskParams):
    """Parameters of Sumo Wrestling."""

    episode_length: TimeLimit = 15.0
    spawn_height: Length = 0.74
    max_roll: Positive = 0.4 * np.pi
    platform: Platform = Platform(center=(3.1, 0.0, 0.4), size=(4.37, 4.37, 0.5))
    """The platform, with the ring in its centre; its lower part is below the ground. Robots dropped from the spawn
    height land on their feet."""
    ring_radius: Length = 1.7
    """Radius of the ring, m."""
    ring_depth: Distance = 0.2
    """Distance of a trunk below the platform's top at which the robot counts as out, m."""
    spawn_y: Distance = 1.0
    """Distance of the robots from the ring's centre, m; the first robot is on the side of negative y."""
    head_start: Distance = 0.0
    """Curriculum: both robots start up to head_start x `State.assistance` further along y, m, to a side drawn at
    random, so that one is near the edge of the ring. Inactive at assistance 0."""
    rewards: WrestlingRewards = WrestlingRewards()
    """Weights of the reward terms."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_above(self.spawn_height, self.platform.center[2], self.robot)
        room = self.ring_radius - self.spawn_y - self.spawn_noise
        if self.head_start > max(room, 0.0):
            fail("head_start", self.head_start, f"at most {room:.2f}, the distance of the robots from the ring's edge")


class Go1Wrestling(Duel[None, WrestlingParams]):
    """Sumo Wrestling.

    - Scene: a platform with a ring of 3.4 m diameter marked on it; the robots face each other, 2 m apart.
    - Observation: own base info 6, the opponent's base info 6, in the agent's own frame.
    - Reward: see `WrestlingRewards`.
    - End: a robot has fallen or left the ring, or 15 s. Win: only the opponent has.

    Source: paper, section III.
    """

    name = "go1wrestling"
    title = "Sumo Wrestling"
    aim = "Push the opponent out of the ring, or over."
    Params = WrestlingParams

    @property
    def center(self) -> tuple[float, float]:
        """The centre of the ring, m."""
        return self.params.platform.center[:2]

    def scene(self) -> Scene:
        params = self.params
        ring = Ring(center=params.platform.center, radius=params.ring_radius)
        ground = grounds.dohyo(params.platform.center, params.platform.size, params.ring_radius)
        blocks = (SpawnArea(2.0, back_wall=False), Plane(4.2))
        track = Track(blocks=blocks, width=6.0, walled=False, ground=ground)
        return Scene(track, num_robots=2, objects={"platform": params.platform, "ring": ring}, colors=(0, 2))

    def spawn_poses(self) -> Sequence[tuple[float, float, float]]:
        """Facing each other across the ring."""
        (x, y), apart = self.center, self.params.spawn_y
        return (x, y - apart, 0.5 * np.pi), (x, y + apart, -0.5 * np.pi)

    def reset_objects(
        self, key: jax.Array, qpos: jax.Array, qvel: jax.Array, assistance: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Moves both robots by the head start."""
        if not self.params.head_start:
            return qpos, qvel
        side = self.params.head_start * assistance * jax.random.uniform(key, minval=-1.0)
        return qpos.at[self.index.base_qpos[:, 1]].add(side), qvel

    @property
    def entities(self) -> tuple[Entity, ...]:
        """The ring, in whose centre the platform is too."""
        return (Entity("ring", "ring"),)

    def rewards(self, before: Moment, after: Moment, collision: jax.Array) -> dict[str, jax.Array]:
        outward = self.distance(after.robots) - self.distance(before.robots)
        apart = [jnp.linalg.norm(now.robots.position_w[0] - now.robots.position_w[1]) for now in (before, after)]
        wins = self.zero_sum(self.wins(after.state, after.robots))
        return {"win": wins, "push": outward[::-1], "approach": apart[0] - apart[1]}

    def distance(self, robot_state: RobotState) -> jax.Array:
        """Returns each robot's horizontal distance from the ring's centre (2,), m."""
        return jnp.linalg.norm(robot_state.position_w[:, :2] - jnp.array(self.center), axis=-1)

    def eliminated(self, robot_state: RobotState) -> jax.Array:
        """Returns which robots have fallen or left the ring (2,) bool."""
        params = self.params
        below = robot_state.position_w[:, 2] < params.platform.center[2] - params.ring_depth
        out = (self.distance(robot_state) > params.ring_radius) | below
        return self.fallen(robot_state) | robot_state.count(out)

    def ending(self, state: State, robot_state: RobotState) -> jax.Array:
        """The episode ends when a robot has fallen or left the ring."""
        return jnp.any(self.eliminated(robot_state))
