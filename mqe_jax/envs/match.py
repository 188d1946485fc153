"""Matches: two teams of the same size, with zero-sum rewards and mirrored observations.

A match is symmetric under a half turn about its centre ("turn") or a reflection in the x-z plane
("reflect"). Team 1, the second half of the agents, observes in the transformed frame, so that one
policy can control either team.
"""

from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core.returned import check_shape
from mqe_jax.core.settings import check, fail
from mqe_jax.core.types import Outcome
from mqe_jax.envs.base import QuadrupedEnv
from mqe_jax.envs.observation import (
    BASE,
    BASE_INFO,
    POSE,
    Block,
    ObservationLayout,
    entities,
    one_hot,
    others,
)
from mqe_jax.envs.params import P
from mqe_jax.envs.state import S, State
from mqe_jax.physics.robots.index import RobotState

OF_AGENTS = ("groups", "final_groups", "reward", "active", "used")
"""Fields of a match's state that belong to its agents."""


def team_view(state: Any, size: int) -> dict[str, Any]:
    """Returns what team 0, the first `size` agents, has of a match's state, by field.

    These are the fields of its agents, its outcome and its metrics; any leading axes.
    """
    leading = (slice(None),) * (state.reward.ndim - 1)

    def cut(x: jax.Array) -> jax.Array:
        return x[(*leading, slice(size))]

    view = {name: jax.tree.map(cut, getattr(state, name)) for name in OF_AGENTS}
    outcome = state.outcome.by_team(lambda x: x[..., :1])
    metrics = {name: x for name, x in state.metrics.items() if not name.startswith("team1/")}
    return {**view, "outcome": outcome, "metrics": metrics}


