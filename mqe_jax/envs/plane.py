"""go1plane: robots on flat ground without obstacles, for tests and demonstrations."""

import jax
import jax.numpy as jnp

from mqe_jax.core.limits import Length
from mqe_jax.core.settings import settings_class
from mqe_jax.envs.base import QuadrupedEnv
from mqe_jax.envs.observation import ObservationLayout, observe_team, team_blocks
from mqe_jax.envs.params import TaskParams
from mqe_jax.envs.state import Moment, State
from mqe_jax.physics.robots.index import RobotState
from mqe_jax.physics.scene import Scene
from mqe_jax.terrain import Plane, SpawnArea, Track


@settings_class
class PlaneRewards:
    """Weights of the reward terms."""

    forward: float = 1.0
    """Per m of the robots' summed displacement along x."""


@settings_class
class PlaneParams(TaskParams):
    """Parameters of Plane."""

    width: Length = 3.0
    """Width of the strip across which the robots are spawned side by side, m."""
    rewards: PlaneRewards = PlaneRewards()
    """Weights of the reward terms."""


class Go1Plane(QuadrupedEnv[None, PlaneParams]):
    """Robots on flat ground.

    - Action: see `mqe_jax.skills.control`.
    - Observation: one-hot, own base info, the teammates' base info.
    - Reward: the robots' summed displacement along x.
    - End: a fall, or the time limit.
    """

    name = "go1plane"
    title = "Plane"
    aim = "Walk forward."
    Params = PlaneParams
    variable_num_agents = True

    def scene(self) -> Scene:
        track = Track(
            blocks=(SpawnArea(2.0, back_wall=False), Plane(2.0)),
            width=self.params.width,
            num_robots=self.num_agents,
            walled=False,
        )
        return Scene(track, num_robots=self.num_agents)

    @property
    def observation_layout(self) -> ObservationLayout:
        return ObservationLayout(team_blocks(self.num_agents))

    def observe(self, state: State, robot_state: RobotState) -> dict[str, jax.Array]:
        return observe_team(robot_state.base_info)

    def rewards(self, before: Moment, after: Moment, collision: jax.Array) -> dict[str, jax.Array]:
        return {
            "forward": jnp.sum(
                after.robots.count(after.robots.position_w[:, 0] - before.robots.position_w[:, 0])
            )
        }

    def outcome(
        self, state: State, robot_state: RobotState, failed: jax.Array
    ) -> dict[str, jax.Array]:
        """Success: no robot has fallen."""
        return {"success": 1.0 - jnp.asarray(failed, jnp.float32)}
