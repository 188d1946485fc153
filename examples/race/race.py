import jax.numpy as jnp

from mqe_jax.core.settings import settings_class
from mqe_jax.envs import TaskParams, register_task
from mqe_jax.envs.match import Duel
from mqe_jax.physics.scene import Scene
from mqe_jax.terrain import EndWall, Plane, SpawnArea, Track


@settings_class
class RaceRewards:
    lead: float = 1.0
    """Per m that a robot gains on the other."""


@settings_class
class RaceParams(TaskParams):
    rewards: RaceRewards = RaceRewards()


class Race(Duel[None, RaceParams]):
    """Two robots race to x = 4 m."""

    name, title, Params = "race", "Race", RaceParams
    symmetry = "reflect"  # the robots start side by side

    def scene(self):
        return Scene(Track(blocks=(SpawnArea(1.5), Plane(4.0), EndWall()), width=4.0))

    def rewards(self, before, after, collision):
        walked = after.robots.position_w[:, 0] - before.robots.position_w[:, 0]
        return {"lead": self.zero_sum(walked)}

    def ending(self, state, robot_state):
        return jnp.any(robot_state.position_w[:, 0] > 4.0)

    def leading(self, state, robot_state):
        x = robot_state.position_w[:, 0]
        return x > x[::-1]


register_task(Race)
