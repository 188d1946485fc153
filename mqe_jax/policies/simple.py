"""Policies that need no file: scripted, random, idle, forward, and functions."""

import dataclasses
import functools
from collections.abc import Callable, Hashable
from typing import Any

import jax
import jax.numpy as jnp

from mqe_jax.acting.seats import action_and_memory, check_actions
from mqe_jax.core import devices
from mqe_jax.core.errors import InputError
from mqe_jax.core.precision import single
from mqe_jax.core.settings import checked, fail
from mqe_jax.core.types import Memory, Observations, RandomKey
from mqe_jax.envs import QuadrupedEnv, TaskParams
from mqe_jax.envs.registry import NAMED_SCRIPTED, NAMES
from mqe_jax.policies.scripted import compiling, find_scripted, scripted_policy
from mqe_jax.skills.control import Commander
from mqe_jax.train.policy import check_obs

_FORWARD = 0.25
"""The first action of `forward`."""


@dataclasses.dataclass(frozen=True)
class SimplePolicy:
    """A policy without parameters and recurrent state."""

    task: str
    """Id of the task."""
    agents: int
    """Number of agents of the team."""
    plan: Callable[[jax.Array, jax.Array], jax.Array] = dataclasses.field(repr=False)
    """Observations (N, A, O) and a key to actions (N, A, D)."""
    name: str = ""
    """Name for `load_policy`; empty if it has none."""
    identity: Hashable = dataclasses.field(default=None, repr=False, compare=False)
    """A value that is equal for policies that act alike; None: there is no other."""

    def initial_memory(self, num_envs: int | None = None) -> Memory:
        """Returns an empty recurrent state."""
        return ()

    @single
    @checked
    def act(self, obs: Any, memory: Memory, key: RandomKey) -> tuple[jax.Array, Memory]:
        """Returns the actions; see `Policy`."""
        obs = check_obs(Observations.at(obs).obs, self.agents)
        return self.plan(obs, key), memory


def names(task: str = "") -> tuple[str, ...]:
    """Returns the names of a task's simple policies: `NAMES`, and its further scripted ones."""
    return (*NAMES, *NAMED_SCRIPTED.get(task, ()))


def named(name: str, env: QuadrupedEnv, field: str = "policy") -> SimplePolicy:
    """Returns the policy of a name for one team of a task.

    Raises:
        InputError: naming `field`, if the task has no such scripted policy, or if its actions do
            not fit.
    """
    agents = len(env.teams[0])
    shape = (agents, env.action_size)
    if name == "random":
        plan = functools.partial(_uniform, shape)
    elif name in ("idle", "forward"):
        plan = functools.partial(_constant, shape, _FORWARD if name == "forward" else 0.0)
    else:
        _check_scripted(name, env, field)
        plan = functools.partial(_act_scripted, env, name)
    identity = (name, env.identity) if isinstance(env, QuadrupedEnv) else None
    return SimplePolicy(env.name, agents, plan, name, identity)


def from_function(act: Callable[..., Any], env: QuadrupedEnv, name: str = "") -> SimplePolicy:
    """Returns the policy of a function `act(obs, memory, key)` for one team of a task.

    The function has no recurrent state: its memory is ().
    """

    agents = len(env.teams[0])

    def plan(obs: jax.Array, key: jax.Array) -> jax.Array:
        with compiling(name):
            action, memory = action_and_memory(act(obs, (), key))
        if jax.tree.leaves(memory):
            allowed = "one that returns (action, ()); an object with `initial_memory` has a memory"
            fail("policy", f"{name or 'a function'} with a memory", allowed)
        check_actions(action, (len(obs), agents, env.action_size), name or "a function")
        return action

    return SimplePolicy(env.name, agents, plan, name)


def _uniform(shape: tuple[int, ...], obs: jax.Array, key: jax.Array) -> jax.Array:
    return devices.rows(
        lambda n: jax.random.uniform(key, (n, *shape), minval=-1.0, maxval=1.0), len(obs)
    )


def _constant(shape: tuple[int, ...], first: float, obs: jax.Array, key: jax.Array) -> jax.Array:
    return jnp.zeros((len(obs), *shape)).at[..., 0].set(first)


def _act_scripted(env: QuadrupedEnv, name: str, obs: jax.Array, key: jax.Array) -> jax.Array:
    part = env.controller.skill.parts[0]
    own = Commander(part, env.params.commands, part.default_commands(), {})
    action = env.controller.translate(jax.vmap(scripted_policy(env, name))(obs), own)
    silent = jnp.zeros((*action.shape[:-1], env.action_size - action.shape[-1]))
    return jnp.concatenate([action, silent], axis=-1) if silent.shape[-1] else action


def _check_scripted(name: str, env: QuadrupedEnv, field: str) -> None:
    """Raises an InputError if the task has no scripted policy of a name, or its actions differ."""
    find_scripted(env.name, name, field)
    if env.control != "command":
        raise InputError(
            f"{field}: {name!r} outputs walk commands; control is {env.control!r}; use another, "
            "such as random, or none in a training"
        )
    if tuple(env.params.commands) != TaskParams.commands:
        raise InputError(
            f"commands: {env.params.commands}; policy {name!r} outputs {TaskParams.commands}"
        )
