"""What the learner asks of an environment, and the records that it passes along."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import jax

PyTree = Any
Memory = Any
"""A pytree of arrays with leading axis N, or an empty one for networks without memory."""


class EnvState(Protocol):
    """The fields of a batched environment state that the learner reads; N worlds of A agents.

    obs (N, A, O) is what to act on next; final_obs (N, A, O) and final_privileged_obs (N, P) belong to the
    state in which the step arrived, before any reset; privileged_obs (N, P); reward (N, A);
    terminated, truncated (N,) bool; metrics maps names to (N,); step (N,) int32.
    """

    @property
    def obs(self) -> jax.Array: ...
    @property
    def privileged_obs(self) -> jax.Array: ...
    @property
    def final_obs(self) -> jax.Array: ...
    @property
    def final_privileged_obs(self) -> jax.Array: ...
    @property
    def reward(self) -> jax.Array: ...
    @property
    def terminated(self) -> jax.Array: ...
    @property
    def truncated(self) -> jax.Array: ...
    @property
    def metrics(self) -> dict[str, jax.Array]: ...
    @property
    def step(self) -> jax.Array: ...


class VectorEnv(Protocol):
    """N worlds that reset themselves; `reset` and `step` are pure and may be jitted.

    `reset(key) -> state`, `step(state, action (N, A, action_size)) -> state`; the state is any pytree with
    the fields of `EnvState`. An environment may also have `max_episode_steps` (int), which staggering needs.
    """

    @property
    def name(self) -> str: ...
    @property
    def num_envs(self) -> int: ...
    @property
    def num_agents(self) -> int: ...
    @property
    def observation_size(self) -> int: ...
    @property
    def privileged_observation_size(self) -> int: ...
    @property
    def action_size(self) -> int: ...
    def reset(self, key: jax.Array) -> Any: ...
    def step(self, state: Any, action: jax.Array) -> Any: ...


class Transition(NamedTuple):
    """One step of a rollout; stacked by the scan to a leading axis T."""

    memory: Memory  # what the networks remembered before this step, zeroed at an episode's start
    start: jax.Array  # (N,) bool, the step is the first of its episode
    obs: jax.Array  # (N, A, O)
    privileged_obs: jax.Array  # (N, P)
    final_obs: jax.Array  # (N, A, O), where the step arrived
    final_privileged_obs: jax.Array  # (N, P)
    action: jax.Array  # (N, A, D), before the environment clips it
    log_prob: jax.Array  # (N, A, D)
    reward: jax.Array  # (N, A)
    terminated: jax.Array  # (N,) bool
    done: jax.Array  # (N,) bool, terminated or truncated


class Batch(NamedTuple):
    """Chunks of L steps to learn from: (L, C, ...), the memory at each chunk's start (C, ...)."""

    memory: Memory
    start: jax.Array
    obs: jax.Array
    privileged_obs: jax.Array
    action: jax.Array
    log_prob: jax.Array
    advantage: jax.Array  # (L, C, V)
    target: jax.Array  # (L, C, V), in units of reward
    old_value: jax.Array  # (L, C, V), as the network gives it (normalised)