class Match(QuadrupedEnv[S, P]):
    """Base of the competitive tasks.

    Reward: zero-sum, except terms whose weight is 0 by default. A term is the team's own minus the
    opponents'. Result: an `eliminated` team (by default one with a fallen robot) loses. If no team
    is eliminated, the `leading` team wins. It is a draw if both teams are eliminated, or both or
    neither lead. Success is a win. Diverged physics is a draw.

    Example:
        ```python
        match = mqe_jax.make("go1football-1vs1")
        own, other = match.view_points(jax.numpy.array([2.0, 1.0, 0.0]))  # as each team sees it
        print(other)  # [12. -1.  0.]
        ```
    """

    symmetry: ClassVar[str] = "turn"
    """Symmetry that maps one team's frame to the other's: 'turn' or 'reflect'."""

    @property
    def center(self) -> tuple[float, float]:
        """The centre of symmetry (x, y), m."""
        return 0.0, 0.0

    @property
    def teams(self) -> tuple[tuple[int, ...], ...]:
        half = self.num_agents // 2
        return tuple(range(half)), tuple(range(half, self.num_agents))

    @property
    def team_of(self) -> np.ndarray:
        """Team of each agent (A,)."""
        return np.repeat([0, 1], self.num_agents // 2)

    def __init__(self, params: P | None = None, **options: Any) -> None:
        check("symmetry", self.symmetry, Literal["turn", "reflect"])
        super().__init__(params, **options)
        if self.symmetry == "turn" or self.control != "command":
            return
        names = self.controller.commands
        mirrors = self.controller.skill.column("mirror", names)
        for name, mirror, (low, high) in zip(names, mirrors, self.controller.changes, strict=True):
            if mirror < 0 and low != -high:
                given = self.params.command_ranges[name]
                fail(
                    f"command_ranges.{name}",
                    given,
                    f"symmetric in {self.name}, which mirrors team 1",
                )

    def eliminated(self, state: State[S], robot_state: RobotState) -> jax.Array:
        """Returns which team is eliminated (2,) bool: by default one with a fallen active robot."""
        return jnp.any(self.fallen(robot_state).reshape(2, -1), axis=1)

    def leading(self, state: State[S], robot_state: RobotState) -> jax.Array:
        """Returns which team leads if neither is eliminated (2,) bool."""
        return jnp.zeros(2, bool)

    def wins(self, state: State[S], robot_state: RobotState) -> jax.Array:
        """Returns which team wins if the episode ends in this step (2,) bool, at most one."""
        out = check_shape("eliminated", self.eliminated(state, robot_state), (2,))
        leading = check_shape("leading", self.leading(state, robot_state), (2,))
        return jnp.where(jnp.any(out), out[::-1] & ~out, leading & ~leading[::-1])

    def further(self, state: State[S], robot_state: RobotState) -> dict[str, jax.Array]:
        """Returns further results of both teams by name (2,), if the episode ends in this step."""
        return {}

    def teams_blocks(self, masked: bool = False) -> tuple[Block, ...]:
        """Returns the first blocks of teams of robots.

        `observe_teams` fills them, if they are not `masked`.
        """
        team = self.num_agents // 2
        blocks = [one_hot(team, "agent's id within its team"), BASE]

        def robots(name: str, count: int) -> Block:
            return entities(name, "robot", count, 6, BASE_INFO, masked=masked, quantities=POSE)

        if team > 1:
            blocks.append(robots("teammate", team - 1))
        blocks.append(robots("opponents", team))
        return tuple(blocks)

    def observe_teams(self, robot_state: RobotState) -> dict[str, jax.Array]:
        """Returns the blocks of `teams_blocks` (A, width), each in its agent's own frame."""
        team = self.num_agents // 2
        # (observing team, observed team, robot, info)
        both = self.views(robot_state.base_info).reshape(2, 2, team, 6)
        own = both[[0, 1], [0, 1]]
        opponents = both[[0, 1], [1, 0]].reshape(2, -1)
        mates = {"teammate": jax.vmap(others)(own).reshape(self.num_agents, -1)} if team > 1 else {}
        one_hot = jnp.tile(jnp.eye(team), (2, 1))
        return {
            "one_hot": one_hot,
            "base": own.reshape(-1, 6),
            **mates,
            "opponents": opponents[self.team_of],
        }

    def views(self, info: jax.Array) -> jax.Array:
        """Transforms base information (R, 6) to both teams' frames (2, R, 6).

        It is position, m, and roll, pitch, yaw, rad.
        """
        position = self.view_points(info[:, :3])[1]
        roll, pitch, yaw = jnp.moveaxis(info[:, 3:], -1, 0)
        if self.symmetry == "turn":
            euler = jnp.stack([roll, pitch, jnp.arctan2(-jnp.sin(yaw), -jnp.cos(yaw))], axis=-1)
        else:
            euler = jnp.stack([-roll, pitch, -yaw], axis=-1)
        return jnp.stack([info, jnp.concatenate([position, euler], axis=-1)])

    def view_points(self, points: jax.Array) -> jax.Array:
        """Transforms points (..., 3), m, to both teams' frames: (2, ..., 3)."""
        middle = jnp.array([*self.center, 0.0])
        return self.view_vectors(points - middle) + middle

    def view_vectors(self, vectors: jax.Array) -> jax.Array:
        """Transforms vectors (..., 3), such as velocities, to both teams' frames: (2, ..., 3)."""
        other = jnp.array([-1.0, -1.0, 1.0] if self.symmetry == "turn" else [1.0, -1.0, 1.0])
        return jnp.stack([vectors, vectors * other])

    @property
    def reflected(self) -> bool:
        return self.symmetry == "reflect"

    def own_frame(self, info: jax.Array) -> jax.Array:
        return self.views(info)[self.team_of, np.arange(self.num_agents)]

    def observe_group(
        self, name: str, state: State[S], robot_state: RobotState
    ) -> dict[str, jax.Array]:
        """Blocks (A, width), each in its agent's own frame."""
        blocks = super().observe_group(name, state, robot_state)
        if not self.reflected or name != "proprioception":
            return blocks
        reflect = self.robots.reflect
        image = {
            "gravity": blocks["gravity"] * np.array([1.0, -1.0, 1.0], np.float32),
            "joint_position": reflect(blocks["joint_position"]),
            "joint_velocity": reflect(blocks["joint_velocity"]),
        }
        return {x: jnp.where(self.team_of[:, None] == 1, image[x], blocks[x]) for x in blocks}

    def unmirror_action(self, action: jax.Array) -> jax.Array:
        """Reflects the actions (A, action_size) of team 1 if its frame is reflected."""
        if self.symmetry == "turn":
            return action
        if self.control == "command":
            mirrored = action * self.controller.skill.column("mirror", self.controller.commands)
        else:
            mirrored = self.robots.reflect(action)
        return jnp.where(self.team_of[:, None] == 1, mirrored, action)

    def zero_sum(self, own: jax.Array) -> jax.Array:
        """Returns each agent's zero-sum term (A,) from both teams' own terms (2,)."""
        own = jnp.asarray(own, jnp.float32)
        return (own - own[::-1])[self.team_of]

    def result(self, state: State[S], robot_state: RobotState, failed: jax.Array) -> Outcome:
        wins = self.wins(state, robot_state)
        draw = jnp.broadcast_to(~jnp.any(wins), wins.shape)
        return Outcome(
            success=wins,
            win=wins,
            draw=draw,
            loss=wins[::-1],
            further=self.further(state, robot_state),
        )


class Duel(Match[S, P]):
    """Base of the one-on-one matches: each observes both robots in its own frame."""

    @property
    def observation_layout(self) -> ObservationLayout:
        return ObservationLayout((BASE, Block("opponent", 6, BASE_INFO, quantities=POSE)))

    def observe(self, state: State[S], robot_state: RobotState) -> dict[str, jax.Array]:
        """Blocks (2, width), each in its agent's own frame."""
        views = self.views(robot_state.base_info)
        return {
            "base": jnp.stack([views[0, 0], views[1, 1]]),
            "opponent": jnp.stack([views[0, 1], views[1, 0]]),
        }
