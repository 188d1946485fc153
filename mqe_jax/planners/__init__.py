"""Scripted policies (`--policy scripted`), one per task, with the observations and actions of a learned policy."""

from __future__ import annotations

from collections.abc import Callable

import jax

from mqe_jax.envs.base import QuadrupedEnv
from mqe_jax.envs.registry import NAMED_PLANNERS, PLANNERS, Planner, load
from mqe_jax.errors import InputError


def planner_of(task: str, name: str = "scripted") -> Planner:
    """Returns a task's scripted policy: one team's observation blocks (A, width) by name -> its actions (A, 3).

    Raises:
        InputError: if the task has none of this name.
    """
    planner = PLANNERS.get(task) if name == "scripted" else NAMED_PLANNERS.get(task, {}).get(name)
    if planner is None:
        raise InputError(f"policy: {task} has no {name} policy; allowed for: {', '.join(PLANNERS)}")
    return load("mqe_jax.planners", planner) if isinstance(planner, str) else planner


def scripted_policy(env: QuadrupedEnv, name: str = "scripted") -> Callable[[jax.Array], jax.Array]:
    """Returns the scripted policy of a task, from the observations (A, O) of one team to its actions (A, 3).

    Raises:
        InputError: if the task has none of this name.
    """
    plan, layout = planner_of(env.name, name), env.observation_layout
    return lambda obs: plan(layout.split(obs))
