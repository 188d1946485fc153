"""go1wrestling, the paper's Sumo Wrestling: two robots try to push or tip each other out of a ring."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.envs.base import State
from mqe_jax.envs.match import Duel
from mqe_jax.envs.params import TaskParams, check_above
from mqe_jax.objects import Platform, Ring
from mqe_jax.robots.build import Contacts
from mqe_jax.robots.index import RobotState
from mqe_jax.scene import Scene
from mqe_jax.terrain import SpawnArea, Plane, Track


@dataclasses.dataclass(frozen=True)
class WrestlingRewards:
    """Weights: `win`, of the side whose opponent falls or leaves the ring, less the opponent's."""

    win: float = 10.0


@dataclasses.dataclass(frozen=True)
class WrestlingParams(TaskParams):
    """Parameters of Sumo Wrestling.

    A robot has lost when its |roll| or |pitch| is over the limit, or its trunk is outside the ring or too low.

    Attributes:
        center: of platform and ring, m.
        platform: extents of the platform, m; a part of it is in the ground.
        platform_top: height of its top, m: where robots that are dropped from the listed height land on their feet.
        ring_radius: m.
        ring_depth: a trunk this far below the platform's top has left it, m.
        spawn_y: distance of the robots from the ring's middle, m; the first starts on the side of -y.
        rewards: weights.
    """

    episode_length: float = 15.0
    spawn_height: float = 0.74
    max_roll: float = 0.4 * np.pi
    center: tuple[float, float] = (3.1, 0.0)
    platform: tuple[float, float, float] = (4.37, 4.37, 0.5)
    platform_top: float = 0.4
    ring_radius: float = 1.7
    ring_depth: float = 0.2
    spawn_y: float = 1.0
    rewards: WrestlingRewards = WrestlingRewards()

    def __post_init__(self) -> None:
        super().__post_init__()
        check_above(self.spawn_height, self.platform_top)


class Go1Wrestling(Duel):
    """Sumo Wrestling.

    - Scene: a platform with a ring of 3.4 m marked on it; the robots face each other, 2 m apart.
    - Observation: own base info 6, the opponent's base info 6, in the agent's own frame.
    - Reward: see `WrestlingRewards`; zero-sum.
    - End: one has fallen or left the ring, or 15 s. Win: the opponent has, and oneself has not.

    Source: paper, section III.
    """

    name = "go1wrestling"
    title = "Sumo Wrestling"
    Params: ClassVar[type[TaskParams]] = WrestlingParams

    @property
    def center(self) -> tuple[float, float]:
        """The ring's middle, m."""
        return self.params.center

    def scene(self) -> Scene:
        """Says what is in the world."""
        params = self.params
        x, y = self.center
        top = params.platform_top
        platform = Platform("platform", center=(x, y, top), size=params.platform)
        ring = Ring("ring", center=(x, y, top), radius=params.ring_radius)
        track = Track(blocks=(SpawnArea(2.0, back_wall=False), Plane(4.2)), width=6.0, walled=False)
        contacts = Contacts(wall=(), robot=("trunk", "foot", "calf"), object=())
        return Scene(track, num_robots=2, contacts=contacts, objects=(platform, ring), colors=(0, 2))

    def spawn_poses(self) -> Sequence[tuple[float, float, float]]:
        """Says where the robots start, x, y, yaw of each, m and rad: facing each other across the ring."""
        (x, y), apart = self.center, self.params.spawn_y
        return (x, y - apart, 0.5 * np.pi), (x, y + apart, -0.5 * np.pi)

    def rewards(self, state: State, robot_state: RobotState, collision: jax.Array) -> tuple[dict[str, jax.Array], Any]:
        """Returns the reward terms and the task's fields after the step."""
        return {"win": self.zero_sum(self.wins(state, robot_state))}, None

    def eliminated(self, robot_state: RobotState) -> jax.Array:
        """Which robots have fallen or left the ring (2,) bool."""
        params = self.params
        apart = jnp.linalg.norm(robot_state.position_w[:, :2] - jnp.array(self.center), axis=-1)
        below = robot_state.position_w[:, 2] < params.platform_top - params.ring_depth
        return self.fallen(robot_state) | (apart > params.ring_radius) | below

    def ending(self, state: State, robot_state: RobotState) -> jax.Array:
        """One has fallen or left the ring."""
        return jnp.any(self.eliminated(robot_state))
