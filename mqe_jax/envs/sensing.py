"""What a task tells its robots' sensors."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core.errors import InputError
from mqe_jax.envs.state import State
from mqe_jax.physics.robots.fleet import Fleet
from mqe_jax.physics.robots.index import RobotState
from mqe_jax.physics.scene import CompiledScene
from mqe_jax.sensors.marks import Marks
from mqe_jax.sensors.scene import Entity, SensedScene, Snapshot, entities_of
from mqe_jax.sensors.suite import ONBOARD, Suite
from mqe_jax.skills.control import Controller


class Sensing:
    """Base of all tasks: their sensors, and what there is to sense."""

    params: Any
    compiled: CompiledScene
    num_agents: int
    controller: Controller
    robots: Fleet
    impl: str
    dt: float
    teams: Any
    layouts: Any
    read: Any

    @property
    def action_size(self) -> int:
        """Length of an agent's action.

        It moves the robot, then serves sensors, such as messages.
        """
        added = sum(sensor.action_size for sensor in self.params.senses)
        return self.controller.action_size + added

    @functools.cached_property
    def used(self) -> np.ndarray | None:
        """Which entries of each agent's action count (A, action_size) bool; None: all.

        An action has an entry for each joint of the robot with the most.
        """
        moving = self.robots.has_joint[: self.num_agents, : self.controller.action_size]
        if self.controller.mode == "command" or moving.all():
            return None
        others = np.ones((self.num_agents, self.action_size - moving.shape[1]), bool)
        return np.concatenate([moving, others], axis=1)

    def moving(self, action: jax.Array) -> jax.Array:
        """Returns the part of actions (..., action_size) that moves the robots."""
        return action[..., : self.controller.action_size]

    def check_senses(self) -> None:
        """Raises an InputError for a sensor that the engine lacks, or as `Suite.check`."""
        for sensor in self.params.senses:
            if sensor.engines and self.impl not in sensor.engines:
                allowed = " or ".join(sensor.engines)
                raise InputError(
                    f"senses: {sensor.name!r} needs impl {allowed}; the engine here is {self.impl}"
                )
        if self.params.senses:
            self.suite.check()

    @property
    def entities(self) -> tuple[Entity, ...]:
        """What sensors tell apart besides robots and walls, by default objects and gaps."""
        return entities_of(self.compiled)

    @property
    def reflected(self) -> bool:
        """Whether the frame of the second team is a reflection of the first's."""
        return False

    def own_frame(self, info: jax.Array) -> jax.Array:
        """Maps the agents' base information (A, 6) to each agent's own frame."""
        return info

    @functools.cached_property
    def suite(self) -> Suite:
        """The robots' sensors."""
        sensed = SensedScene(
            self.compiled, self.entities, self.teams, self.action_size, self.dt, self.reflected
        )
        return Suite(sensed, self.params.senses)

    def snapshot(self, state: State[Any], robot_state: RobotState) -> Snapshot:
        """Returns what there is to sense in a state."""
        pose = self.own_frame(robot_state.base_info[: self.num_agents])[:, [0, 1, 5]]
        action = jnp.zeros((self.num_agents, self.action_size))
        if state.senses:
            action = state.senses.action
        return self.suite.scene.snapshot(state.data, robot_state, state.anchors, pose, action)

    def marks(self, state: State[Any]) -> tuple[Marks, ...]:
        """Returns what shows the readings in a state that has the group `onboard`."""
        readings = self.layouts[ONBOARD].split(state.groups[ONBOARD])
        snapshot = self.snapshot(state, self.read(state.data, state.active))
        return self.suite.draw(snapshot, state.senses, readings)
