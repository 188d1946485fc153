"""Trained policies in tasks with wider actions: each acts with its own skill, and some send no
messages.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from mqe_jax.acting.seats import Policy, check_policy
from mqe_jax.core.errors import InputError
from mqe_jax.core.types import Memory, Observations
from mqe_jax.envs import QuadrupedEnv
from mqe_jax.skills import SKILLS
from mqe_jax.skills.control import Commander
from mqe_jax.train.policy import Composed, TrainedPolicy


@dataclasses.dataclass(frozen=True)
class Translated(Composed):
    """A trained policy whose actions mean `own`, as a policy of a task whose actions mean
    `here`.
    """

    policy: TrainedPolicy
    own: Commander = dataclasses.field(repr=False)
    here: Commander = dataclasses.field(repr=False)
    sensed: slice | None = None
    """Place of the last action, as it means here, in the policy's observations; None if they lack
    it."""

    _parts = property(lambda self: (self.policy,))

    def initial_memory(self, num_envs: int) -> Memory:
        """Returns the initial recurrent state of the policy; if it sees its last action, with
        that.
        """
        memory = self.policy.initial_memory(num_envs)
        shape = (num_envs, self.agents, self.policy.needs.dims.action)
        return memory if self.sensed is None else (memory, jnp.zeros(shape))

    def act(self, obs: Any, memory: Memory, key: jax.Array | None) -> tuple[jax.Array, Memory]:
        """Returns the actions; see `Policy`."""
        if self.sensed is None:
            action, memory = self.policy.act(obs, memory, key)
            return self.here.translate(action, self.own), memory
        group = self.policy.needs.group
        seen = Observations.at(obs, group)
        memory, last = memory
        here = seen.group(group)
        own = jnp.concatenate(
            [here[..., : self.sensed.start], last, here[..., self.sensed.stop :]], axis=-1
        )
        seen = dataclasses.replace(seen, groups={**seen.groups, group: own})
        action, memory = self.policy.act(seen, memory, key)
        return self.here.translate(action, self.own), (memory, action)


@dataclasses.dataclass(frozen=True)
class Silent(Composed):
    """A policy without sensors, as a policy of a task whose robots send messages of `numbers`
    numbers: zeros.
    """

    policy: Policy
    numbers: int

    _parts = property(lambda self: (self.policy,))

    def initial_memory(self, num_envs: int) -> Memory:
        """Returns the initial recurrent state of the policy."""
        return self.policy.initial_memory(num_envs)

    def act(self, obs: Any, memory: Memory, key: jax.Array) -> tuple[jax.Array, Memory]:
        """Returns the actions; see `Policy`."""
        action, memory = self.policy.act(obs, memory, key)
        return jnp.concatenate(
            [action, jnp.zeros((*action.shape[:-1], self.numbers))], axis=-1
        ), memory


def translate(policy: TrainedPolicy, env: QuadrupedEnv, name: str) -> Policy:
    """Returns a trained policy as it acts in a task: itself, or of several skills with its own one,
    or silent.

    Raises:
        InputError: if the policy does not fit the task.
    """
    policy = policy.at_size(env)
    needs = policy.needs
    if (numbers := sum(sensor.action_size for sensor in env.params.senses)) and not needs.senses:
        view = _changed(env, params=dataclasses.replace(env.params, senses=()))
        return Silent(translate(policy, view, name), numbers)
    if needs.control == "command" == env.control and len(env.controller.skill.parts) > 1:
        gait = needs.gait and env.params.gait  # a skill may have no gaits
        params = dataclasses.replace(
            env.params, skill=needs.skill, gait=gait, command_ranges=needs.command_ranges
        )
        own = params.commander
        here = env.params.commander
        if here.admits(own):
            if beyond := own.skill.untrained_commands(params.action_ranges()):
                raise InputError(
                    f"policy: {name} commands beyond what its skill is trained for: "
                    f"{', '.join(beyond)}"
                )
            controller = dataclasses.replace(env.controller, commands=own.commands)
            # as it was trained
            check_policy(policy, _changed(env, params=params, controller=controller), name)
            layout = env.layouts[needs.group]
            sensed = layout.slice("action") if needs.senses and "action" in layout.names else None
            if sensed is not None and sensed.stop - sensed.start != env.controller.action_size:
                raise InputError(
                    f"policy: {name} remembers actions or sends messages; it meets its own skill "
                    "only"
                )
            return Translated(policy, own, here, sensed)
    check_policy(policy, env, name)
    return policy


def _changed(env: QuadrupedEnv, **attributes: Any) -> QuadrupedEnv:
    """Returns a task with other attributes, to which a policy is compared."""
    other = copy.copy(env)
    vars(other).update(attributes)
    vars(other).pop("suite", None)  # which depends on them
    return other


def together(every: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Returns the skills and command ranges that let policies of different skills meet, each acting
    with its own.

    Empty if all have the same skill. Policies are given by their `Needs.by_name()`.
    """
    skills = [needs["skill"] for needs in every]
    if len({*skills}) < 2:
        return {}
    several = [name for skill in skills if isinstance(skill, tuple) for name in skill]
    names = dict.fromkeys([*several, *(name for name in SKILLS if name in skills)])
    ranges = [needs["command_ranges"] for needs in every]
    common = [name for name in ranges[0] if all(name in each for each in ranges)]
    limits = {name: list(zip(*(each[name] for each in ranges), strict=True)) for name in common}
    return {
        "skill": tuple(names),
        "command_ranges": {x: (min(low), max(high)) for x, (low, high) in limits.items()},
    }
