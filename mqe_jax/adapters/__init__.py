"""Adapters to the interfaces of other libraries: Gymnasium, PettingZoo, Brax, JaxMARL.

Each module needs the library of the same name; without that library, importing it raises an InputError that names the
extra to install.
"""

from __future__ import annotations

from typing import Any

from mqe_jax import envs
from mqe_jax.envs import QuadrupedEnv
from mqe_jax.errors import InputError


def missing(library: str, error: ImportError) -> InputError:
    """Returns the error for an adapter whose library cannot be imported."""
    return InputError(
        f"mqe_jax.adapters.{library}: needs the package {library} ({error}); pip install 'mqe-jax[{library}]'"
    )


def task_env(
    task: str | QuadrupedEnv, *, max_steps: int | None = None, limit: str = "max_steps", **overrides: Any
) -> QuadrupedEnv:
    """Returns the environment of a task; a given environment is returned unchanged and accepts no overrides.

    Args:
        task: id, or an environment.
        max_steps: time limit in environment steps, instead of the task's.
        limit: name of the adapter's argument for `max_steps`, for errors.
        overrides: arguments of `mqe_jax.make`.

    Raises:
        InputError: from `mqe_jax.make`; for overrides of a given environment; for a time limit below one step.
    """
    if isinstance(task, QuadrupedEnv):
        if overrides or max_steps is not None:
            names = ", ".join([*overrides, *([limit] if max_steps is not None else [])])
            raise InputError(f"task: overrides ({names}) need the id of a task, not an environment")
        return task
    if max_steps is None:
        return envs.make(task, **overrides)
    if max_steps < 1:
        raise InputError(f"{limit}: {max_steps} must be at least 1")
    if "episode_length" in overrides:
        raise InputError(f"episode_length: give either this or {limit}, not both")
    dt = envs.make(task, **overrides).dt
    return envs.make(task, **overrides, episode_length=max_steps * dt)
