"""go1wrestling, the paper's Sumo Wrestling: teams push each other out of a ring, or over.

By default a team is one robot.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core.limits import Distance, Length, Tilt, TimeLimit
from mqe_jax.core.settings import fail, settings_class
from mqe_jax.envs.match import Duel
from mqe_jax.envs.observation import ObservationLayout, by_entity, others
from mqe_jax.envs.params import TaskParams, check_teams
from mqe_jax.envs.state import Moment, State
from mqe_jax.physics.appearance import grounds, team_colors
from mqe_jax.physics.objects import Platform, Ring
from mqe_jax.physics.robots.index import RobotState
from mqe_jax.physics.robots.robot import Proportions
from mqe_jax.physics.scene import Scene
from mqe_jax.sensors.scene import Entity
from mqe_jax.terrain import Plane, SpawnArea, Track

_APART = 0.7  # m, between mates at the start, at least
_ARC = np.radians(140.0)  # on which a team stands at the start, at most
_MARGIN = 0.4  # m, from the ring's edge to the robots at the start, at least


@settings_class
class WrestlingRewards:
    """Weights of the reward terms; `win` is zero-sum, the others are for training only."""

    win: float = 10.0
    """When all opponents have fallen or left the ring, which ends the episode; minus the same of
    the opponents."""
    push: float = 0.0
    """Per m of increase of the opponents' summed distances from the ring's centre; only of those
    still in."""
    approach: float = 0.0
    """Per m of decrease of the distance between a robot and the nearest opponent that is still
    in."""


@settings_class
class WrestlingParams(TaskParams):
    """Parameters of Sumo Wrestling."""

    episode_length: TimeLimit = 15.0
    spawn_height: Length = 0.74
    max_roll: Tilt = 0.4 * np.pi
    platform: Platform = Platform(center=(3.1, 0.0, 0.4), size=(4.37, 4.37, 0.5))
    """The platform, with the ring in its centre; its lower part is below the ground. Robots dropped
    from the spawn height land on their feet."""
    ring_radius: Length = 1.7
    """Radius of the ring, m."""
    ring_depth: Distance = 0.2
    """Distance of a trunk below the platform's top at which the robot counts as out, m."""
    spawn_y: Distance = 1.0
    """Distance of the robots from the ring's centre, m; the first team is on the side of negative
    y. A team that has no room on this arc stands further out."""
    head_start: Distance = 0.0
    """Curriculum: both robots start up to head_start x `State.assistance` further along y, m, to a
    side drawn at random, so that one is near the edge of the ring. Inactive at assistance 0."""
    rewards: WrestlingRewards = WrestlingRewards()
    """Weights of the reward terms."""

    def scaled(self, body: Proportions) -> dict[str, Any]:
        return super().scaled(body) | {"ring_depth": self.ring_depth * body.height}

    def __post_init__(self) -> None:
        super().__post_init__()
        ring = min(self.ring_radius, min(self.platform.size[:2]) / 2) - _MARGIN
        most = 1 + int(_ARC / (2 * np.arcsin(_APART / 2 / max(ring, _APART / 2))))
        room = f"ring_radius {self.ring_radius:g} and platform.size {self.platform.size}"
        check_teams(self.num_agents, most, room)
        room = self.ring_radius - self.arc[0]
        if self.spawn_noise > max(room, 0.0):
            fail("spawn_noise", self.spawn_noise, f"at most {room:.2f}, as far as the ring's edge")
        room -= self.spawn_noise
        if self.head_start > room:
            fail(
                "head_start",
                self.head_start,
                f"at most {room:.2f}, the distance of the robots from the ring's edge",
            )

    @property
    def ground(self) -> float:
        return self.platform.center[2]

    @property
    def arc(self) -> tuple[float, float]:
        """Arc on which each team starts: radius, m, and angle between neighbours, rad."""
        gaps = self.num_agents // 2 - 1
        radius = max(self.spawn_y, _APART / 2 / np.sin(_ARC / gaps / 2)) if gaps else self.spawn_y
        return radius, 2 * np.arcsin(_APART / 2 / max(radius, _APART / 2))


