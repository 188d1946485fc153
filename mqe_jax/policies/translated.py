"""Trained policies in tasks whose actions choose between skills: each acts with its own skill and command ranges."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax

from mqe_jax.core.errors import InputError
from mqe_jax.core.types import Memory
from mqe_jax.envs import QuadrupedEnv
from mqe_jax.policies.mixture import Trained
from mqe_jax.skills import SKILLS
from mqe_jax.skills.control import Commander
from mqe_jax.train.policy import Composed, Policy, check_policy


@dataclasses.dataclass(frozen=True)
class Translated(Composed):
    """A trained policy whose actions mean `own`, as a policy of a task whose actions mean `here`."""

    policy: Trained
    own: Commander = dataclasses.field(repr=False)
    here: Commander = dataclasses.field(repr=False)

    _parts = property(lambda self: (self.policy,))

    def initial_memory(self, num_envs: int) -> Memory:
        """Returns the initial recurrent state of the policy."""
        return self.policy.initial_memory(num_envs)

    def act(self, obs: Any, memory: Memory, key: jax.Array) -> tuple[jax.Array, Memory]:
        """Returns the actions; see `Policy`."""
        action, memory = self.policy.act(obs, memory, key)
        return self.here.translated(action, self.own), memory


def translate(policy: Trained, env: QuadrupedEnv, name: str) -> Policy:
    """Returns a trained policy as it acts in a task: itself, or of several skills with its own one.

    Raises:
        InputError: if the policy does not fit the task.
    """
    needs = policy.needs
    if needs.control == "command" == env.control and len(env.controller.skill.parts) > 1:
        gait = needs.gait and env.params.gait  # a skill may have no gaits
        params = dataclasses.replace(env.params, skill=needs.skill, gait=gait, command_ranges=needs.command_ranges)
        own, here = params.commander, env.params.commander
        if here.admits(own):
            if beyond := own.skill.untrained_commands(params.action_ranges()):
                raise InputError(f"policy: {name} commands beyond what its skill is trained for: {', '.join(beyond)}")
            view = copy.copy(env)  # as the policy was trained
            view.params, view.controller = params, dataclasses.replace(env.controller, commands=own.commands)
            check_policy(policy, view, name)
            return Translated(policy, own, here)
    check_policy(policy, env, name)
    return policy


def together(every: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Returns the skills and the command ranges with which policies of different skills can meet, each with its own.

    Empty where all have the same skill. Policies are given by their `Needs.by_name()`.
    """
    skills = [needs["skill"] for needs in every]
    if len({*skills}) < 2:
        return {}
    several = [name for skill in skills if isinstance(skill, tuple) for name in skill]
    names = dict.fromkeys([*several, *(name for name in SKILLS if name in skills)])
    ranges = [needs["command_ranges"] for needs in every]
    common = [name for name in ranges[0] if all(name in each for each in ranges)]
    limits = {name: list(zip(*(each[name] for each in ranges), strict=True)) for name in common}
    return {"skill": tuple(names), "command_ranges": {x: (min(low), max(high)) for x, (low, high) in limits.items()}}
