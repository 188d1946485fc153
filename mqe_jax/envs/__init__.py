"""The environments: `make` creates one from a task id."""

from __future__ import annotations

from typing import Any

from mqe_jax.envs.autoreset import VectorEnv
from mqe_jax.envs.base import QuadrupedEnv
from mqe_jax.envs.params import TaskParams
from mqe_jax.envs.randomization import Randomization
from mqe_jax.envs.registry import ALIASES, PLANNERS, TASKS, register_task
from mqe_jax.envs.state import EnvironmentState, Moment, State
from mqe_jax.errors import InputError, nearest
from mqe_jax.limits import Environments
from mqe_jax.settings import checked, override


def tasks() -> tuple[str, ...]:
    """Returns the ids of all registered tasks."""
    return tuple(TASKS)


@checked(task=str, impl=str, control=str, num_envs=Environments)
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
    "ALIASES",
    "PLANNERS",
    "TASKS",
    "EnvironmentState",
    "Moment",
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
