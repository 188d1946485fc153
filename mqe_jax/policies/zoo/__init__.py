"""Shipped policies: one file per task, with a card of how it was trained and what it does."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from mqe_jax.acting.results import Rate
from mqe_jax.core.errors import InputError
from mqe_jax.core.limits import Episodes, Fraction, NonNegative
from mqe_jax.core.settings import build, settings_class
from mqe_jax.train.policy import TrainedPolicy, read_policy

FOLDER = Path(__file__).parent


@settings_class
class Measured:
    """A rate in fresh episodes."""

    value: Fraction
    """Mean over the episodes."""
    episodes: Episodes
    """Number of episodes."""
    sides: Literal["both", "first"] | None = None
    """Of a match, the sides that the policy played on, as in `mqe_jax.evaluate`."""

    @property
    def rate(self) -> Rate:
        """The rate with its 95% interval."""
        return Rate.of(self.value, self.episodes)


@settings_class
class Card:
    """How a shipped policy was trained, and its results."""

    mode: Literal["deterministic", "sampled"]
    """Whether it acts by mean or sampled actions."""
    command: str
    """Command that trained it."""
    date: str
    """Date of the training, year-month-day."""
    note: str
    """Sentences: which of how many seeds, steps, hardware, how many trainings shared it."""
    gpu_minutes: NonNegative | None
    """Wall time on one GPU divided by the number of trainings that shared it, min; None if
    unknown."""
    results: Mapping[str, Measured]
    """Rates by name, such as success, or win/scripted and loss/scripted."""
    endings: Mapping[str, float]
    """Shares of these episodes by how they end (`mqe_jax.envs.state.ENDINGS`); in a match against
    the scripted team."""


def names() -> list[str]:
    """Returns the tasks that have a shipped policy."""
    return sorted(file.stem for file in FOLDER.glob("*.safetensors"))


def file_of(task: str) -> Path:
    """Returns the file of a task's shipped policy, whether or not there is one."""
    return FOLDER / f"{task}.safetensors"


def load(task: str) -> TrainedPolicy:
    """Returns a task's shipped policy.

    Raises:
        InputError: if the task has none.
    """
    if task not in names():
        raise InputError(f"policy: none is shipped for {task!r}; shipped: {', '.join(names())}")
    return read_policy(file_of(task))


def card(task: str) -> Card:
    """Returns the card of a task's shipped policy; errors as `load`."""
    return build(Card, load(task).metadata["card"])
