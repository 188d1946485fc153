"""Messages: numbers that robots send to the teammates in range with their actions."""

from collections.abc import Mapping
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core.blocks import Block, by_entity, entities
from mqe_jax.core.limits import Few, Fraction, Length
from mqe_jax.core.settings import fail, settings_class
from mqe_jax.sensors import Sensor, register
from mqe_jax.sensors.marks import Marks, marks
from mqe_jax.sensors.scene import SensedScene, Snapshot

_COLOR = (0.95, 0.2, 0.2)


@register
@settings_class
class Messages(Sensor):
    """The last numbers of an agent's action.

    Its teammates in range receive them with their next observation.

    They do not move the robot. An episode starts without messages, and robots that are out send
    none.
    """

    name: Literal["messages"] = "messages"
    """Name of the sensor."""
    numbers: Few = 2
    """Numbers of a message, each from -1 to 1."""
    range: Length = 10.0
    """Maximum distance, m."""
    loss: Fraction = 0.0
    """Share of messages that a teammate does not receive, each by chance."""

    @property
    def action_size(self) -> int:
        return self.numbers

    def layout(self, scene: SensedScene) -> tuple[Block, ...]:
        mates, _ = scene.mates
        if not mates.shape[1]:
            fail(
                "senses",
                self.name,
                f"left out if no robot has teammates: there are {len(scene.teams)} teams of 1",
            )
        meaning = "what each teammate sent in the last step, as received"
        return (entities("messages", "robot", mates.shape[1], self.numbers, meaning, masked=True),)

    def init_memory(self, scene: SensedScene) -> Any:
        """Returns whether messages were sent in a step, and which are received (A, count)."""
        return jnp.zeros((), bool), jnp.zeros(scene.mates[0].shape, bool)

    def observe(
        self, scene: SensedScene, snapshot: Snapshot, memory: Any, key: jax.Array
    ) -> tuple[dict[str, jax.Array], Any]:
        mates, there = scene.mates
        spots = snapshot.places[: scene.num_agents, :2]
        away = jnp.linalg.norm(spots[mates] - spots[:, None], axis=-1)
        active = snapshot.robots.active[: scene.num_agents]
        was_sent, _ = memory
        received = there & (away <= self.range) & active[mates] & active[:, None] & was_sent
        if self.loss:
            received &= ~jax.random.bernoulli(key, self.loss, received.shape)
        sent = snapshot.action[:, scene.action_size - self.numbers :]
        return {"messages": by_entity(sent[mates], received)}, (jnp.ones((), bool), received)

    def draw(
        self, scene: SensedScene, snapshot: Snapshot, readings: Mapping[str, jax.Array], memory: Any
    ) -> tuple[Marks, ...]:
        """Shows a line to each teammate whose message is received."""
        mates, _ = scene.mates
        spots = snapshot.places[: scene.num_agents, :2]
        ends = spots[mates]
        lines = jnp.stack([jnp.broadcast_to(spots[:, None], ends.shape), ends], axis=2)
        _, received = memory
        opacity = received.astype(np.float32)
        shown = marks(
            "message", _COLOR, snapshot.height, lines=lines, line_opacity=opacity, bold=True
        )
        return (shown,)
