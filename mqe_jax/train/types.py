"""Environment protocol and learner data types."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import jax

PyTree = Any
Params = dict[str, Any]
"""Nested dict of parameter arrays."""
Memory = Any
"""Recurrent state: a pytree of arrays with leading axis N, or an empty one for networks without memory."""


class EnvState(Protocol):
    """The fields of a batched environment state that the learner reads; N environments of A agents.

    obs (N, A, O) is the input of the next action; final_obs (N, A, O) and final_privileged_obs (N, P) belong to the
    state reached by the step, before any reset; privileged_obs (N, P); reward (N, A); terminated, truncated (N,) bool;
    metrics maps names to (N,), and every name is present from the reset on.
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


class VectorEnv(Protocol):
    """N environments with automatic reset; `reset` and `step` are pure and may be jitted.

    `reset(key) -> state`, `step(state, action (N, A, action_size)) -> state`; the state is any pytree with the fields
    of `EnvState`.
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


class NetworkMemory(NamedTuple):
    """Recurrent state of a network's two roles; leading axis N."""

    actor: Memory
    critic: Memory


class Transition(NamedTuple):
    """One step of a rollout; stacked by the scan to a leading axis T."""

    memory: NetworkMemory  # before this step, zeroed at an episode's first step
    is_first: jax.Array  # (N,) bool, the step is the first of its episode
    obs: jax.Array  # (N, A, O)
    privileged_obs: jax.Array  # (N, P)
    final_obs: jax.Array  # (N, A, O), of the state reached
    final_privileged_obs: jax.Array  # (N, P)
    action: jax.Array  # (N, A, D), as sampled: unscaled and unclipped
    log_prob: jax.Array  # (N, A, D)
    reward: jax.Array  # (N, A)
    terminated: jax.Array  # (N,) bool
    done: jax.Array  # (N,) bool, terminated or truncated


class Batch(NamedTuple):
    """Chunks of L steps to learn from: (L, C, ...), the memory at each chunk's first step (C, ...)."""

    memory: NetworkMemory
    is_first: jax.Array
    obs: jax.Array
    privileged_obs: jax.Array
    action: jax.Array
    log_prob: jax.Array
    advantage: jax.Array  # (L, C, V)
    target: jax.Array  # (L, C, V), in units of reward
    old_value: jax.Array  # (L, C, V), normalised
