"""go1plane: robots on flat ground and nothing else, for tests and demonstrations."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from mujoco import mjx

from mqe_jax.envs.base import QuadrupedEnv, State
from mqe_jax.envs.observation import BASE_INFO, ONE_HOT, Block, ObservationLayout, others
from mqe_jax.envs.params import TaskParams
from mqe_jax.robots.index import RobotState
from mqe_jax.scene import Scene
from mqe_jax.terrain import SpawnArea, Plane, Track


@dataclasses.dataclass(frozen=True)
class PlaneRewards:
    """Weights: `forward` of the robots' summed way along x, per m."""

    forward: float = 1.0


@dataclasses.dataclass(frozen=True)
class PlaneParams(TaskParams):
    """Parameters.

    Attributes:
        width: of the ground that the robots start on side by side, m.
        rewards: weights.
    """

    width: float = 3.0
    rewards: PlaneRewards = PlaneRewards()


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PlaneState:
    """`x`: of the robots after the last step (A,), m."""

    x: jax.Array


class Go1Plane(QuadrupedEnv):
    """Robots on flat ground.

    - Action: see `mqe_jax.control`.
    - Observation: one-hot, own base info, the others' base info.
    - Reward: the robots' summed way along x.
    - End: a fall, or the time limit.
    """

    name = "go1plane"
    title = "Plane"
    Params: ClassVar[type[TaskParams]] = PlaneParams
    variable_num_agents = True

    def scene(self) -> Scene:
        """Says what is in the world."""
        track = Track(
            blocks=(SpawnArea(2.0, back_wall=False), Plane(2.0)),
            width=self.params.width,
            num_robots=self.num_agents,
            walled=False,
        )
        return Scene(track, num_robots=self.num_agents)

    def reset_task(self, key: jax.Array, robot_state: RobotState, data: mjx.Data, anchors: jax.Array) -> PlaneState:
        """Returns the task's own fields of a fresh world."""
        return PlaneState(robot_state.position_w[:, 0])

    @property
    def observation_layout(self) -> ObservationLayout:
        """The blocks of an agent's observation, in order."""
        agents = self.num_agents
        blocks = [Block("one_hot", agents, ONE_HOT), Block("base", 6, BASE_INFO)]
        blocks += [Block("mates", 6 * (agents - 1), BASE_INFO)] if agents > 1 else []
        return ObservationLayout(tuple(blocks))

    def observe(self, state: State, robot_state: RobotState) -> dict[str, jax.Array]:
        """Returns the observation's blocks by name (A, width)."""
        info = robot_state.base_info
        blocks = {"one_hot": jnp.eye(self.num_agents), "base": info}
        return blocks | ({"mates": others(info)} if self.num_agents > 1 else {})

    def rewards(self, state: State, robot_state: RobotState, collision: jax.Array) -> tuple[dict[str, jax.Array], Any]:
        """Returns the reward terms and the task's fields after the step."""
        x = robot_state.position_w[:, 0]
        return {"forward": jnp.sum(x - state.task.x)}, PlaneState(x)

    def outcome(self, state: State, robot_state: RobotState, failed: jax.Array) -> dict[str, jax.Array]:
        """Success: nobody has fallen."""
        return {"success": 1.0 - failed}
