"""The numbers on which trained policies depend: defaults of tasks, robots, tracks, objects, skills and training."""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pytest

from mqe_jax import objects, robots, terrain, walk_policy
from mqe_jax.envs import TASKS
from mqe_jax.scene import Scene
from mqe_jax.settings import to_mapping
from mqe_jax.terrain import Track
from mqe_jax.train.actor_critic import ActorCritic
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.mat import Mat


def leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yields the numbers and texts of nested values by name, but those that are 0, empty or none."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from leaves(inner, f"{name}.{key}")
    elif isinstance(value, list | tuple):
        for number, inner in enumerate(value):
            yield from leaves(inner, f"{name}.{number}")
    elif value and isinstance(value, int | float | str):
        yield name, value


def checksum(value: Any) -> int:
    return zlib.crc32(repr(sorted(leaves(value))).encode())


def records() -> dict[str, Any]:
    kinds = [kind for kind in vars(objects).values() if isinstance(kind, type) and issubclass(kind, objects.Object)]
    blocks = [
        kind for kind in vars(terrain).values() if isinstance(kind, type) and issubclass(kind, terrain.TerrainBlock)
    ]
    track = {name: value for name, value in vars(Track()).items() if name != "ground"}
    return {
        **{f"{name} {task.version}": to_mapping(task.Params()) for name, task in TASKS.items()},
        **{name: {**vars(robot), "visuals": ()} for name, robot in robots.ROBOTS.items()},
        "objects": {kind.__name__: to_mapping(kind()) for kind in kinds if kind is not objects.Object},
        "blocks": {kind.__name__: kind() for kind in blocks},
        "track": {**track, "rough": terrain.RoughGround()},
        "scene": {**vars(Scene(Track())), "track": None, "robot": None},
        "walk": [walk_policy.GAITS, walk_policy.COMMANDS],
        "training": to_mapping(TrainConfig()),
        "networks": [to_mapping(ActorCritic()), to_mapping(Mat())],
    }


NUMBERS = {
    "go1plane 1": 2777321295,
    "go1gate 1": 1727732643,
    "go1seesaw 1": 3512310358,
    "go1sheep-easy 1": 1920671178,
    "go1sheep-hard 1": 3856444500,
    "go1pushbox 1": 3456449228,
    "go1football-defender 1": 2228765943,
    "go1tug 1": 501820924,
    "go1revolvingdoor 1": 3507092455,
    "go1wrestling 1": 2326325556,
    "go1bridge 1": 1868114521,
    "go1football-1vs1 1": 3056885633,
    "go1football-2vs2 1": 756440200,
    "go1": 3027970520,
    "go2": 1630101314,
    "objects": 2526402293,
    "blocks": 2552834715,
    "track": 1591844974,
    "scene": 3353441315,
    "walk": 3563011591,
    "training": 2331836378,
    "networks": 18740031,
}
"""Checksums; a task's is that of a version."""


@pytest.mark.parametrize("name", NUMBERS)
def test_numbers_change_on_purpose_alone(name: str) -> None:
    """Whoever changes one of a task raises its version, retrains its policy and changes name and checksum here.

    New fields that are 0 or none by default change nothing.
    """
    of_all = records()
    assert name in of_all, f"{name!r} is missing; allowed: {', '.join(of_all)}"
    found = checksum(of_all[name])
    assert NUMBERS[name] == found, f"{name!r}: {found}; its numbers are others than before"
