"""go1football-defender, the paper's Football (2 vs 1): two robots against a scripted defender."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core import keys
from mqe_jax.core.limits import Fraction
from mqe_jax.core.settings import settings_class
from mqe_jax.envs.football import BALL_BLOCKS, FAR, GOALS, Football, FootballParams, Play
from mqe_jax.envs.observation import ObservationLayout, for_all, observe_team, team_blocks
from mqe_jax.envs.state import Moment, State
from mqe_jax.npc import defend
from mqe_jax.physics.robots.index import RobotState


@settings_class
class DefenderRewards:
    """Weights of the reward terms."""

    goal: float = 10.0
    """In steps in which the ball is in the goal."""
    nearness: float = 3.0
    """In every step, exp(-d / 3 m) with the distance d of the ball to the goal's midpoint."""
    progress: float = 0.0
    """Per m of decrease of the ball's distance to the goal's midpoint. Not in the paper:
    shaping."""
    approach: float = 0.0
    """Per m of decrease of the distance between the ball and the nearest robot. Not in the paper:
    shaping."""
    first_goal: float = 0.0
    """In the step of an episode's first goal. Not in the paper: for training, as `goal` favours
    early goals."""
    fall: float = 0.0
    """In steps in which an attacker has fallen. Not in the paper: for training, as `first_goal`
    pays only once."""


@settings_class
class DefenderParams(FootballParams):
    """Parameters of Football (2 vs 1)."""

    defender_idle: bool = False
    """Whether the defender stands still."""
    ball_between: Fraction = 0.0
    """Share of episodes that start with the ball between the two attackers, for training."""
    rewards: DefenderRewards = DefenderRewards()
    """Weights of the reward terms."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class DefenderState:
    """The task's own state."""

    scored: jax.Array  # whether the ball has been in the goal in this episode () bool
    play: Play  # touches of the ball before that


class Go1FootballDefender(Football[DefenderState, DefenderParams]):
    """Football (2 vs 1).

    - Scene: the field, a ball, and a third robot that defends the goal at x 12 (see
      `mqe_jax.npc.defend`).
    - Observation: one-hot 2, own base info 6, teammate's base info 6, ball position 3, ball
      velocity 3.
    - Reward: see `DefenderRewards`; shared.
    - End: a fall, or 20 s. Success: a goal, at any time in the episode.
    - Evaluations count passes before the goal, and goals after touches by both robots.

    Source: paper, section III and table of rewards.
    """

    name = "go1football-defender"
    title = "Football (2 vs 1)"
    aim = "Score in the goal behind the defender."
    labels: ClassVar = {"both_touched": "goal touched by both"}
    Params = DefenderParams
    ball_spot = (5.0, -2.1)
    npc_varied = ("vx", "vy", "yaw_rate")

    @property
    def kick_off(self) -> tuple[tuple[float, float, float], ...]:
        return (4.0, -2.0, 0.0), (4.0, 2.0, 0.0), (10.0, 0.0, np.pi)

    def npc_commands(self, state: State[DefenderState], robot_state: RobotState) -> jax.Array:
        """Walk commands of the defender (1, C)."""
        commands = jnp.asarray(self.controller.npc_default_commands)
        if not self.params.defender_idle:
            move = defend(
                robot_state.position_w[2, :2],
                robot_state.euler[2, 2],
                self.ball(state.data)[:2],
                jnp.asarray(GOALS[0]),
            )
            commands = commands.at[self.controller.npc_skill.index(self.npc_varied)].set(move)
        return commands[None]

    def reset_task(self, key: jax.Array, state: State, robot_state: RobotState) -> DefenderState:
        return DefenderState(jnp.zeros((), bool), self.kick_off_play())

    def step_task(
        self, before: Moment[DefenderState], after: Moment[DefenderState]
    ) -> DefenderState:
        was = before.state.task
        play = self.next_play(was.play, before, after)
        play = jax.tree.map(lambda old, new: jnp.where(was.scored, old, new), was.play, play)
        return DefenderState(was.scored | self.in_goal(after.state.data)[0], play)

    def sample_spot(self, key: jax.Array) -> jax.Array:
        spot = super().sample_spot(key)
        share = self.params.ball_between
        if not share:
            return spot
        between = jax.random.bernoulli(jax.random.fold_in(key, keys.THIRD), share)
        return jnp.where(between, spot.at[1].set(0.0), spot)

    def sample_attack(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jnp.asarray(GOALS[0]), jnp.array([True, True, False])

    def distances(self, now: Moment[DefenderState]) -> tuple[jax.Array, jax.Array]:
        """Returns the ball's distances to the goal's midpoint and to the nearest robot (), m."""
        apart = jnp.linalg.norm(
            now.robots.position_w[:2, :2] - self.ball(now.state.data)[:2], axis=-1
        )
        return self.goal_distance(now.state.data)[0], jnp.min(
            jnp.where(now.robots.active[:2], apart, FAR)
        )

    @property
    def observation_layout(self) -> ObservationLayout:
        return ObservationLayout((*team_blocks(2), *BALL_BLOCKS))

    def observe(self, state: State[DefenderState], robot_state: RobotState) -> dict[str, jax.Array]:
        return {
            **observe_team(robot_state.base_info[:2]),
            "ball": for_all(self.ball(state.data), 2),
            "ball_velocity": for_all(self.ball_velocity(state.data), 2),
        }

    def rewards(
        self, before: Moment[DefenderState], after: Moment[DefenderState], collision: jax.Array
    ) -> dict[str, jax.Array]:
        (goal_before, near_before) = self.distances(before)
        (goal, near) = self.distances(after)
        return {
            "goal": self.in_goal(after.state.data)[0],
            "nearness": jnp.exp(-goal / 3.0),
            "progress": goal_before - goal,
            "approach": near_before - near,
            "first_goal": after.state.task.scored & ~before.state.task.scored,
            "fall": jnp.any(self.fallen(after.robots)[:2]),
        }

    def outcome(
        self, state: State[DefenderState], robot_state: RobotState, failed: jax.Array
    ) -> dict[str, jax.Array]:
        """Success: a goal at any time in this episode.

        `both_touched`: one after touches by both robots; `passes`: passes before it.
        """
        scored = state.task.scored
        play = state.task.play
        both = scored & jnp.all(play.touched[:2])
        return {"success": scored, "both_touched": both, "passes": play.passes[0]}
