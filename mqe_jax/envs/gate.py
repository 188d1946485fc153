"""go1gate, the paper's Narrow Gate: robots pass through a gap one by one.

By default there are two robots. The gap is wide enough for one.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core.limits import Coordinate, Distance, Length, TimeLimit
from mqe_jax.core.settings import settings_class
from mqe_jax.envs import reward
from mqe_jax.envs.base import QuadrupedEnv
from mqe_jax.envs.observation import GATE, ObservationLayout, for_all, observe_team, team_blocks
from mqe_jax.envs.params import TaskParams, check_gap
from mqe_jax.envs.state import Moment, State
from mqe_jax.physics.appearance import grounds
from mqe_jax.physics.robots.index import RobotState
from mqe_jax.physics.robots.robot import Proportions
from mqe_jax.physics.scene import Scene
from mqe_jax.terrain import EndWall, Gate, Plane, SpawnArea, Track, rows_of


@settings_class
class GateRewards:
    """Weights of the reward terms."""

    success: float = 5.0
    """Per robot past the gate."""
    approach: float = 1.0
    """Per m of decrease of a robot's distance to its target."""
    crowding: float = -0.025
    """In every step, the sum of 1 / d^2 over ordered pairs of robots at a distance d below 0.5
    m."""
    collision: float = -2.0
    """In steps with any trunk contact."""


@settings_class
class GateParams(TaskParams):
    """Parameters of Narrow Gate."""

    episode_length: TimeLimit = 10.0
    spawn_noise: Distance = 0.0
    min_height: Coordinate = 0.08
    max_height: Coordinate = 1.5
    end_on_collision: bool = True
    track_width: Length = 3.0
    """Width of the track, m."""
    gate_width: Length = 0.6
    """Width of the gap, m."""
    gate_depth: Length = 0.1
    """Thickness of the wall along x, m."""
    gate_random: tuple[Distance, Distance] = (0.5, 0.5)
    """Half-widths of the range of the gap's centre in x and y, m."""
    past_gate: Coordinate = 0.25
    """Distance behind the gate's centre at which a robot counts as through, m."""
    target_x: Coordinate = 5.5
    """X of the robots' targets, m."""
    target_y: Coordinate = 0.75
    """|y| of two robots' targets, m. Their paths cross: the first robot's target is on the left.
    Targets of more robots mirror the rows in which they start."""
    rewards: GateRewards = GateRewards()
    """Weights of the reward terms."""

    def scaled(self, body: Proportions) -> dict[str, Any]:
        gate = {"gate_width": self.gate_width * body.width}
        return super().scaled(body) | gate | {"past_gate": self.past_gate * body.length}

    def __post_init__(self) -> None:
        super().__post_init__()
        check_gap("gate_width", self.gate_width, self.track_width)


class Go1Gate(QuadrupedEnv[None, GateParams]):
    """Narrow Gate.

    - Scene: a track 3 m wide, a wall across it with a gap of 0.6 m whose centre is sampled at
      reset.
    - Observation: one-hot, own base info 6, each teammate's base info 6, gate centre 2.
    - Reward: see `GateRewards`; shared.
    - End: a fall, a collision, or 10 s. Success: all robots are through without a collision.
    - Sizes: any `num_agents`; the track is longer by 1 m at both ends for every further row of
      robots.

    Source: paper, section III and table of rewards.
    """

    name = "go1gate"
    title = "Narrow Gate"
    aim = "Get all robots through the gap, which is wide enough for one. Touch nothing."
    labels: ClassVar = {"one": "at least one through"}
    Params = GateParams
    variable_num_agents = True

    def scene(self) -> Scene:
        params = self.params
        agents = self.num_agents
        columns, behind = rows_of(agents, params.track_width)
        gate = Gate(
            3.0, width=params.gate_width, depth=params.gate_depth, random=params.gate_random
        )
        spawn = SpawnArea(2.0 + behind, spawn_x=1.0 + behind, columns=columns)
        track = Track(
            blocks=(spawn, gate, Plane(1.0 + behind), EndWall()),
            width=params.track_width,
            start=0.0 - behind,
            num_robots=agents,
        )
        pads = grounds.pads(
            [(x, y, 0.0) for x, y in self.targets(track.layout().spawn)], range(agents)
        )
        ground = grounds.track((track.start, 6.0 + behind), params.track_width, 4, pads)
        return Scene(dataclasses.replace(track, ground=ground), num_robots=agents)

    def targets(self, spawn: Sequence[tuple[float, float, float]]) -> np.ndarray:
        """Returns the robots' targets (A, 2), m, from their spawn poses."""
        params = self.params
        x, y = np.array(spawn)[:, :2].T
        # |y| of two robots at the start is a quarter of the width
        apart = params.target_y / (params.track_width / 4)
        return np.stack([params.target_x + x - x.min(), -apart * y], axis=-1)

    @property
    def observation_layout(self) -> ObservationLayout:
        return ObservationLayout((*team_blocks(self.num_agents), GATE))

    def observe(self, state: State, robot_state: RobotState) -> dict[str, jax.Array]:
        return {
            **observe_team(robot_state.base_info),
            "gate": for_all(state.anchors, self.num_agents),
        }

    def target_distance(self, robot_state: RobotState) -> jax.Array:
        """Returns each robot's horizontal distance to its target (A,), m."""
        target = self.targets(self.compiled.layout.spawn).astype(np.float32)
        return jnp.linalg.norm(robot_state.position_w[:, :2] - target, axis=-1)

    def through(self, state: State, robot_state: RobotState) -> jax.Array:
        """Returns which robots are past the gate (A,) bool."""
        return robot_state.position_w[:, 0] > state.anchors[0, 0] + self.params.past_gate

    def rewards(self, before: Moment, after: Moment, collision: jax.Array) -> dict[str, jax.Array]:
        nearer = self.target_distance(before.robots) - self.target_distance(after.robots)
        return {
            "success": jnp.sum(after.robots.count(self.through(after.state, after.robots))).astype(
                jnp.float32
            ),
            "approach": jnp.sum(after.robots.count(nearer)),
            "crowding": reward.crowding(after.robots.position_w[:, :2], after.robots.active),
            "collision": collision.astype(jnp.float32),
        }

    def outcome(
        self, state: State, robot_state: RobotState, failed: jax.Array
    ) -> dict[str, jax.Array]:
        """Success: all robots are through; `one`: at least one is, however the episode ended."""
        through = self.through(state, robot_state)
        return {
            "success": jnp.all(through | ~robot_state.active) & ~failed,
            "one": jnp.any(robot_state.count(through)),
        }
