"""Planners written by hand, one per task, over the same observations and actions that a policy has."""

from __future__ import annotations

from collections.abc import Callable

import jax

from mqe_jax.planners.bridge import plan_bridge
from mqe_jax.planners.door import plan_revolving_door
from mqe_jax.planners.football import plan_1vs1, plan_2vs2, plan_defender
from mqe_jax.planners.gate import plan_gate
from mqe_jax.planners.pushbox import plan_pushbox
from mqe_jax.planners.seesaw import plan_seesaw
from mqe_jax.planners.sheep import plan_sheep_easy, plan_sheep_hard
from mqe_jax.planners.tug import plan_tug
from mqe_jax.planners.wrestling import plan_wrestling

# Task id -> function from one world's observations (A, O) to its actions (A, action_size).
PLANNERS: dict[str, Callable[[jax.Array], jax.Array]] = {
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
