"""The sensors of a task's robots together: settings by name, and the group of observations that they make."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import pydantic

from mqe_jax.core.blocks import Block
from mqe_jax.core.errors import nearest
from mqe_jax.core.settings import build, fail
from mqe_jax.sensors import SENSORS, Sensor
from mqe_jax.sensors.detections import Detections
from mqe_jax.sensors.lidar import Lidar
from mqe_jax.sensors.pipeline import Pipeline
from mqe_jax.sensors.proprioception import Proprioception
from mqe_jax.sensors.scene import SensedScene, Snapshot

ONBOARD = "onboard"
"""Name of the group of observations that sensors make."""

SETS: dict[str, tuple[Sensor, ...]] = {
    "full": (),
    ONBOARD: (
        Proprioception(
            pipeline={
                "gravity": Pipeline(noise=0.02),
                "angular_velocity": Pipeline(noise=0.1),
                "joint_position": Pipeline(noise=0.01),
                "joint_velocity": Pipeline(noise=0.5),
            }
        ),
        Detections(pipeline={"all": Pipeline(delay=2)}),
        Lidar(pipeline={"all": Pipeline(noise=0.02)}),
    ),
}
"""Sensors by the names that the parameter `senses` has for them; `full` are the task's own observations alone."""


def sensors_of(value: Any) -> tuple[Sensor, ...]:
    """Returns sensors from the name of a set, or from a sequence of sensors, of their names and of mappings.

    Raises:
        InputError: for an unknown name, or two sensors of one name.
    """
    if isinstance(value, str):
        if value not in SETS:
            fail("senses", value, f"{', '.join(SETS)}, or a list of sensors{nearest(value, SETS)}")
        return SETS[value]
    if not isinstance(value, Sequence):
        fail("senses", value, f"{', '.join(SETS)}, or a list of sensors")
    sensors = tuple(map(_sensor, value))
    if len({sensor.name for sensor in sensors}) < len(sensors):
        fail("senses", [sensor.name for sensor in sensors], "sensors of different names")
    return sensors


def _sensor(value: Any) -> Sensor:
    if isinstance(value, Sensor):
        return value
    settings = value if isinstance(value, Mapping) else {"name": value}
    name = settings.get("name")
    if not isinstance(name, str) or name not in SENSORS:
        fail("senses", value, f"a registered sensor: {', '.join(SENSORS)}{nearest(name, SENSORS)}")
    return build(SENSORS[name], settings)


Senses = Annotated[tuple[pydantic.SerializeAsAny[Sensor], ...], pydantic.BeforeValidator(sensors_of)]
"""Type of a field that holds sensors."""


class SensorState(NamedTuple):
    """What the sensors of A agents keep between steps; part of an environment's state."""

    action: jax.Array
    """The agents' last actions, each in its own frame (A, D)."""
    memory: dict[str, Any]
    """The sensors' recurrent states by name."""
    queues: dict[str, Any]
    """Memories of pipelines by block."""


@dataclasses.dataclass(frozen=True)
class Suite:
    """Sensors of the agents of a scene."""

    scene: SensedScene
    sensors: tuple[Sensor, ...]

    @property
    def blocks(self) -> tuple[Block, ...]:
        """The blocks of all readings, in order."""
        return tuple(sensor.pipeline_of(block).block(block) for sensor, block in self._measured)

    @functools.cached_property
    def _measured(self) -> list[tuple[Sensor, Block]]:
        """The blocks that the sensors measure, before their pipelines."""
        found = [(sensor, sensor.layout(self.scene)) for sensor in self.sensors]
        for sensor, blocks in found:
            names = ["all", *(block.name for block in blocks)]
            if unknown := [name for name in sensor.pipeline if name not in names]:
                fail(f"senses.{sensor.name}.pipeline", unknown[0], f"one of {', '.join(names)}")
        return [(sensor, block) for sensor, blocks in found for block in blocks]

    def reset(self) -> SensorState:
        """Returns the state at the start of an episode."""
        action = jnp.zeros((self.scene.num_agents, self.scene.action_size))
        memory = {sensor.name: sensor.init_memory(self.scene) for sensor in self.sensors}
        queues = {
            block.name: sensor.pipeline_of(block).init_memory(block, self.scene.num_agents)
            for sensor, block in self._measured
            if sensor.pipeline_of(block) != Pipeline()
        }
        return SensorState(action, memory, queues)

    @jax.named_scope("sensors")
    def observe(
        self, snapshot: Snapshot, state: SensorState, key: jax.Array
    ) -> tuple[dict[str, jax.Array], SensorState]:
        """Returns the readings by block (A, width) and the next state; once a step."""
        readings, memory = {}, {}
        for number, sensor in enumerate(self.sensors):
            own_key = jax.random.fold_in(key, number)
            blocks, memory[sensor.name] = sensor.observe(self.scene, snapshot, state.memory[sensor.name], own_key)
            readings |= blocks
        queues = {}
        for number, (sensor, block) in enumerate(self._measured):
            if block.name in state.queues:
                own_key = jax.random.fold_in(key, len(self.sensors) + number)
                pipeline, queue = sensor.pipeline_of(block), state.queues[block.name]
                readings[block.name], queues[block.name] = pipeline.apply(block, readings[block.name], queue, own_key)
        return readings, SensorState(state.action, memory, queues)
