"""Observation layouts: the order and width of an observation's blocks, written once per task."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp


@dataclasses.dataclass(frozen=True)
class Block:
    """One block of an observation: its name, width and meaning (with unit and frame)."""

    name: str
    width: int
    meaning: str = ""


@dataclasses.dataclass(frozen=True)
class ObservationLayout:
    """Ordered blocks of an observation vector.

    Attributes:
        blocks: in the order in which they are packed.
    """

    blocks: tuple[Block, ...]

    @property
    def size(self) -> int:
        """Length of the vector."""
        return sum(block.width for block in self.blocks)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the blocks in order."""
        return tuple(block.name for block in self.blocks)

    def slice(self, name: str) -> slice:
        """Returns where a block lies in the vector."""
        start = 0
        for block in self.blocks:
            if block.name == name:
                return slice(start, start + block.width)
            start += block.width
        raise ValueError(f"observation block: unknown name {name!r}; allowed: {', '.join(self.names)}")

    def pack(self, values: Mapping[str, jax.Array]) -> jax.Array:
        """Concatenates named blocks (A, width) into observations (A, size), checking names and widths."""
        if set(values) != set(self.names):
            raise ValueError(f"observation: blocks {sorted(values)} do not match the layout {sorted(self.names)}")
        parts = []
        for block in self.blocks:
            part = values[block.name]
            if part.shape[-1] != block.width:
                raise ValueError(
                    f"observation block {block.name}: width {part.shape[-1]}; the layout has {block.width}"
                )
            parts.append(part)
        return jnp.concatenate(parts, axis=-1).astype(jnp.float32)

    def __str__(self) -> str:
        return " | ".join(f"{block.name} {block.width}" for block in self.blocks) + f" = {self.size}"


ONE_HOT = "agent's id"
BASE_INFO = "position, m, and roll, pitch, yaw, rad; environment frame"
# The first blocks of two robots that work together; `pair` fills them.
PAIR = (Block("one_hot", 2, ONE_HOT), Block("base", 6, BASE_INFO), Block("mate", 6, BASE_INFO))
GATE = Block("gate", 2, "centre of the gap, m")


def pair(info: jax.Array) -> dict[str, jax.Array]:
    """Returns the blocks of `PAIR` from the base information (2, 6) of both robots."""
    return {"one_hot": jnp.eye(2), "base": info, "mate": others(info)}


def others(values: jax.Array) -> jax.Array:
    """Gives every agent the other agents' rows, in order: (A, D) -> (A, (A - 1) D)."""
    count = values.shape[0]
    rows = [jnp.delete(values, agent, axis=0, assume_unique_indices=True).reshape(-1) for agent in range(count)]
    return jnp.stack(rows)


def for_all(value: jax.Array, agents: int) -> jax.Array:
    """Gives every agent the same vector: (D,) -> (A, D)."""
    return jnp.broadcast_to(value.reshape(-1), (agents, value.size))
