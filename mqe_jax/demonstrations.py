"""Training episodes that start in states of a demonstrator's episodes: a curriculum for rewards that are rarely met."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from mqe_jax.engines import STATE_FIELDS
from mqe_jax.envs import QuadrupedEnv, State, VectorEnv
from mqe_jax.envs.autoreset import KEPT, autoreset
from mqe_jax.train.policy import Policy
from mqe_jax.train.types import PyTree

EPISODES = 128
"""Environments in which the demonstrator acts."""
MOMENTS = 16
"""States recorded of each, evenly spaced over the time limit."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class DemonstratedState(State[Any]):
    """States of N environments, and M states in which episodes can start."""

    demonstrations: PyTree
    """Fields of the M states, leading axis M; of the physics state, `STATE_FIELDS`."""


class Demonstrated(VectorEnv):
    """A batch of environments whose episodes start, with the probability `assistance`, in states of a demonstrator's.

    The time of such a state counts, so its episode has the time that was left to the demonstrator. The states are the
    same in all runs of a task. Source: resets to demonstrated states, as in arXiv 2405.03379.
    """

    def __init__(self, env: QuadrupedEnv, num_envs: int, demonstrator: Policy, copies: int = 1) -> None:
        """Creates the batch; `demonstrator` acts for all agents, the other arguments are those of `VectorEnv`."""
        super().__init__(env, num_envs, copies)
        self.demonstrator = demonstrator
        self._guide = VectorEnv(self.env, EPISODES)

    def reset(self, key: jax.Array) -> DemonstratedState:
        """Returns N initial states of the task, with the demonstrator's states, which do not depend on the key."""
        return DemonstratedState(**vars(super().reset(key)), demonstrations=self._record())

    def step(self, state: State, action: jax.Array) -> DemonstratedState:
        """Advances all environments by one step with actions (N, A, action_size); resets those that ended."""
        self.check_action(action)
        assert isinstance(state, DemonstratedState), "a state of this batch"
        demonstrations = state.demonstrations
        size = len(demonstrations["step"])

        def start(key: jax.Array, assistance: jax.Array) -> State:
            fresh_key, choice_key, index_key = jax.random.split(key, 3)
            fresh = self.env.reset(fresh_key, assistance)
            index = jax.random.randint(index_key, (), 0, size)
            chosen = jax.random.bernoulli(choice_key, assistance)
            return _with_fields(
                fresh, jax.tree.map(lambda x, y: jnp.where(chosen, x[index], y), demonstrations, _fields(fresh))
            )

        def one(state: State, action: jax.Array) -> State:
            return autoreset(self.env, self.env.step(state, action), start)

        plain = State(**{field.name: getattr(state, field.name) for field in dataclasses.fields(State)})
        return DemonstratedState(**vars(jax.vmap(one)(plain, action)), demonstrations=demonstrations)

    def _record(self) -> PyTree:
        """Returns the fields of the demonstrator's states."""
        guide, policy = self._guide, self.demonstrator
        first = policy.initial_memory(EPISODES)

        def advance(carry: tuple[State, Any], key: jax.Array) -> tuple[tuple[State, Any], None]:
            state, memory = carry
            action, memory = policy.act(state.obs, memory, key)
            state = guide.step(state, action)
            done = state.terminated | state.truncated
            keep = lambda start, now: jnp.where(done.reshape(-1, *(1,) * (now.ndim - 1)), start, now)  # noqa: E731
            return (state, jax.tree.map(keep, first, memory)), None

        def moment(carry: tuple[State, Any], keys: jax.Array) -> tuple[tuple[State, Any], PyTree]:
            carry, _ = jax.lax.scan(advance, carry, keys)
            return carry, _fields(carry[0])

        reset_key, key = jax.random.split(jax.random.PRNGKey(0))
        keys = jax.random.split(key, (MOMENTS, self.max_episode_steps // MOMENTS))
        _, fields = jax.lax.scan(moment, (guide.reset(reset_key), first), keys)
        return jax.tree.map(lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:]), fields)


def _fields(state: State) -> dict[str, Any]:
    """Returns the fields of states that a start sets."""
    names = [field.name for field in dataclasses.fields(State) if field.name not in ("data", "key", *KEPT)]
    return {**{name: getattr(state, name) for name in names}, "data": {n: getattr(state.data, n) for n in STATE_FIELDS}}


def _with_fields(state: State, fields: dict[str, Any]) -> State:
    return dataclasses.replace(state, **{**fields, "data": state.data.replace(**fields["data"])})
