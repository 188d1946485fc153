"""Football matches go1football-1vs1 and go1football-2vs2, and what football tasks share.

Both are one match, which can have any size. All football tasks share field and ball.

The field extends from x 2 to 12; the goals are gaps in the thick walls behind both goal lines.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core import keys
from mqe_jax.core.limits import Distance, Fraction, Length, Robots, TimeLimit
from mqe_jax.core.settings import settings_class
from mqe_jax.envs.base import QuadrupedEnv
from mqe_jax.envs.match import Match
from mqe_jax.envs.observation import Block, ObservationLayout
from mqe_jax.envs.params import TaskParams, check_gap, check_teams
from mqe_jax.envs.state import Moment, S, State
from mqe_jax.physics.appearance import grounds, team_colors
from mqe_jax.physics.objects import Ball
from mqe_jax.physics.robots.index import RobotState
from mqe_jax.physics.scene import Scene
from mqe_jax.terrain import LANE, EndWall, Gate, Plane, SpawnArea, Track

if TYPE_CHECKING:
    from mujoco import mjx

# Midpoints of the goal lines (2, 2), m; row t is of the goal that team t attacks.
GOALS = np.array([[12.0, 0.0], [2.0, 0.0]], np.float32)
_GOAL_DEPTH = 1.0  # m
FAR = 1e3  # m; distance of robots that take no part
_REACH = 0.6  # m; from a trunk's centre to that of a ball that the robot touches
_IMPULSE = 0.1  # m/s; change of the ball's velocity in a step that only a touch causes

BALL_BLOCKS = (
    Block("ball", 3, "centre, m", quantities=("objects",)),
    Block("ball_velocity", 3, "m/s", quantities=("velocity",)),
)


@settings_class
class FootballParams(TaskParams):
    """Parameters of all football tasks."""

    episode_length: TimeLimit = 20.0
    field_width: Length = 9.0
    """Width of the field, m."""
    goal_width: Length = 2.0
    """Width of the goal mouths, m."""
    wall_height: Length = 1.0
    """Height of all walls, m."""
    ball: Ball = Ball()
    """The ball."""
    ball_noise: Distance = 0.0
    """Half-width of the uniform noise on the ball's position at reset, m."""
    head_start: Fraction = 0.0
    """Curriculum: the ball starts up to head_start x `State.assistance` of the way to a goal, in a
    match to either one. The robots that attack this goal start as far forward. Agents first learn
    to score from near. Inactive at assistance 0."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_gap("goal_width", self.goal_width, self.field_width)


F = TypeVar("F", bound=FootballParams)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Play:
    """Who touched the ball in this episode."""

    touched: jax.Array  # robots that touched it (R,) bool
    last: jax.Array  # the robot that touched it last (R,) bool
    # passes of each side (2,) int32: touches by a mate of the robot that touched the ball last
    passes: jax.Array


class Football(QuadrupedEnv[S, F]):
    """Base of the football tasks: the field, the ball and the kick-off."""

    ball_spot: ClassVar[tuple[float, float]] = (7.0, 0.0)  # x, y of the ball at reset, m

    @property
    def kick_off(self) -> tuple[tuple[float, float, float], ...]:
        """Spawn pose x, y, yaw of each robot, m and rad."""
        raise NotImplementedError(f"{type(self).__name__}: kick_off is not defined")

    @property
    def colors(self) -> tuple[int, ...]:
        """Colours of the robots, as in `Scene`."""
        return ()

    def scene(self) -> Scene:
        params = self.params
        goal = Gate(_GOAL_DEPTH, width=params.goal_width, depth=_GOAL_DEPTH, kind="goal")
        length = float(GOALS[0, 0] - GOALS[1, 0])
        track = Track(
            blocks=(SpawnArea(1.0), goal, Plane(length), goal, EndWall()),
            width=params.field_width,
            wall_height=params.wall_height,
            ground=grounds.pitch(
                (float(GOALS[1, 0]), float(GOALS[0, 0])),
                params.field_width,
                (params.goal_width, params.wall_height, _GOAL_DEPTH),
            ),
        )
        robots = len(self.kick_off)
        return Scene(track, num_robots=robots, objects={"ball": params.ball}, colors=self.colors)

    def spawn_poses(self) -> Sequence[tuple[float, float, float]]:
        """The kick-off poses."""
        return self.kick_off

    def reset_objects(
        self, key: jax.Array, qpos: jax.Array, qvel: jax.Array, assistance: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Samples the ball's initial position about its spot.

        The head start moves ball and robots.
        """
        params = self.params
        key, start_key = jax.random.split(key) if params.head_start else (key, key)
        noise = jax.random.uniform(key, (2,), minval=-params.ball_noise, maxval=params.ball_noise)
        position = jnp.append(self.sample_spot(key), params.ball.radius).at[:2].add(noise)
        qpos = qpos.at[self.objects["ball"].qpos[:3]].set(position)
        if params.head_start:
            goal, attackers = self.sample_attack(jax.random.fold_in(start_key, keys.SECOND))
            start = params.head_start * assistance * jax.random.uniform(start_key)
            way = start * (goal - position[:2])
            forward = jnp.where(attackers, way[0], 0.0)
            qpos = (
                qpos.at[self.objects["ball"].qpos[:2]]
                .add(way)
                .at[self.index.base_qpos[:, 0]]
                .add(forward)
            )
        return qpos, qvel

    @property
    def spreads(self) -> dict[str, tuple[Any, float]]:
        params = self.params
        return {**super().spreads, "ball_noise": ([self.ball_spot], params.ball_noise)}

    def sample_spot(self, key: jax.Array) -> jax.Array:
        """Returns the point (2,), m, about which the ball's initial position is sampled."""
        return jnp.array(self.ball_spot)

    def sample_attack(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Returns the goal of a head start, and the robots that attack it.

        They are the midpoint of the goal line (2,), m, and whether each robot attacks that goal
        (R,) bool.
        """
        raise NotImplementedError(f"{type(self).__name__}: sample_attack() is not defined")

    def touches(self, before: Moment, after: Moment) -> jax.Array:
        """Returns which robot touched the ball in a step (R,) bool.

        It is the nearest one, if the ball's velocity changed. Contacts themselves are not read,
        since the engines give them in different forms.
        """
        changed = jnp.linalg.norm(
            (self.ball_velocity(after.state.data) - self.ball_velocity(before.state.data))[:2]
        )
        apart = jnp.linalg.norm(
            after.robots.position_w[:, :2] - self.ball(after.state.data)[:2], axis=-1
        )
        apart = jnp.where(after.robots.active, apart, FAR)
        nearest = jnp.arange(len(apart)) == jnp.argmin(apart)
        return nearest & (apart < _REACH) & (changed > _IMPULSE)

    def kick_off_play(self) -> Play:
        """Returns the play before the first touch."""
        nobody = jnp.zeros(len(self.kick_off), bool)
        return Play(nobody, nobody, jnp.zeros(2, jnp.int32))

    def next_play(self, play: Play, before: Moment, after: Moment) -> Play:
        """Returns the play after a step."""
        halfway = GOALS[:, 0].mean()
        own = np.array(
            [[(x > halfway) == side for x, _, _ in self.kick_off] for side in (False, True)]
        )
        touch = self.touches(before, after)
        passed = (
            jnp.any(own & touch, axis=1)
            & jnp.any(own & play.last, axis=1)
            & ~jnp.any(touch & play.last)
        )
        last = jnp.where(jnp.any(touch), touch, play.last)
        return Play(play.touched | touch, last, play.passes + passed.astype(jnp.int32))

    def ball(self, data: mjx.Data) -> jax.Array:
        """Returns the ball's position (3,), m."""
        return self.object_pose(data, "ball")[:3]

    def ball_velocity(self, data: mjx.Data) -> jax.Array:
        """Returns the ball's velocity (3,), m/s."""
        return data.qvel[self.objects["ball"].qvel[:3]]

    def in_goal(self, data: mjx.Data) -> jax.Array:
        """Returns whether the ball is in each goal of `GOALS` (2,) bool.

        Its centre is then past the goal line, inside the mouth.
        """
        x, y, _ = self.ball(data)
        return jnp.stack([x > GOALS[0, 0], x < GOALS[1, 0]]) & (
            jnp.abs(y) < self.params.goal_width / 2
        )

    def goal_distance(self, data: mjx.Data) -> jax.Array:
        """Returns the ball's horizontal distance to each goal's midpoint in `GOALS` (2,), m."""
        return jnp.linalg.norm(self.ball(data)[:2] - GOALS, axis=-1)


@settings_class
class FootballMatchRewards:
    """Weights of the reward terms: zero-sum between the teams, except `advance` and `chase`.

    The released system defines no rewards for these matches; all terms except the goal are this
    package's.
    """

    goal: float = 10.0
    """When the ball is in the goal that the team attacks, which ends the episode."""
    progress: float = 0.3
    """Per m of decrease of the ball's distance to the midpoint of that goal."""
    approach: float = 0.1
    """Per m of decrease of the distance between the ball and the team's nearest robot."""
    fall: float = -10.0
    """When a robot of the team has fallen, which ends the match as a loss."""
    advance: float = 0.0
    """Per m by which the ball is nearer to that goal than ever before in the episode. For training
    only."""
    chase: float = 0.0
    """As `approach`, without subtracting the opponents'. For training only."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class FootballMatchState:
    """The task's own state."""

    # smallest distance of the ball to the goal that each team attacks in this episode (2,), m
    nearest: jax.Array
    play: Play  # touches of the ball


# lines of a team at the kick-off, at most; robots in a line while there are fewer lines
_LINES = 4
_IN_LINE = 4


@settings_class
class FootballMatchParams(FootballParams):
    """Parameters of the football matches, with the defaults of Football (1 vs 1)."""

    rewards: FootballMatchRewards = FootballMatchRewards()
    """Weights of the reward terms."""

    def __post_init__(self) -> None:
        super().__post_init__()
        most = _LINES * max(int(self.field_width / LANE) - 1, 1)
        check_teams(self.num_agents, most, f"field_width {self.field_width:g}")


@settings_class
class Football2vs2Params(FootballMatchParams):
    """Parameters of the football matches, with the defaults of Football (2 vs 2)."""

    num_agents: Robots = 4


class Go1Football1vs1(
    Football[FootballMatchState, FootballMatchParams],
    Match[FootballMatchState, FootballMatchParams],
):
    """Football, by default 1 vs 1.

    - Scene: the field with the ball in its centre. Team 0 attacks the goal at x 12, team 1 that at
      x 2.
    - Observation, in the team's own frame: one-hot within the team, own base info 6, teammates',
      opponents', ball position 3, ball velocity 3.
    - Reward: see `FootballMatchRewards`; zero-sum, shared by the team.
    - End: a goal, a fall, or 20 s. Win: a goal, or the opponents' fall.
    - In teams with mates, evaluations count a team's passes, and its goals after touches by all its
      robots.
    - Sizes: any even `num_agents`; at the kick-off larger teams stand in lines, the first robots in
      front.

    Source: paper, section III; the released system leaves rewards and observations undefined.
    """

    name = "go1football-1vs1"
    title = "Football (1 vs 1)"
    aim = "Score in the opponents' goal."
    labels: ClassVar = {"both_touched": "goal touched by all"}
    Params = FootballMatchParams
    variable_num_agents = True

    @property
    def kick_off(self) -> tuple[tuple[float, float, float], ...]:
        """Team 0's lines, and the same after a half turn about the centre."""
        team = self.num_agents // 2
        (x, y) = self.center
        lines = min(math.ceil(team / _IN_LINE), _LINES)
        columns = math.ceil(team / lines)
        apart = min(4.0, (self.params.field_width - 2 * LANE) / max(columns - 1, 1))
        own = []
        for line, first in enumerate(range(0, team, columns)):
            count = min(columns, team - first)
            own += [
                (4.0 + (lines - 1) / 2 - line, (i - (count - 1) / 2) * apart, 0.0)
                for i in range(count)
            ]
        return (*own, *((2 * x - a, 2 * y - b, np.pi) for a, b, _ in own))

    @property
    def heading(self) -> str:
        return f"Football ({self.num_agents // 2} vs {self.num_agents // 2})"

    @property
    def colors(self) -> tuple[int, ...]:
        return team_colors(self.num_agents // 2)

    @property
    def center(self) -> tuple[float, float]:
        """The centre of the field, m."""
        return float(GOALS[:, 0].mean()), 0.0

    def sample_attack(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        side = jax.random.randint(key, (), 0, 2)
        return jnp.asarray(GOALS)[side], jnp.asarray(self.team_of) == side

    def reset_task(
        self, key: jax.Array, state: State, robot_state: RobotState
    ) -> FootballMatchState:
        return FootballMatchState(self.goal_distance(state.data), self.kick_off_play())

    def step_task(
        self, before: Moment[FootballMatchState], after: Moment[FootballMatchState]
    ) -> FootballMatchState:
        was = before.state.task
        nearest = jnp.minimum(was.nearest, self.goal_distance(after.state.data))
        return FootballMatchState(nearest, self.next_play(was.play, before, after))

    def distances(self, now: Moment) -> tuple[jax.Array, jax.Array]:
        """Returns the ball's distances to each team's goal and to its nearest robot, (2,) each, m.

        A team's goal is the one that it attacks.
        """
        apart = jnp.linalg.norm(
            now.robots.position_w[:, :2] - self.ball(now.state.data)[:2], axis=-1
        )
        apart = jnp.where(now.robots.active, apart, FAR)
        return self.goal_distance(now.state.data), jnp.min(apart.reshape(2, -1), axis=1)

    @property
    def observation_layout(self) -> ObservationLayout:
        return ObservationLayout((*self.teams_blocks(), *BALL_BLOCKS))

    def observe(self, state: State, robot_state: RobotState) -> dict[str, jax.Array]:
        """Blocks (A, width), each in its agent's own frame."""
        ball = self.view_points(self.ball(state.data))
        velocity = self.view_vectors(self.ball_velocity(state.data))
        blocks = {"ball": ball[self.team_of], "ball_velocity": velocity[self.team_of]}
        return {**self.observe_teams(robot_state), **blocks}

    def rewards(self, before: Moment, after: Moment, collision: jax.Array) -> dict[str, jax.Array]:
        (goal_before, robot_before) = self.distances(before)
        (goal, robot) = self.distances(after)
        return {
            "goal": self.zero_sum(self.in_goal(after.state.data)),
            "progress": self.zero_sum(goal_before - goal),
            "approach": self.zero_sum(robot_before - robot),
            "fall": self.zero_sum(self.eliminated(after.state, after.robots)),
            "advance": (before.state.task.nearest - after.state.task.nearest)[self.team_of],
            "chase": (robot_before - robot)[self.team_of],
        }

    def ending(self, state: State, robot_state: RobotState) -> jax.Array:
        """The episode ends with a goal."""
        return jnp.any(self.in_goal(state.data))

    def leading(self, state: State, robot_state: RobotState) -> jax.Array:
        """A team leads while the ball is in the goal that it attacks."""
        return self.in_goal(state.data)

    def further(self, state: State, robot_state: RobotState) -> dict[str, jax.Array]:
        """Returns `passes` and `both_touched` of teams with mates.

        `both_touched` is a goal after touches by all robots of the team.
        """
        play = state.task.play
        touched = (play.touched | ~state.active).reshape(2, -1)
        together = self.in_goal(state.data) & jnp.all(touched, axis=1)
        return {"passes": play.passes, "both_touched": together} if self.num_agents > 2 else {}


class Go1Football2vs2(Go1Football1vs1):
    """Football, by default 2 vs 2; see `Go1Football1vs1`."""

    name = "go1football-2vs2"
    title = "Football (2 vs 2)"
    Params = Football2vs2Params
