"""Policies for evaluation and rendering: trained, scripted or trivial, and the opponent in a match."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from mqe_jax.envs import TaskParams
from mqe_jax.errors import InputError
from mqe_jax.planners import scripted_policy
from mqe_jax.train.evaluate import Act
from mqe_jax.train.policy import Policy

PLANNER_NAMES = ("scripted", "random", "idle", "forward")


@dataclasses.dataclass(frozen=True)
class Player:
    """A task with its parameters, and the policy to run."""

    task: str
    """Id of the task."""
    overrides: dict[str, Any]
    """Task parameters that differ from the defaults."""
    policy: Policy | str
    """Trained policy, or one of `PLANNER_NAMES`."""
    opponent: str | None = None
    """Policy of team 1 in a match: one of `PLANNER_NAMES`, or self (the same as team 0); None is idle."""

    def act(self, env: Any, deterministic: bool) -> Act:
        """Returns the batched `act` of all agents.

        Raises:
            InputError: if the policy or the opponent does not fit the task.
        """
        act = self._own_act(env, deterministic)
        if self.opponent is not None and len(env.teams) < 2:
            raise InputError(f"opponent: {self.task} is not a competitive task; omit --opponent")
        if len(env.teams) < 2 or self.opponent == "self":
            return act
        return against(act, planner(self.opponent or "idle", env), env)

    def memory(self, num_envs: int) -> Any:
        """Returns the policy's initial recurrent state."""
        return () if isinstance(self.policy, str) else self.policy.initial_memory(num_envs)

    def _own_act(self, env: Any, deterministic: bool) -> Act:
        if isinstance(self.policy, str):
            return planner(self.policy, env)
        policy = self.policy
        sizes = (env.num_agents, env.observation_size, env.action_size)
        trained = (policy.dims.agents, policy.dims.observation, policy.dims.action)
        if sizes != trained:
            raise InputError(
                f"policy: trained for (agents, observation, action) {trained}, but {self.task} has {sizes}"
            )

        def act(obs: jax.Array, memory: Any, key: jax.Array) -> tuple[jax.Array, Any]:
            return policy.act(obs, memory, key, deterministic=deterministic)

        return act


def against(act: Act, opponent: Act, env: Any) -> Act:
    """Combines `act` for team 0 with `opponent`, which has no recurrent state, for team 1."""
    second = jnp.asarray([agent in env.teams[1] for agent in range(env.num_agents)])[:, None]

    def both(obs: jax.Array, memory: Any, key: jax.Array) -> tuple[jax.Array, Any]:
        own_key, other_key = jax.random.split(key)
        action, memory = act(obs, memory, own_key)
        return jnp.where(second, opponent(obs, (), other_key)[0], action), memory

    return both


def planner(name: str, env: Any) -> Act:
    """Returns the `act` of a scripted or trivial policy; InputError if the task has no scripted one."""
    shape = (env.num_agents, env.action_size)
    plan = _scripted(env) if name == "scripted" else None

    def act(obs: jax.Array, memory: Any, key: jax.Array) -> tuple[jax.Array, Any]:
        if plan is not None:
            return plan(obs), memory
        if name == "random":
            return jax.random.uniform(key, (len(obs), *shape), minval=-1.0, maxval=1.0), memory
        action = jnp.zeros((len(obs), *shape))
        return (action.at[..., 0].set(0.25) if name == "forward" else action), memory

    return act


def _scripted(env: Any) -> Callable[[jax.Array], jax.Array]:
    """Returns the task's scripted policy for a batch: observations (N, A, O) to actions (N, A, 3)."""
    plan = scripted_policy(env)
    if env.control != "command":
        raise InputError(
            f"planner: 'scripted' outputs walk commands; control must be 'command', not {env.control!r}; "
            "with it give --planner random or idle"
        )
    if tuple(env.params.commands) != TaskParams.commands:
        raise InputError(f"commands: {env.params.commands}; planner 'scripted' outputs {TaskParams.commands}")
    return jax.vmap(plan)
