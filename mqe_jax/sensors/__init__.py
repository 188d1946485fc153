"""Sensors: what robots measure, as blocks of an observation; their registry.

A sensor is a settings class derived from `Sensor` in its own file, registered by `register`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, TypeVar

import jax
import mujoco

from mqe_jax.core.blocks import Block
from mqe_jax.core.errors import InputError
from mqe_jax.core.settings import FrozenMapping, fail, is_settings, settings_class
from mqe_jax.sensors.marks import Marks
from mqe_jax.sensors.pipeline import Pipeline
from mqe_jax.sensors.scene import SensedScene, Snapshot


@settings_class
class Sensor:
    """Base of all sensors: functions of one environment, for all its agents.

    Example:
        ```python
        from typing import Literal

        from mqe_jax.core.blocks import Block
        from mqe_jax.core.settings import settings_class
        from mqe_jax.sensors import Sensor, register

        @register
        @settings_class
        class Altimeter(Sensor):
            name: Literal["altimeter"] = "altimeter"

            def layout(self, scene):
                return (Block("height", 1, "of the trunk, m"),)

            def observe(self, scene, snapshot, memory, key):
                return {"height": snapshot.height[:, None]}, memory

        print(mqe_jax.make("go1gate", senses=["altimeter"]).layouts["onboard"])
        ```
    """

    engines: ClassVar[tuple[str, ...]] = ()
    """Engines on which it works; empty: all."""

    name: str = ""
    """Name in the registry. A subclass has a `Literal` here, with its value as the default."""
    pipeline: Mapping[str, Pipeline] = FrozenMapping()
    """What happens to the readings of its blocks, by their names; `all` stands for those that are
    not named."""

    @property
    def action_size(self) -> int:
        """Number of entries that it appends to an agent's action.

        At most one sensor of a task appends some.
        """
        return 0

    def pipeline_of(self, block: Block) -> Pipeline:
        """Returns what happens to the readings of a block."""
        return self.pipeline.get(block.name, self.pipeline.get("all", Pipeline()))

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        """Adds what the sensor needs, such as cameras, to the specification of the physics."""

    def layout(self, scene: SensedScene) -> tuple[Block, ...]:
        """Returns the blocks of its readings: names, widths, meaning with unit and frame."""
        raise NotImplementedError(f"sensor {type(self).__name__}: layout() is not defined")

    def init_memory(self, scene: SensedScene) -> Any:
        """Returns its recurrent state (`memory`) at the start of an episode, a pytree of arrays."""
        return ()

    def observe(
        self, scene: SensedScene, snapshot: Snapshot, memory: Any, key: jax.Array
    ) -> tuple[dict[str, jax.Array], Any]:
        """Returns the readings of all agents by block (A, width), and the next memory.

        Each agent's readings are in its own frame.

        Args:
            scene: what does not change, such as `num_agents`, `dt`, and `mirror` (A,), by which
                angles to the left are multiplied.
            snapshot: the step: poses of robots and entities, and each agent's pose in its own
                frame.
            memory: what the last call returned, at first `init_memory(scene)`; always the same
                shapes.
            key: a random key, one for all agents: draw arrays (A, ...).
        """
        raise NotImplementedError(f"sensor {type(self).__name__}: observe() is not defined")

    def draw(
        self, scene: SensedScene, snapshot: Snapshot, readings: Mapping[str, jax.Array], memory: Any
    ) -> tuple[Marks, ...]:
        """Returns the marks that `--sensors` draws.

        `readings` are the latest by block (A, width), unscaled.
        """
        return ()


SENSORS: dict[str, type[Sensor]] = {}
"""Settings classes of sensors by name."""

S = TypeVar("S", bound=type[Sensor])


def register(sensor: S) -> S:
    """Registers a settings class under its default `name`, and returns it; a class decorator.

    Raises:
        InputError: for anything else, a class without a name, or a name of another class.
    """
    if not (isinstance(sensor, type) and issubclass(sensor, Sensor) and is_settings(sensor)):
        fail("sensor", sensor, "a class derived from Sensor, below @register and @settings_class")
    name = sensor().name
    if not name:
        raise InputError(f"sensor {sensor.__name__}: the field name has no default")
    if SENSORS.setdefault(name, sensor) is not sensor:
        raise InputError(f"sensor: the name {name!r} is already registered")
    return sensor
