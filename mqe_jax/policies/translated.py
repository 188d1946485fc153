"""Trained policies in tasks with wider actions.

Each policy acts with its own skill. A policy without sensors sends no messages.
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
from mqe_jax.train.policy import TrainedPolicy


@dataclasses.dataclass(frozen=True)
class _Around:
    """A policy around another one, of the same task and team."""

    policy: Any

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
        """The groups of observations that the policy sees."""
        return self.policy.groups


@dataclasses.dataclass(frozen=True)
class Translated(_Around):
    """A trained policy whose actions mean `own` in a task whose actions mean `here`."""

    policy: TrainedPolicy
    own: Commander = dataclasses.field(repr=False)
    here: Commander = dataclasses.field(repr=False)
    sensed: slice | None = None
    """Slice of the last action, as it means here, in the observations; None if they lack it."""

    def initial_memory(self, num_envs: int) -> Memory:
        """Returns the policy's initial recurrent state, with its last action if it sees that."""
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
class Silent(_Around):
    """A policy without sensors in a task with messages of `numbers` numbers; it sends zeros."""

    policy: Policy
    numbers: int

    def initial_memory(self, num_envs: int) -> Memory:
        """Returns the initial recurrent state of the policy."""
        return self.policy.initial_memory(num_envs)

    def act(self, obs: Any, memory: Memory, key: jax.Array) -> tuple[jax.Array, Memory]:
        """Returns the actions; see `Policy`."""
        action, memory = self.policy.act(obs, memory, key)
        return jnp.concatenate(
            [action, jnp.zeros((*action.shape[:-1], self.numbers))], axis=-1
        ), memory


def translate(policy: TrainedPolicy, env: QuadrupedEnv, name: str, field: str = "policy") -> Policy:
    """Returns a trained policy as it acts in a task.

    Among several skills, it acts with its own one. If robots send messages, a policy without
    sensors is silent. Any other policy acts as it is.

    Raises:
        InputError: naming `field`, if the policy does not fit the task.
    """
    policy = policy.at_size(env)
    needs = policy.needs
    params = env.params
    numbers = 0 if needs.senses else sum(sensor.action_size for sensor in params.senses)
    if numbers:
        params = dataclasses.replace(params, senses=())
    own = None
    if needs.control == "command" == env.control and len(env.controller.skill.parts) > 1:
        changes = {"skill": needs.skill, "command_ranges": needs.command_ranges}
        changes["gait"] = needs.gait and params.gait  # a skill may have no gaits
        trained = dataclasses.replace(params, **changes)
        if params.commander.admits(trained.commander):
            params = trained
            own = trained.commander
            if beyond := own.skill.untrained_commands(params.action_ranges()):
                raise InputError(
                    f"{field}: {name} commands beyond what its skill is trained for: "
                    f"{', '.join(beyond)}"
                )
    as_trained = env
    if params is not env.params:
        as_trained = copy.copy(env)
        vars(as_trained).update(params=params)
        vars(as_trained).pop("suite", None)  # which depends on them
    if own is not None:
        controller = dataclasses.replace(env.controller, commands=own.commands)
        vars(as_trained).update(controller=controller)
    check_policy(policy, as_trained, name, field)
    translated: Policy = policy
    if own is not None:
        layout = env.layouts[needs.group]
        remembers = needs.senses and "action" in layout.names
        sensed = layout.slice("action") if remembers else None
        if sensed is not None and sensed.stop - sensed.start != env.controller.action_size:
            raise InputError(
                f"{field}: {name} remembers actions or sends messages; it meets its own skill only"
            )
        translated = Translated(policy, own, env.params.commander, sensed)
    return Silent(translated, numbers) if numbers else translated


def together(every: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Returns the skills and command ranges with which policies of different skills can meet.

    Each acts with its own skill. Policies are passed as their `Needs.by_name()`. The result is
    empty if all have the same skill.
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
