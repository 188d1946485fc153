"""Registry of tasks and their scripted policies; a new task is one line in `_SHIPPED`."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

import jax

from mqe_jax.envs.base import QuadrupedEnv
from mqe_jax.errors import InputError

Planner = Callable[[dict[str, jax.Array]], jax.Array]
"""Scripted policy: one team's observation blocks (A, width) by name -> actions (A, 3) in the `command` mode."""

# The task, as MODULE:CLASS of mqe_jax.envs, and its scripted policy, as MODULE:FUNCTION of mqe_jax.planners or none.
_SHIPPED: tuple[tuple[str, str | None], ...] = (
    ("plane:Go1Plane", None),
    ("gate:Go1Gate", "cooperative:plan_gate"),
    ("seesaw:Go1Seesaw", "cooperative:plan_seesaw"),
    ("sheep:Go1SheepEasy", "cooperative:plan_sheep_easy"),
    ("sheep:Go1SheepHard", "cooperative:plan_sheep_hard"),
    ("pushbox:Go1PushBox", "cooperative:plan_pushbox"),
    ("football_defender:Go1FootballDefender", "football:plan_defender"),
    ("tug:Go1Tug", "matches:plan_tug"),
    ("door:Go1RevolvingDoor", "matches:plan_revolving_door"),
    ("wrestling:Go1Wrestling", "matches:plan_wrestling"),
    ("bridge:Go1Bridge", "matches:plan_bridge"),
    ("football:Go1Football1vs1", "football:plan_match"),
    ("football:Go1Football2vs2", "football:plan_match"),
)

# Further scripted policies, such as opponents: id of the task, name, MODULE:FUNCTION of mqe_jax.planners.
_NAMED: list[tuple[str, str, str]] = []

# Alternative ids, from the released system.
ALIASES = {"go1bridgewrestling": "go1wrestling"}

TASKS: dict[str, type[QuadrupedEnv]] = {}
"""Task classes by id."""

PLANNERS: dict[str, Planner | str] = {}
"""Scripted policies by task id; shipped ones as MODULE:FUNCTION, since this package does not import `planners`."""


NAMED_PLANNERS: dict[str, dict[str, Planner | str]] = {}
"""Further scripted policies by task id and name (`--policy NAME`, `--opponent NAME`), as those of `PLANNERS`."""


def register_planner(task: str, name: str, planner: Planner | str) -> None:
    """Registers a further scripted policy of a task under a name.

    Raises:
        InputError: if the task is unknown, or another one has the name.
    """
    if task not in TASKS:
        raise InputError(f"planner {name!r}: unknown task {task!r}; allowed: {', '.join(TASKS)}")
    if NAMED_PLANNERS.setdefault(task, {}).setdefault(name, planner) is not planner:
        raise InputError(f"planner: the name {name!r} is already registered for {task}")


def register_task(task: type[QuadrupedEnv], planner: Planner | str | None = None) -> type[QuadrupedEnv]:
    """Registers a task class under its `name` for `make` and the command line, with its scripted policy if it has one.

    Usable as a class decorator for a task without a scripted policy. InputError if the class has no name, or another
    class is registered under it.
    """
    if not task.name:
        raise InputError(f"task {task.__name__}: its `name` is empty; give it an id such as 'go1catch'")
    known = TASKS.get(task.name)
    if known is not None and (known.__module__, known.__qualname__) != (task.__module__, task.__qualname__):
        raise InputError(f"task {task.__name__}: the id {task.name!r} is already registered by {known.__name__}")
    TASKS[task.name] = task
    if planner is not None:
        PLANNERS[task.name] = planner
    return task


def load(package: str, path: str) -> Any:
    """Imports and returns the object MODULE:NAME of a package."""
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(f"{package}.{module}"), name)


for _task, _planner in _SHIPPED:
    register_task(load("mqe_jax.envs", _task), _planner)
for _id, _name, _path in _NAMED:
    register_planner(_id, _name, _path)
