"""What happens to a sensor's readings between the sensor and the policy."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from mqe_jax.core.blocks import Block
from mqe_jax.core.limits import Deviation, Few, Fraction, Lag, Positive
from mqe_jax.core.settings import Range, settings_class


@settings_class
class Pipeline:
    """What happens to the readings of one block, in this order.

    Masks are delayed and dropped only.
    """

    noise: Deviation = 0.0
    """Standard deviation of normal noise, in the block's unit."""
    clip: Range | None = None
    """Lowest and highest value, in the block's unit."""
    scale: Positive = 1.0
    """Factor."""
    delay: Lag = 0
    """Delay, environment steps."""
    dropout: Fraction = 0.0
    """Share of readings of an agent that are lost: the last one takes their place."""
    history: Few = 1
    """Number of readings of which the block consists, newest first; they are channels of an
    image."""

    def block(self, block: Block) -> Block:
        """Returns the block that comes out."""
        entities = block.entities
        if entities is not None:
            entities = dataclasses.replace(entities, count=self.history * entities.count)
        image = block.image
        if image is not None:
            channels, height, width = image
            image = (self.history * channels, height, width)
        return dataclasses.replace(
            block, width=self.history * block.width, entities=entities, image=image
        )

    def newest(self, block: Block, value: jax.Array) -> jax.Array:
        """Returns the newest reading (A, width) in what comes out, without the scale."""
        value = value[:, : block.width]
        return jnp.where(block.continuous > 0, value / self.scale, value)

    def init_memory(self, block: Block, agents: int) -> Any:
        """Returns the initial memory of a pipeline.

        It holds the readings on their way (D, A, W), those last delivered (H, A, W), and whether
        there are any.
        """
        return (
            jnp.zeros((self.delay, agents, block.width)),
            jnp.zeros((self.history, agents, block.width)),
            jnp.zeros((), bool),
        )

    def apply(
        self,
        block: Block,
        reading: jax.Array,
        memory: Any,
        noise: jax.Array | float = 0.0,
        lost: jax.Array | bool = False,
    ) -> tuple[jax.Array, Any]:
        """Returns what comes out of a reading (A, W), and the next memory.

        An episode's first reading comes at once.

        `noise` (A, W) is standard normal, and `lost` (A, 1) says whose reading does not arrive.
        """
        underway, delivered, started = memory
        value = reading
        if self.noise:
            value = reading + self.noise * noise
        if self.clip is not None:
            value = jnp.clip(value, *self.clip)
        value = jnp.where(block.continuous > 0, self.scale * value, reading)
        line = jnp.concatenate([value[None], jnp.where(started, underway, value)])
        now = line[-1]
        if self.dropout:
            now = jnp.where(lost & started, delivered[0], now)
        delivered = jnp.concatenate([now[None], jnp.where(started, delivered, now)])
        delivered = delivered[: self.history]
        out = jnp.moveaxis(delivered, 0, 1).reshape(len(reading), -1)
        return out, (line[:-1], delivered, jnp.ones((), bool))
