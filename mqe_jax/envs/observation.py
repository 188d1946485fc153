"""Observation layouts: the order and width of an observation's blocks, defined once per task."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core.blocks import Block as Block
from mqe_jax.core.blocks import by_entity as by_entity
from mqe_jax.core.blocks import entities as entities
from mqe_jax.core.blocks import image as image
from mqe_jax.core.returned import check_names, check_shape
from mqe_jax.core.settings import fail
from mqe_jax.physics.robots.fleet import Fleet

if TYPE_CHECKING:
    from gymnasium.spaces import Box


@dataclasses.dataclass(frozen=True)
class ObservationLayout:
    """Ordered blocks of an observation vector.

    Example:
        ```python
        env = mqe_jax.make("go1gate")
        parts = env.observation_layout.split(jax.numpy.zeros((2, env.observation_size)))
        print(parts["teammate"].shape)  # (2, 6)
        ```
    """

    blocks: tuple[Block, ...]
    """Blocks in the order in which they are packed."""

    @property
    def size(self) -> int:
        """Length of the vector."""
        return sum(block.width for block in self.blocks)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the blocks in order."""
        return tuple(block.name for block in self.blocks)

    @functools.cached_property
    def continuous(self) -> np.ndarray:
        """1 where an entry is a continuous quantity, 0 where it is categorical (size,)."""
        return np.concatenate([block.continuous for block in self.blocks])

    def slice(self, name: str) -> slice:
        """Returns the position of a block in the vector; KeyError if there is no such block."""
        start = 0
        for block in self.blocks:
            if block.name == name:
                return slice(start, start + block.width)
            start += block.width
        raise KeyError(
            f"observation block: unknown name {name!r}; allowed: {', '.join(self.names)}"
        )

    def pack(self, values: Mapping[str, jax.Array], agents: int | None = None) -> jax.Array:
        """Concatenates named blocks (A, width) into observations (A, size).

        ValueError for other names or widths.
        """
        check_names("observe", values, self.names)
        if agents is None:
            agents = len(values[self.names[0]])
        parts = []
        for block in self.blocks:
            shape = (agents, block.width)
            parts.append(check_shape(f"observe: {block.name}", values[block.name], shape))
        return jnp.concatenate(parts, axis=-1).astype(jnp.float32)

    def entities(self, observation: jax.Array, name: str) -> tuple[jax.Array, jax.Array]:
        """Returns a block of observations by entity (..., count, width), and which are there.

        The second result is (..., count) bool.
        """
        found = next((block.entities for block in self.blocks if block.name == name), None)
        if found is None:
            raise KeyError(f"observation block: {name!r} has no entities")
        rows = observation[..., self.slice(name)].reshape(*observation.shape[:-1], found.count, -1)
        there = jnp.ones(rows.shape[:-1], bool)
        if found.masked:
            there = rows[..., -1] > 0.5
        return rows[..., : found.width], there

    def image(self, observation: jax.Array, name: str) -> jax.Array:
        """Returns an image block of observations (..., channels, height, width).

        KeyError for a block that is no image.
        """
        found = next((block.image for block in self.blocks if block.name == name), None)
        if found is None:
            raise KeyError(f"observation block: {name!r} is no image")
        return observation[..., self.slice(name)].reshape(*observation.shape[:-1], *found)

    def split(self, observation: jax.Array) -> dict[str, jax.Array]:
        """Returns the blocks (..., width) of observations (..., size) by name.

        InputError for another size.
        """
        shape = jnp.shape(observation)
        if shape[-1:] != (self.size,):
            fail("obs", f"of shape {shape}", f"of {self.size} numbers for each agent")
        return {name: observation[..., self.slice(name)] for name in self.names}

    def __str__(self) -> str:
        blocks = " | ".join(f"{block.name} {block.width}" for block in self.blocks)
        return f"{blocks} = {self.size}"


BASE_INFO = "position, m, and roll, pitch, yaw, rad; environment frame"
_POSE = ("height", "tilt", "tilt", "heading")
OWN_POSE = ("position", "position", *_POSE)
"""Quantities of `BASE_INFO` of the robot itself."""
POSE = ("robots", "robots", *_POSE)
"""Quantities of `BASE_INFO` of another robot."""
BASE = Block("base", 6, BASE_INFO, quantities=OWN_POSE)


def one_hot(agents: int, meaning: str = "agent's id") -> Block:
    """Returns the block of a one-hot encoding of `agents` agents."""
    return Block("one_hot", agents, meaning, categorical=True)


GATE = Block("gate", 2, "centre of the gap, m", quantities=("objects",))


def proprioception_layout(joints: int) -> ObservationLayout:
    """Returns the layout of what the sensors of a robot with a number of joints measure."""
    return ObservationLayout(
        (
            Block("gravity", 3, "unit vector in the trunk's frame"),
            Block("joint_position", joints, "rad, minus the stance"),
            Block("joint_velocity", joints, "rad/s"),
        )
    )


def bodies_block(robots: Fleet) -> Block:
    """Returns the block `bodies` of unlike robots; `observe_bodies` fills it."""
    names = ", ".join(kind.name for kind in robots.kinds)
    meaning = f"kind of the robot itself, its teammates, and the others: one-hot of {names}"
    return Block("bodies", len(robots) * len(robots.kinds), meaning, categorical=True)


def observe_bodies(robots: Fleet, teams: Sequence[Sequence[int]]) -> np.ndarray:
    """Returns the block `bodies` of each agent (A, R K), of R robots of K kinds."""
    kinds = np.eye(len(robots.kinds), dtype=np.float32)[robots.kind_of]
    rows = []
    for team in teams:
        others = np.setdiff1d(np.arange(len(robots)), team)
        for agent in team:
            mates = [other for other in team if other != agent]
            rows.append(kinds[[agent, *mates, *others]].ravel())
    return np.stack(rows)


def team_blocks(agents: int) -> tuple[Block, ...]:
    """Returns the first blocks of cooperating robots; `observe_team` fills them."""
    blocks = [one_hot(agents), BASE]
    if agents > 1:
        meaning = f"of each, {BASE_INFO}"
        blocks.append(entities("teammate", "robot", agents - 1, 6, meaning, quantities=POSE))
    return tuple(blocks)


def observe_team(info: jax.Array) -> dict[str, jax.Array]:
    """Returns the blocks of `team_blocks` from the base information (A, 6) of its robots."""
    blocks = {"one_hot": jnp.eye(len(info)), "base": info}
    if len(info) > 1:
        blocks["teammate"] = others(info)
    return blocks


def others(values: jax.Array) -> jax.Array:
    """Returns, for every agent, the other agents' rows in order: (A, D) -> (A, (A - 1) D)."""
    rows = []
    for agent in range(len(values)):
        row = jnp.delete(values, agent, axis=0, assume_unique_indices=True)
        rows.append(row.reshape(-1))
    return jnp.stack(rows)


def for_all(value: jax.Array, agents: int) -> jax.Array:
    """Repeats a vector for every agent: (D,) -> (A, D)."""
    return jnp.broadcast_to(value.reshape(-1), (agents, value.size))


def finite(x: jax.Array) -> jax.Array:
    """Returns observations clipped to +-1e4, with 0 in place of NaN."""
    return jnp.clip(jnp.nan_to_num(x), -1e4, 1e4)


def box(bound: float, shape: tuple[int, ...]) -> "Box":
    """Returns the space of arrays of a shape with numbers from -bound to bound."""
    from gymnasium.spaces import Box  # on demand: importing Gymnasium takes 0.1 s

    return Box(-bound, bound, shape, np.float32)
