"""Blocks of an observation: what its entries are; it imports no JAX before it is needed."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import jax


@dataclasses.dataclass(frozen=True)
class Entities:
    """What a block holds of each of several entities of one kind, such as the teammates."""

    kind: str
    """Kind, such as robot or sheep; networks may share parameters between blocks of one kind."""
    count: int
    """Number of entities, at most."""
    width: int
    """Number of entries of each, without its mask."""
    masked: bool = False
    """Whether each has a last entry, 1 if it is there; all entries of a missing one are 0."""


@dataclasses.dataclass(frozen=True)
class Block:
    """One block of an observation."""

    name: str
    """Name, unique in the layout."""
    width: int
    """Number of entries."""
    meaning: str = ""
    """Meaning, with unit and frame."""
    categorical: bool = False
    """Whether the entries encode a category, such as a one-hot, and get no observation noise."""
    entities: Entities | None = None
    """What the entries are, one entity after the other; None unless they are of several ones."""
    image: tuple[int, int, int] | None = None
    """Channels, height and width of an image: channel after channel, each row by row."""
    quantities: tuple[str, ...] = ()
    """What its entries measure, or those of each entity, by the names of
    `mqe_jax.envs.readings.Readings`; one for each, or a pattern that repeats."""

    @property
    def continuous(self) -> np.ndarray:
        """1 for a continuous quantity, 0 for a categorical entry or a mask (width,)."""
        row = np.full(self.width, not self.categorical, np.float32)
        if self.entities is not None and self.entities.masked:
            row.reshape(self.entities.count, -1)[:, -1] = 0.0
        return row


def entities(
    name: str,
    kind: str,
    count: int,
    width: int,
    meaning: str = "",
    *,
    masked: bool = False,
    quantities: tuple[str, ...] = (),
) -> Block:
    """Returns the block of several entities of a kind; `by_entity` fills a masked one."""
    if masked:
        meaning += "; then 1, or all 0 if there is none"
    several = Entities(kind, count, width, masked)
    width = count * (width + masked)
    return Block(name, width, meaning, entities=several, quantities=quantities)


def image(name: str, height: int, width: int, meaning: str = "") -> Block:
    """Returns the block of an image of one channel, whose entries are in [0, 1]."""
    return Block(name, height * width, meaning, image=(1, height, width))


def by_entity(values: jax.Array, there: jax.Array) -> jax.Array:
    """Returns a masked block (A, count (width + 1)) from entries (A, count, width).

    `there` (A, count) says which entities are there.
    """
    import jax.numpy as jnp

    mask = there[..., None]
    rows = jnp.concatenate([jnp.where(mask, values, 0.0), mask.astype(values.dtype)], axis=-1)
    return rows.reshape(len(rows), -1)
