"""What a task tells its robots' sensors."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp

from mqe_jax.envs.state import State
from mqe_jax.physics.robots.index import RobotState
from mqe_jax.physics.scene import CompiledScene
from mqe_jax.sensors.scene import Entity, SensedScene, Snapshot, entities_of
from mqe_jax.sensors.suite import Suite
from mqe_jax.skills.control import Controller


class Sensing:
    """Base of all tasks: their sensors, and what there is to sense."""

    params: Any
    compiled: CompiledScene
    num_agents: int
    controller: Controller
    dt: float
    teams: Any

    @property
    def action_size(self) -> int:
        """Length of an agent's action."""
        return self.controller.action_size

    @property
    def entities(self) -> tuple[Entity, ...]:
        """What sensors tell apart besides robots and walls: by default the scene's objects and gaps."""
        return entities_of(self.compiled)

    @property
    def reflected(self) -> bool:
        """Whether the frame of the second team is a reflection of the first's."""
        return False

    def own_frame(self, info: jax.Array) -> jax.Array:
        """Maps the agents' base information (A, 6) to each agent's own (possibly mirrored) frame."""
        return info

    @functools.cached_property
    def suite(self) -> Suite:
        """The robots' sensors."""
        sensed = SensedScene(self.compiled, self.entities, self.teams, self.action_size, self.dt, self.reflected)
        return Suite(sensed, self.params.senses)

    def snapshot(self, state: State[Any], robot_state: RobotState) -> Snapshot:
        """Returns what there is to sense in a state."""
        pose = self.own_frame(robot_state.base_info[: self.num_agents])[:, [0, 1, 5]]
        action = state.senses.action if state.senses else jnp.zeros((self.num_agents, self.action_size))
        return self.suite.scene.snapshot(state.data, robot_state, state.anchors, pose, action)
