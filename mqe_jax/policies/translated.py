"""Trained policies in tasks whose actions choose between skills: each acts with its own skill and command ranges."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax

from mqe_jax.core.errors import InputError
from mqe_jax.core.types import Memory
from mqe_jax.envs import QuadrupedEnv, TaskParams
from mqe_jax.skills import SKILLS
from mqe_jax.skills.control import Commander
from mqe_jax.train.policy import Policy, TrainedPolicy


@dataclasses.dataclass(frozen=True)
class Translated:
    """A trained policy whose actions mean `own`, as a policy of a task whose actions mean `here`."""

    policy: TrainedPolicy
    own: Commander = dataclasses.field(repr=False)
    here: Commander = dataclasses.field(repr=False)

    @property
    def task(self) -> str:
        """Id of the task."""
        return self.policy.task

    @property
    def agents(self) -> int:
        """Number of agents of the team."""
        return self.policy.agents

    @property
    def groups(self) -> tuple[str, ...]:
        """The group of observations that it sees."""
        return self.policy.groups

    def initial_memory(self, num_envs: int) -> Memory:
        """Returns the initial recurrent state of the policy."""
        return self.policy.initial_memory(num_envs)

    def act(self, obs: Any, memory: Memory, key: jax.Array) -> tuple[jax.Array, Memory]:
        """Returns the actions; see `Policy`."""
        action, memory = self.policy.act(obs, memory, key)
        return self.here.translated(action, self.own), memory


def translate(policy: TrainedPolicy, env: QuadrupedEnv, name: str, check: Callable[..., None]) -> Policy:
    """Returns a trained policy as it acts in a task: itself, or of several skills with its own one.

    `check(policy, env, name)` raises an InputError where the policy does not fit the task.
    """
    if env.control == "command" and len(env.controller.skill.parts) > 1:
        params = dataclasses.replace(env.params, **meaning_of(policy))
        own, here = params.commander, env.params.commander
        if here.admits(own):
            if beyond := own.skill.untrained(params.commanded()):
                raise InputError(f"policy: {name} commands beyond what its skill is trained for: {', '.join(beyond)}")
            view = copy.copy(env)  # as the policy was trained
            view.params, view.controller = params, dataclasses.replace(env.controller, commands=own.commands)
            check(policy, view, name)
            return Translated(policy, own, here)
    check(policy, env, name)
    return policy


def meaning_of(policy: TrainedPolicy) -> dict[str, Any]:
    """Returns the skill and the command ranges with which a policy was trained, by names of task parameters."""
    given = policy.config.training_env
    return {name: given.get(name, getattr(TaskParams, name)) for name in ("skill", "command_ranges")}


def together(params: TaskParams, policies: Sequence[Any]) -> dict[str, Any]:
    """Returns the skills and the command ranges with which policies of different skills can meet, each with its own.

    Empty where all trained ones have the same skill.
    """
    meanings = [meaning_of(policy) for policy in policies if isinstance(policy, TrainedPolicy)]
    several = [name for meaning in meanings if not isinstance(meaning["skill"], str) for name in meaning["skill"]]
    names = dict.fromkeys([*several, *(name for name in SKILLS if name in [x["skill"] for x in meanings])])
    if len({meaning["skill"] for meaning in meanings}) < 2:
        return {}
    each = [dataclasses.replace(params, **meaning).commanded() for meaning in meanings]
    lowest, highest = (
        {name: of(limits[name][end] for limits in each) for name in params.commands}
        for end, of in enumerate((min, max))
    )
    return {"skill": tuple(names), "command_ranges": {name: (lowest[name], highest[name]) for name in lowest}}
