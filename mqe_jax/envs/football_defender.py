"""go1football-defender, the paper's Football (2 vs 1): two robots against a scripted defender."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.envs.football import BALL_BLOCKS, GOALS, Football, FootballParams
from mqe_jax.envs.observation import PAIR, ObservationLayout, for_all, pair
from mqe_jax.envs.state import Moment, State
from mqe_jax.limits import Fraction
from mqe_jax.npc import defend
from mqe_jax.robots.index import RobotState
from mqe_jax.settings import record

if TYPE_CHECKING:
    from mujoco import mjx


@record
class DefenderRewards:
    """Weights of the reward terms."""

    goal: float = 10.0
    """In steps in which the ball is in the goal."""
    nearness: float = 3.0
    """Times exp(-distance of the ball to the goal's midpoint / 3 m)."""
    progress: float = 0.0
    """Per m of decrease of the ball's distance to the goal's midpoint. Not in the paper: shaping."""
    approach: float = 0.0
    """Per m of decrease of the distance between the ball and the nearest robot. Not in the paper: shaping."""


@record
class DefenderParams(FootballParams):
    """Parameters of Football (2 vs 1)."""

    defender_idle: bool = False
    """Whether the defender stands still."""
    head_start: Fraction = 0.0
    """Curriculum: the ball starts up to head_start x `State.assistance` of the way to the goal, the two robots as far
    forward, so that agents first learn to score from near. Inactive at assistance 0.
    """
    rewards: DefenderRewards = DefenderRewards()
    """Weights of the reward terms."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class DefenderState:
    """The task's own state."""

    scored: jax.Array
    """Whether the ball has been in the goal in this episode () bool."""


class Go1FootballDefender(Football[DefenderState, DefenderParams]):
    """Football (2 vs 1).

    - Scene: the field, a ball, and a third robot that defends the goal at x 12 (see `mqe_jax.npc.defend`).
    - Observation: one-hot 2, own base info 6, teammate's base info 6, ball position 3, ball velocity 3.
    - Reward: see `DefenderRewards`; shared.
    - End: a fall, or 20 s. Success: a goal, at any time in the episode.

    Source: paper, section III and table of rewards.
    """

    name = "go1football-defender"
    title = "Football (2 vs 1)"
    Params = DefenderParams
    kick_off = ((4.0, -2.0, 0.0), (4.0, 2.0, 0.0), (10.0, 0.0, np.pi))
    ball_spot = (5.0, -2.1)
    colors = (0, 1, 2)

    def npc_commands(self, state: State[DefenderState], robot_state: RobotState) -> jax.Array:
        """Walk commands of the defender (1, C)."""
        commands = jnp.asarray(self.controller.default_commands)
        if not self.params.defender_idle:
            move = defend(
                robot_state.position_w[2, :2], robot_state.euler[2, 2], self.ball(state.data)[:2], jnp.asarray(GOALS[0])
            )
            commands = commands.at[self.controller.skill.index(("vx", "vy", "yaw_rate"))].set(move)
        return commands[None]

    def reset_task(self, key: jax.Array, robot_state: RobotState, data: mjx.Data, anchors: jax.Array) -> DefenderState:
        return DefenderState(jnp.zeros((), bool))

    def step_task(self, before: Moment[DefenderState], after: Moment[DefenderState]) -> DefenderState:
        return DefenderState(before.state.task.scored | self.in_goal(after.state.data)[0])

    def reset_objects(
        self, key: jax.Array, qpos: jax.Array, qvel: jax.Array, assistance: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Samples the ball's initial position, and moves ball and robots forward by the head start."""
        if not self.params.head_start:
            return super().reset_objects(key, qpos, qvel, assistance)
        key, start_key = jax.random.split(key)
        qpos, qvel = super().reset_objects(key, qpos, qvel, assistance)
        ball = self.objects["ball"].qpos[:2]
        start = self.params.head_start * assistance * jax.random.uniform(start_key)
        way = start * (jnp.asarray(GOALS[0]) - qpos[ball])
        return qpos.at[ball].add(way).at[self.index.base_qpos[:2, 0]].add(way[0]), qvel

    def distances(self, now: Moment[DefenderState]) -> tuple[jax.Array, jax.Array]:
        """Returns the ball's distances to the goal's midpoint and to the nearest of the two robots (), m."""
        apart = jnp.linalg.norm(now.robots.position_w[:2, :2] - self.ball(now.state.data)[:2], axis=-1)
        return self.goal_distance(now.state.data)[0], jnp.min(apart)

    @property
    def observation_layout(self) -> ObservationLayout:
        return ObservationLayout((*PAIR, *BALL_BLOCKS))

    def observe(self, state: State[DefenderState], robot_state: RobotState) -> dict[str, jax.Array]:
        return {
            **pair(robot_state.base_info[:2]),
            "ball": for_all(self.ball(state.data), 2),
            "ball_velocity": for_all(self.ball_velocity(state.data), 2),
        }

    def rewards(
        self, before: Moment[DefenderState], after: Moment[DefenderState], collision: jax.Array
    ) -> dict[str, jax.Array]:
        (goal_before, robot_before), (goal, robot) = self.distances(before), self.distances(after)
        return {
            "goal": self.in_goal(after.state.data)[0],
            "nearness": jnp.exp(-goal / 3.0),
            "progress": goal_before - goal,
            "approach": robot_before - robot,
        }

    def outcome(self, state: State[DefenderState], robot_state: RobotState, failed: jax.Array) -> dict[str, jax.Array]:
        """Success: a goal at any time in this episode."""
        return {"success": state.task.scored}
