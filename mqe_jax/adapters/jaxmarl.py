"""JaxMARL: `MultiAgentEnv` over the agents `robot_0`, `robot_1`, ..."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from mqe_jax.adapters import agent_names, missing, select, task_env
from mqe_jax.envs import QuadrupedEnv, State
from mqe_jax.envs.autoreset import autoreset
from mqe_jax.errors import InputError

try:
    from jaxmarl.environments.multi_agent_env import MultiAgentEnv
    from jaxmarl.environments.spaces import Box
except ImportError as error:
    raise missing("jaxmarl", error) from None

Arrays = dict[str, jax.Array]


class Env(MultiAgentEnv):
    """One environment; batch with `jax.vmap`. Its state is the task's `State`, whose `final_obs` is kept by a reset.

    Infos have one value per agent (A,), the shape that JaxMARL's baselines expect: `truncation`, and the metrics. Dones
    are true on termination and on truncation.
    """

    env: QuadrupedEnv
    """The task."""

    def __init__(self, task: str | QuadrupedEnv, **overrides: Any) -> None:
        """Creates the environment from a task id or an environment; `overrides` are arguments of `mqe_jax.make`."""
        self.env = task_env(task, **overrides)
        super().__init__(self.env.num_agents)
        self.agents = agent_names(self.env)
        self.observation_spaces = {a: Box(-jnp.inf, jnp.inf, (self.env.observation_size,)) for a in self.agents}
        self.action_spaces = {a: Box(-1.0, 1.0, (self.env.action_size,)) for a in self.agents}

    @property
    def name(self) -> str:
        """Id of the task."""
        return self.env.name

    @property
    def agent_classes(self) -> dict[str, list[str]]:
        """Agents of each team."""
        return {f"team_{i}": [self.agents[j] for j in team] for i, team in enumerate(self.env.teams)}

    @partial(jax.jit, static_argnums=0)
    def reset(self, key: jax.Array) -> tuple[Arrays, State]:
        """Starts an episode."""
        state = self.env.reset(key)
        return self.get_obs(state), state

    @partial(jax.jit, static_argnums=0)
    def step(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, key: jax.Array, state: State, actions: Mapping[str, jax.Array], reset_state: State | None = None
    ) -> tuple[Arrays, State, Arrays, Arrays, dict[str, Any]]:
        """Advances by one environment step and resets an ended environment, to `reset_state` where it is given.

        Replaces the base class's step, which selects between whole states: Warp's contact buffers are shared by all
        environments and cannot be selected.
        """
        _, after, rewards, dones, infos = self.step_env(key, state, actions)
        if reset_state is None:
            after = autoreset(self.env, after)
        else:
            after = select(self.env, dones["__all__"], reset_state, after, kept=("final_obs",))
        return self.get_obs(after), after, rewards, dones, infos

    def step_env(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, key: jax.Array, state: State, actions: Mapping[str, jax.Array]
    ) -> tuple[Arrays, State, Arrays, Arrays, dict[str, Any]]:
        """Advances by one environment step without a reset; the key replaces the state's own random key."""
        if not set(self.agents) <= set(actions):
            raise InputError(f"actions: for {list(actions)}; expected one for each of {', '.join(self.agents)}")
        action = jnp.stack([actions[agent] for agent in self.agents])
        after = self.env.step(dataclasses.replace(state, key=key), action)
        done = after.terminated | after.truncated
        values = {"truncation": after.truncated.astype(jnp.float32), **after.metrics}
        infos = {name: jnp.broadcast_to(value, (self.num_agents,)) for name, value in values.items()}
        rewards = {agent: after.reward[i] for i, agent in enumerate(self.agents)}
        return self.get_obs(after), after, rewards, {**dict.fromkeys(self.agents, done), "__all__": done}, infos

    def get_obs(self, state: State) -> Arrays:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Returns the agents' observations (O,)."""
        return {agent: state.obs[i] for i, agent in enumerate(self.agents)}

    @partial(jax.jit, static_argnums=0)
    def get_avail_actions(self, state: State) -> Arrays:
        """Returns all true (action_size,) bool: continuous actions are always available."""
        return {agent: jnp.ones(self.env.action_size, bool) for agent in self.agents}