class Go1Wrestling(Duel[jax.Array, WrestlingParams]):
    """Sumo Wrestling; its own state says which robots have been out (A,) bool.

    - Scene: a platform with a ring of 3.4 m diameter marked on it; the robots face each other, 2 m
      apart.
    - Observation, in the agent's own frame: own base info 6, the opponent's base info 6. In larger
      teams: one-hot within the team, own base info 6, those of the teammates and of the opponents,
      each with 1 while it is in, else 0.
    - Reward: see `WrestlingRewards`.
    - End: all robots of a team have fallen or left the ring, or 15 s. Win: only the opponents have.
    - Sizes: any even `num_agents` for which the ring has room. A robot that is out stands still and
      remains out.

    Source: paper, section III.
    """

    name = "go1wrestling"
    title = "Sumo Wrestling"
    aim = "Push all opponents out of the ring, or over."
    Params = WrestlingParams
    variable_num_agents = True

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
        objects = {"platform": params.platform, "ring": ring}
        colors = team_colors(self.num_agents // 2)
        return Scene(track, num_robots=self.num_agents, objects=objects, colors=colors)

    def spawn_poses(self) -> Sequence[tuple[float, float, float]]:
        """Two arcs, whose robots face the ring's centre."""
        (x, y) = self.center
        (radius, apart) = self.params.arc
        team = self.num_agents // 2
        turns = [(place - (team - 1) / 2) * apart for place in range(team)]
        places = [
            (radius * np.sin(turn), radius * np.cos(turn), 0.5 * np.pi + turn) for turn in turns
        ]
        return *((x + a, y - b, yaw) for a, b, yaw in places), *(
            (x - a, y + b, yaw - np.pi) for a, b, yaw in places
        )

    def reset_objects(
        self, key: jax.Array, qpos: jax.Array, qvel: jax.Array, assistance: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Moves all robots by the head start."""
        if not self.params.head_start:
            return qpos, qvel
        side = self.params.head_start * assistance * jax.random.uniform(key, minval=-1.0)
        return qpos.at[self.index.base_qpos[:, 1]].add(side), qvel

    @property
    def entities(self) -> tuple[Entity, ...]:
        """The ring, in whose centre the platform is too."""
        return (Entity("ring", "ring"),)

    @property
    def falls_end(self) -> bool:
        """Only in a duel."""
        return self.num_agents == 2

    def reset_task(self, key: jax.Array, state: State, robot_state: RobotState) -> jax.Array:
        return jnp.zeros(self.num_agents, bool)

    def step_task(self, before: Moment[jax.Array], after: Moment[jax.Array]) -> jax.Array:
        return before.state.task | self.beaten(after.robots)

    def acting(self, state: State[jax.Array]) -> jax.Array:
        return state.active & ~state.task

    @property
    def observation_layout(self) -> ObservationLayout:
        return super().observation_layout if self.num_agents == 2 else self.sized_layout

    def observe(self, state: State[jax.Array], robot_state: RobotState) -> dict[str, jax.Array]:
        """Blocks (A, width), each in its agent's own frame."""
        duel = self.num_agents == 2
        return (
            super().observe(state, robot_state) if duel else self.observe_sized(state, robot_state)
        )

    @property
    def sized_layout(self) -> ObservationLayout:
        return ObservationLayout(self.teams_blocks(masked=True))

    def observe_sized(
        self, state: State[jax.Array], robot_state: RobotState
    ) -> dict[str, jax.Array]:
        blocks = self.observe_teams(robot_state)
        agents = self.num_agents
        teams = self.acting(state).reshape(2, -1)
        there = {
            "teammate": jax.vmap(others)(teams[..., None]).reshape(agents, -1),
            "opponents": teams[::-1][self.team_of],
        }
        masked = {
            name: by_entity(blocks[name].reshape(agents, -1, 6), there[name])
            for name in there
            if name in blocks
        }
        return {**blocks, **masked}

    def rewards(
        self, before: Moment[jax.Array], after: Moment[jax.Array], collision: jax.Array
    ) -> dict[str, jax.Array]:
        still_in = self.acting(before.state)  # all that were in at the beginning of the step
        outward = jnp.where(
            still_in, self.distance(after.robots) - self.distance(before.robots), 0.0
        )
        pushed = jnp.sum(outward.reshape(2, -1), axis=1)[::-1]
        gaps = [self.gap(now.robots, still_in) for now in (before, after)]
        wins = self.zero_sum(self.wins(after.state, after.robots))
        return {"win": wins, "push": pushed[self.team_of], "approach": gaps[0] - gaps[1]}

    def gap(self, robot_state: RobotState, still_in: jax.Array) -> jax.Array:
        """Returns each robot's distance to the nearest opponent that is still in (A,), m.

        It is 0 if the robot, or every opponent, is out.
        """
        position = robot_state.position_w
        team = self.team_of
        apart = jnp.linalg.norm(position[:, None] - position, axis=-1)
        meets = (team[:, None] != team) & still_in & still_in[:, None]
        nearest = jnp.min(jnp.where(meets, apart, jnp.inf), axis=1)
        return jnp.where(jnp.any(meets, axis=1), nearest, 0.0)

    def distance(self, robot_state: RobotState) -> jax.Array:
        """Returns each robot's horizontal distance from the ring's centre (A,), m."""
        return jnp.linalg.norm(robot_state.position_w[:, :2] - jnp.array(self.center), axis=-1)

    def beaten(self, robot_state: RobotState) -> jax.Array:
        """Returns which robots have fallen or are outside the ring (A,) bool."""
        params = self.params
        below = robot_state.position_w[:, 2] < params.platform.center[2] - params.ring_depth
        out = (self.distance(robot_state) > params.ring_radius) | below
        return self.fallen(robot_state) | robot_state.count(out)

    def eliminated(self, state: State[jax.Array], robot_state: RobotState) -> jax.Array:
        """Returns which teams have no robot left (2,) bool."""
        active = robot_state.active
        out = state.task | self.beaten(robot_state)
        active, gone = (x.reshape(2, -1) for x in (active, out | ~active))
        return jnp.any(active, axis=1) & jnp.all(gone, axis=1)

    def ending(self, state: State[jax.Array], robot_state: RobotState) -> jax.Array:
        """The episode ends when a team has no robot left."""
        return jnp.any(self.eliminated(state, robot_state))
