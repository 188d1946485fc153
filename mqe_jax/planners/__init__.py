"""Scripted policies, one per task, with the observations and actions of a learned policy."""

from __future__ import annotations

from collections.abc import Callable

import jax

from mqe_jax.envs.base import QuadrupedEnv
from mqe_jax.errors import InputError
from mqe_jax.planners.bridge import plan_bridge
from mqe_jax.planners.door import plan_revolving_door
from mqe_jax.planners.football import plan_1vs1, plan_2vs2, plan_defender
from mqe_jax.planners.gate import plan_gate
from mqe_jax.planners.pushbox import plan_pushbox
from mqe_jax.planners.seesaw import plan_seesaw
from mqe_jax.planners.sheep import plan_sheep_easy, plan_sheep_hard
from mqe_jax.planners.steering import Observation
from mqe_jax.planners.tug import plan_tug
from mqe_jax.planners.wrestling import plan_wrestling

# Task id -> function from one environment's observation blocks to its actions (A, 3) in the `command` mode.
PLANNERS: dict[str, Callable[[Observation], jax.Array]] = {
    "go1gate": plan_gate,
    "go1seesaw": plan_seesaw,
    "go1sheep-easy": plan_sheep_easy,
    "go1sheep-hard": plan_sheep_hard,
    "go1pushbox": plan_pushbox,
    "go1football-defender": plan_defender,
    "go1tug": plan_tug,
    "go1revolvingdoor": plan_revolving_door,
    "go1wrestling": plan_wrestling,
    "go1bridge": plan_bridge,
    "go1football-1vs1": plan_1vs1,
    "go1football-2vs2": plan_2vs2,
}


def scripted_policy(env: QuadrupedEnv) -> Callable[[jax.Array], jax.Array]:
    """Returns the scripted policy of a task, from one environment's observations (A, O) to its actions (A, 3).

    Raises:
        InputError: if the task has none.
    """
    if env.name not in PLANNERS:
        raise InputError(f"planner: {env.name} has no scripted policy; allowed for: {', '.join(PLANNERS)}")
    plan, layout = PLANNERS[env.name], env.observation_layout
    return lambda obs: plan(layout.split(obs))
