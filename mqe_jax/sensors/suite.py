"""The sensors of a task's robots together: their settings, and their group of observations."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pydantic

from mqe_jax.core.blocks import Block
from mqe_jax.core.errors import InputError, nearest
from mqe_jax.core.returned import alike, check_names, check_shape
from mqe_jax.core.settings import build, fail
from mqe_jax.sensors import SENSORS, Sensor, depth, messages  # noqa: F401
from mqe_jax.sensors.detections import Detections
from mqe_jax.sensors.lidar import Lidar
from mqe_jax.sensors.marks import Marks
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
"""Sets of sensors by name, for the parameter `senses`; `full`: only the task's observations."""

_ALLOWED = f"{', '.join(SETS)}, or a list of sensors, such as [proprioception, lidar]"


def sensors_of(value: Any) -> tuple[Sensor, ...]:
    """Returns sensors from the name of a set, or from a sequence.

    An item is a sensor, a name or a mapping.

    Raises:
        InputError: for an unknown name, two sensors of one name, or two that add to actions.
    """
    if isinstance(value, str):
        if value not in SETS:
            fail("senses", value, f"{_ALLOWED}{nearest(value, SETS)}")
        return SETS[value]
    if not isinstance(value, Sequence):
        fail("senses", value, _ALLOWED)
    sensors = tuple(map(_sensor, value))
    if len({sensor.name for sensor in sensors}) < len(sensors):
        fail("senses", [sensor.name for sensor in sensors], "sensors of different names")
    added = [sensor.name for sensor in sensors if sensor.action_size]
    if len(added) > 1:
        fail("senses", added, "sensors of which at most one adds to actions")
    return sensors


def _sensor(value: Any) -> Sensor:
    if isinstance(value, Sensor):
        return value
    settings = value if isinstance(value, Mapping) else {"name": value}
    name = settings.get("name")
    if not isinstance(name, str) or name not in SENSORS:
        fail("senses", value, f"a registered sensor: {', '.join(SENSORS)}{nearest(name, SENSORS)}")
    try:
        return build(SENSORS[name], settings)
    except InputError as error:
        raise InputError(f"senses.{name}.{error}") from None


Senses = Annotated[
    tuple[pydantic.SerializeAsAny[Sensor], ...], pydantic.BeforeValidator(sensors_of)
]
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
        return [(sensor, block) for sensor in self.sensors for block in sensor.layout(self.scene)]

    def check(self) -> None:
        """Raises an InputError for a pipeline of an unknown block, or two blocks of one name."""
        for sensor in self.sensors:
            names = ["all", *(block.name for owner, block in self._measured if owner is sensor)]
            unknown = [name for name in sensor.pipeline if name not in names]
            if unknown:
                fail(f"senses.{sensor.name}.pipeline", unknown[0], f"one of {', '.join(names)}")
        names = [block.name for _, block in self._measured]
        if len({*names}) < len(names):
            fail("senses", names, "sensors whose blocks have different names")

    def reset(self) -> SensorState:
        """Returns the state at the start of an episode."""
        action = jnp.zeros((self.scene.num_agents, self.scene.action_size))
        memory = {sensor.name: sensor.init_memory(self.scene) for sensor in self.sensors}
        queues = {}
        for sensor, block in self._measured:
            pipeline = sensor.pipeline_of(block)
            if pipeline != Pipeline():
                queues[block.name] = pipeline.init_memory(block, self.scene.num_agents)
        return SensorState(action, memory, queues)

    @jax.named_scope("sensors")
    def observe(
        self, snapshot: Snapshot, state: SensorState, key: jax.Array
    ) -> tuple[dict[str, jax.Array], SensorState]:
        """Returns the readings by block (A, width) and the next state; once a step."""
        readings = {}
        memory = {}
        for number, sensor in enumerate(self.sensors):
            own_key = jax.random.fold_in(key, number)
            blocks, memory[sensor.name] = self._read(
                sensor, snapshot, state.memory[sensor.name], own_key
            )
            readings |= blocks
        piped = {}
        for sensor, block in self._measured:
            if block.name in state.queues:
                piped[block.name] = sensor.pipeline_of(block), block
        noise, lost = self._chances(piped, jax.random.fold_in(key, len(self.sensors)))
        queues = {}
        for name, (pipeline, block) in piped.items():
            readings[name], queues[name] = pipeline.apply(
                block,
                readings[name],
                state.queues[name],
                noise=noise.get(name, 0.0),
                lost=lost.get(name, False),
            )
        return readings, SensorState(state.action, memory, queues)

    def _read(
        self, sensor: Sensor, snapshot: Snapshot, memory: Any, key: jax.Array
    ) -> tuple[dict[str, jax.Array], Any]:
        """Returns what a sensor observes.

        ValueError for blocks unlike its layout, or a memory unlike the last.
        """
        method = f"{type(sensor).__name__}.observe"
        readings, after = sensor.observe(self.scene, snapshot, memory, key)
        widths = {block.name: block.width for owner, block in self._measured if owner is sensor}
        check_names(method, readings, widths)
        for name, width in widths.items():
            check_shape(f"{method}: {name}", readings[name], (self.scene.num_agents, width))
        return readings, alike(f"{method}: memory", after, memory)

    def _chances(
        self, piped: Mapping[str, tuple[Pipeline, Block]], key: jax.Array
    ) -> tuple[dict[str, jax.Array], dict[str, jax.Array]]:
        """Returns the noise and the losses of blocks whose pipelines have some.

        There is one draw of each for all blocks, which saves time.
        """
        agents = self.scene.num_agents
        noise_key, loss_key = jax.random.split(key)
        noisy = {name: block.width for name, (pipeline, block) in piped.items() if pipeline.noise}
        noise = {}
        if noisy:
            drawn = jax.random.normal(noise_key, (agents, sum(noisy.values())))
            parts = jnp.split(drawn, np.cumsum([*noisy.values()])[:-1], axis=1)
            noise = dict(zip(noisy, parts, strict=True))
        lossy = [name for name, (pipeline, _) in piped.items() if pipeline.dropout]
        lost = {}
        if lossy:
            drawn = jax.random.uniform(loss_key, (len(lossy), agents, 1))
            for name, loss in zip(lossy, drawn, strict=True):
                lost[name] = loss < piped[name][0].dropout
        return noise, lost

    def draw(
        self, snapshot: Snapshot, state: SensorState, readings: Mapping[str, jax.Array]
    ) -> tuple[Marks, ...]:
        """Returns what shows the sensors' readings.

        `readings` are by block as `observe` returns them, `state` is the state after it.
        """
        newest = {}
        for sensor, block in self._measured:
            pipeline = sensor.pipeline_of(block)
            newest[block.name] = pipeline.newest(block, readings[block.name])
        drawn = []
        for sensor in self.sensors:
            drawn += sensor.draw(self.scene, snapshot, newest, state.memory[sensor.name])
        return tuple(drawn)
