"""Adapters to the interfaces of other libraries: Gymnasium, PettingZoo, Brax, JaxMARL.

Each module needs the library of the same name; without that library, importing it raises an
InputError that names the extra to install. `python -m mqe_jax.adapters SCRIPT` runs a script of
such a library, which knows the tasks by name.
"""

import dataclasses
import functools
import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.spaces import Box

from mqe_jax import envs, names
from mqe_jax.acting.seats import Policy
from mqe_jax.adapters.opponent import TaskEnv, TeamEnv
from mqe_jax.core.errors import InputError, nearest
from mqe_jax.core.limits import PositiveInt
from mqe_jax.core.precision import single
from mqe_jax.core.settings import checked
from mqe_jax.core.types import Level, RandomKey
from mqe_jax.envs import QuadrupedEnv, State
from mqe_jax.envs.observation import box
from mqe_jax.envs.registry import task_id
from mqe_jax.envs.state import with_final
from mqe_jax.sensors.suite import ONBOARD


def missing(library: str, error: ImportError) -> InputError:
    """Returns the error for an adapter whose library cannot be imported."""
    hint = f"pip install 'mqe-jax[{library}]'"
    return InputError(f"mqe_jax.adapters.{library}: needs the package {library} ({error}); {hint}")


@functools.cache
def _first_process() -> int:
    """Returns the process that first made an environment; a fork of it has no threads of JAX."""
    return os.getpid()


@checked
def task_env(
    task: str | QuadrupedEnv,
    *,
    opponent: str | Path | Policy | None = None,
    max_steps: PositiveInt | None = None,
    limit: str = "max_steps",
    **overrides: Any,
) -> Any:
    """Returns the environment of a task, or with an opponent the `TeamEnv` of a match.

    Args:
        task: id, or an environment.
        opponent: policy of team 1, or what `mqe_jax.load_policy` accepts. The task of an id gets
            its skill and command ranges.
        max_steps: time limit in environment steps, in place of the task's.
        limit: name of `max_steps` in errors.
        overrides: arguments of `make`, for an id only.

    Raises:
        InputError: for an argument that is not allowed.
    """
    if _first_process() != os.getpid():
        raise InputError(
            "environment: JAX would hang in a forked process; start it by spawn, in Gymnasium "
            "vector_kwargs={'context': 'spawn'}"
        )
    name = task.name if isinstance(task, QuadrupedEnv) else task_id(task)
    rival = None if opponent is None else names.find(opponent, name, field="opponent")
    if isinstance(task, QuadrupedEnv):
        passed = [*overrides]
        if max_steps is not None:
            passed.append(limit)
        if passed:
            given = ", ".join(passed)
            raise InputError(f"task: overrides ({given}) need the id of a task, not an environment")
        env = task
    else:
        if max_steps is not None and "episode_length" in overrides:
            raise InputError(f"episode_length: give either this or {limit}, not both")
        for other in overrides:
            if hint := nearest(other, ("opponent", limit), 0.8):
                raise InputError(f"{other}: unknown argument{hint}")
        env = envs.make(name, **names.parameters_of(name, [rival]) | overrides)
        if max_steps is not None:
            env = env.changed({"episode_length": max_steps * env.dt})
    if opponent is None:
        return env
    return TeamEnv(env, names.fit(rival, env, field="opponent", name=str(opponent)))


def agent_names(env: TaskEnv) -> list[str]:
    """Returns `robot_0`, `robot_1`, ..."""
    return [f"robot_{i}" for i in range(env.num_agents)]


def team_reward(env: TaskEnv, reward: Any, active: Any) -> Any:
    """Returns the mean reward (...) of team 0, all agents in cooperative tasks, from (..., A).

    Only agents that are `active` (..., A) count.
    """
    team = np.array(env.teams[0])
    return reward[..., team].mean(-1, where=active[..., team])


def used_entries(env: TaskEnv) -> np.ndarray:
    """Returns which entries of each agent's action count (A, action_size) bool."""
    used = env.used
    return np.ones(env.action_space.shape, bool) if used is None else used[: env.num_agents]


def seen_group(env: TaskEnv) -> str:
    """Returns the group of observations that agents see: `onboard` with sensors, else `policy`."""
    return ONBOARD if env.params.senses else "policy"


def seen_space(env: TaskEnv) -> Box:
    """Returns the space of what all agents see (A, O)."""
    return box(np.inf, (env.num_agents, env.group_sizes[seen_group(env)]))


@single
@checked
def begin(env: Any, key: RandomKey, assistance: Level = 0.0) -> Any:
    """Returns an initial state with what agents see; see `QuadrupedEnv.reset`."""
    return with_final(env.with_observations(env.begin(key, assistance), [seen_group(env)]))


@single
def advance(env: Any, state: Any, action: jax.Array) -> Any:
    """Returns the state after an environment step with what agents see; see `QuadrupedEnv.step`."""
    return with_final(env.with_observations(env.advance(state, action), [seen_group(env)]))


def select(
    env: TaskEnv, choose: jax.Array, first: State, second: State, kept: tuple[str, ...] = ()
) -> State:
    """Returns `first` where `choose` () is true, else `second`.

    The fields `kept` and shared buffers are those of `second`.
    """
    names = {field.name for field in dataclasses.fields(second)}.difference(kept, ("data",))
    merged: dict[str, Any] = {"data": env.physics.merge(choose, first.data, second.data)}
    for name in names:
        pair = (getattr(first, name), getattr(second, name))
        merged[name] = jax.tree.map(lambda a, b: jnp.where(choose, a, b), *pair)
    return dataclasses.replace(second, **merged)
