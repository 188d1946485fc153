"""The tasks by id."""

from __future__ import annotations

from typing import Any

from mqe_jax.envs.autoreset import VectorEnv
from mqe_jax.envs.base import QuadrupedEnv, State
from mqe_jax.envs.bridge import Go1Bridge
from mqe_jax.envs.door import Go1RevolvingDoor
from mqe_jax.envs.football import Go1Football1vs1, Go1Football2vs2
from mqe_jax.envs.football_defender import Go1FootballDefender
from mqe_jax.envs.gate import Go1Gate
from mqe_jax.envs.params import TaskParams
from mqe_jax.envs.plane import Go1Plane
from mqe_jax.envs.pushbox import Go1PushBox
from mqe_jax.envs.randomization import Randomization
from mqe_jax.envs.seesaw import Go1Seesaw
from mqe_jax.envs.sheep import Go1SheepEasy, Go1SheepHard
from mqe_jax.envs.tug import Go1Tug
from mqe_jax.envs.wrestling import Go1Wrestling
from mqe_jax.errors import InputError, nearest
from mqe_jax.settings import override

TASKS: dict[str, type[QuadrupedEnv]] = {
    task.name: task
    for task in (
        Go1Plane,
        Go1Gate,
        Go1Seesaw,
        Go1SheepEasy,
        Go1SheepHard,
        Go1PushBox,
        Go1FootballDefender,
        Go1Tug,
        Go1RevolvingDoor,
        Go1Wrestling,
        Go1Bridge,
        Go1Football1vs1,
        Go1Football2vs2,
    )
}

# Alternative ids, from the released system.
ALIASES = {"go1bridgewrestling": "go1wrestling"}


def register_task(task: type[QuadrupedEnv]) -> type[QuadrupedEnv]:
    """Registers a task class under its `name` for `make` and the command line; use as a decorator.

    Raises:
        InputError: if the class has no name, or another class is registered under it.
    """
    if not task.name:
        raise InputError(f"task {task.__name__}: its `name` is empty; give it an id such as 'go1catch'")
    known = TASKS.get(task.name)
    if known is not None and (known.__module__, known.__qualname__) != (task.__module__, task.__qualname__):
        raise InputError(f"task {task.__name__}: the id {task.name!r} is taken by {known.__name__}")
    TASKS[task.name] = task
    return task


def tasks() -> tuple[str, ...]:
    """Returns the ids of all registered tasks."""
    return tuple(TASKS)


def make(
    task: str, *, impl: str = "auto", control: str = "command", num_envs: int = 4096, **overrides: Any
) -> QuadrupedEnv:
    """Creates the environment of a task.

    Args:
        task: id, such as 'go1gate'.
        impl: physics engine: 'auto', 'jax', 'warp' or 'c'.
        control: action mode: 'command', 'position' or 'torque'.
        num_envs: maximum batch size; sizes Warp's contact buffer.
        overrides: task parameters by name; nested ones as mappings or, from a dict, by dotted names:
            `make("go1gate", robot="go2", gate_width=0.8, rewards={"collision": -5.0})`.

    Raises:
        InputError: for an unknown task, engine, mode or parameter, naming the nearest match, or a bad value.
    """
    task = ALIASES.get(task, task)
    if task not in TASKS:
        raise InputError(f"task: unknown id {task!r}{nearest(task, TASKS)}; allowed: {', '.join(TASKS)}")
    cls = TASKS[task]
    return cls(override(cls.Params(), overrides), impl=impl, control=control, num_envs=num_envs)


__all__ = [
    "TASKS",
    "QuadrupedEnv",
    "Randomization",
    "State",
    "TaskParams",
    "VectorEnv",
    "make",
    "override",
    "register_task",
    "tasks",
]
