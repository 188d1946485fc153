"""Batches of worlds that start over by themselves."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from mqe_jax.envs.base import QuadrupedEnv, State

# Fields that tell how a step went: an auto-reset keeps them.
_KEPT = ("aid", "reward", "terminated", "truncated", "metrics", "final_obs", "final_privileged_obs")


def autoreset(env: QuadrupedEnv, state: State) -> State:
    """Replaces one finished world by a freshly drawn one.

    Whole state, no forward pass. `reward`, `terminated`, `truncated`, `metrics` and `final_obs` still tell of the
    step that ended the episode; `obs` is the fresh world's. The aid stays.
    """
    done = state.terminated | state.truncated
    key, reset_key = jax.random.split(state.key)
    fresh = env.reset(reset_key, state.aid)
    merged = {
        field.name: jax.tree.map(
            lambda new, old: jnp.where(done, new, old), getattr(fresh, field.name), getattr(state, field.name)
        )
        for field in dataclasses.fields(State)
        if field.name not in ("data", "key", *_KEPT)
    }
    data = env.physics.merge(done, fresh.data, state.data)
    return dataclasses.replace(state, data=data, key=key, **merged)


class VectorEnv:
    """Worlds side by side that start over when they end; what trainers use.

    Attributes:
        env: the task.
        num_envs: N.
        max_episode_steps: environment steps until the time limit.
    """

    def __init__(self, env: QuadrupedEnv, num_envs: int) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs: {num_envs} must be at least 1")
        self.env = env.with_room_for(num_envs)
        self.num_envs = num_envs
        self.name = env.name
        self.max_episode_steps = env.max_steps
        self.num_agents = env.num_agents
        self.teams = env.teams
        self.observation_size = env.observation_size
        self.privileged_observation_size = env.privileged_observation_size
        self.action_size = env.action_size

    def reset(self, key: jax.Array) -> State:
        """Returns N fresh worlds; every leaf has a leading axis N."""
        return jax.vmap(self.env.reset)(jax.random.split(key, self.num_envs))

    def step(self, state: State, action: jax.Array) -> State:
        """Advances all worlds by one step with actions (N, A, action_size), and resets those that ended."""

        def one(state: State, action: jax.Array) -> State:
            return autoreset(self.env, self.env.step(state, action))

        return jax.vmap(one)(state, action)
