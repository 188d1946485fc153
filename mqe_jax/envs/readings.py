"""Errors of what policies read of the world: of motion capture, or of a robot's own odometry."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core.blocks import Block, Entities
from mqe_jax.core.errors import InputError
from mqe_jax.core.limits import Deviation, Fraction, Lag
from mqe_jax.core.settings import settings_class
from mqe_jax.envs.observation import ObservationLayout
from mqe_jax.sensors.pipeline import Pipeline


@settings_class
class Reading:
    """Errors of one quantity, in its unit; both are standard deviations of normal numbers."""

    noise: Deviation = 0.0
    """Standard deviation of an error that is drawn in each step."""
    bias: Deviation = 0.0
    """Standard deviation of an error that is drawn for an episode."""


@settings_class
class Readings:
    """Errors of the groups `policy` and `entities` of observations, by what is read.

    Each agent has errors of its own. An entry's quantity is that of its block
    (`Block.quantities`).

    Example:
        ```python
        errors = {"position": {"noise": 0.01, "bias": 0.03}, "delay": 1}
        env = mqe_jax.make("go1gate", randomization={"readings": errors})
        ```
    """

    position: Reading = Reading()
    """The robot's own x and y, m."""
    robots: Reading = Reading()
    """x and y of other robots, m."""
    height: Reading = Reading()
    """z of all robots, m."""
    tilt: Reading = Reading()
    """Roll and pitch of all robots, rad."""
    heading: Reading = Reading()
    """Yaw of all robots, rad."""
    objects: Reading = Reading()
    """Positions of gates, sheep and objects, m."""
    velocity: Reading = Reading()
    """Velocities of objects, m/s."""
    rotation: Reading = Reading()
    """Entries of objects' quaternions, each half an angle, rad."""
    delay: Lag = 0
    """Delay of all of them, environment steps."""
    dropout: Fraction = 0.0
    """Share of an agent's observations that are lost: the last one takes their place."""


QUANTITIES = tuple(name for name, value in vars(Readings()).items() if isinstance(value, Reading))
"""What a block's entries may measure."""


class ReadingErrors:
    """Applies `Readings` to the observations of a group."""

    def __init__(self, readings: Readings, layout: ObservationLayout, agents: int) -> None:
        self.agents = agents
        self.noise = _deviations(layout, readings, "noise")
        self.bias = _deviations(layout, readings, "bias")
        self._all = Block("", layout.size)
        self._pipeline = Pipeline(delay=readings.delay, dropout=readings.dropout)

    def reset(self, key: jax.Array) -> Any:
        """Returns the memory at the start of an episode."""
        bias = self.bias * jax.random.normal(key, (self.agents, len(self.bias)))
        return bias, self._pipeline.init_memory(self._all, self.agents)

    def apply(
        self, obs: jax.Array, memory: Any, key: jax.Array, level: jax.Array | float = 1.0
    ) -> tuple[jax.Array, Any]:
        """Returns observations (A, O) with errors, and the next memory.

        The level () is a factor on them; at 0 the observations are exact and at once.
        """
        bias, queue = memory
        noise_key, loss_key = jax.random.split(key)
        error = bias + self.noise * jax.random.normal(noise_key, obs.shape)
        lost = jax.random.uniform(loss_key, (self.agents, 1)) < level * self._pipeline.dropout
        late, queue = self._pipeline.apply(self._all, obs + level * error, queue, lost=lost)
        return jnp.where(level > 0, late, obs), (bias, queue)


def _deviations(layout: ObservationLayout, readings: Readings, kind: str) -> np.ndarray:
    """Returns standard deviations by entry (O,); InputError for a block without quantities."""
    return np.concatenate([_of_block(block, readings, kind) for block in layout.blocks])


def _of_block(block: Block, readings: Readings, kind: str) -> np.ndarray:
    if block.categorical:
        return np.zeros(block.width)
    each = Entities("", 1, block.width) if block.entities is None else block.entities
    names = block.quantities
    if not names or each.width % len(names) or not {*names} <= {*QUANTITIES}:
        raise InputError(
            f"randomization.readings: the quantities of the observation's block {block.name!r} "
            f"are {names}; they must be names for its {each.width} entries: {', '.join(QUANTITIES)}"
        )
    row = [getattr(getattr(readings, name), kind) for name in names] * (each.width // len(names))
    return np.tile(row + [0.0] * each.masked, each.count)
