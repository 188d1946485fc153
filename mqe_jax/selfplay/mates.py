"""A team whose robots meet mates of a pool: environments in which frozen policies act for some of
the agents.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core.errors import InputError
from mqe_jax.core.precision import single
from mqe_jax.core.settings import check_arguments, fail
from mqe_jax.core.types import (
    AnyBatch,
    AnyPolicy,
    Memory,
    RandomKey,
    check_act,
    observations,
    where_rows,
)
from mqe_jax.envs.wrappers import WrappedState, Wrapper
from mqe_jax.train.policy import Policy, check_policy


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class MatesState(WrappedState):
    """States of N environments with mates; `key` is that of the mates' actions."""

    learners: jax.Array  # agents that take the given actions, and learn (N, A) bool
    # recurrent state of the mate of each block of B environments, leading axis B
    memories: tuple[Memory, ...]


class Mates(Wrapper):
    """N environments in K + 1 blocks: in the first the whole team learns, in the others with one of
    K mates.

    Environment i belongs to block i mod (K + 1). The mate of a block acts for one agent, another
    one in each successive environment of the block. Its policy acts for the whole team; only this
    agent's action is used. Training ignores this agent's samples (`state.learners`) and pays the
    team's reward.

    Source: partners from a frozen population, fictitious co-play (Strouse et al., arXiv
    2110.08176).
    """

    @check_arguments(env=AnyBatch, mates=Sequence[AnyPolicy])
    def __init__(self, env: Any, mates: Sequence[Policy]) -> None:
        """Puts policies of the task into a batch of its environments.

        Raises:
            InputError: for a match, a team of one robot, a policy of another task, or fewer
                environments than seats.
        """
        super().__init__(env)
        if len(env.teams) > 1:
            raise InputError(f"env: {env.name} is a match; `versus` gives a team its opponents")
        if env.num_agents < 2:
            raise InputError(f"env: {env.name} has one robot, which has no mate")
        for policy in mates:
            check_policy(policy, env, "a mate", "mates")
        self.mates = tuple(mates)
        if not self.mates or self.num_envs < self._seats:
            allowed = (
                f"from 1 to {self.num_envs // self.num_agents - 1} for {self.num_envs} environments"
            )
            fail("mates", len(self.mates), f"{allowed}, in which each acts for every agent")

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {self.num_envs} with {list(self.mates)}: {self.inner!r}>"

    def share(self, parts: int) -> Self:
        """Returns the environments of one of several processes, which all have the same mates."""
        if parts > 1 and self.num_envs % (parts * self._seats):
            allowed = (
                f"a multiple of {self._seats} for each of {parts} processes, with "
                f"{len(self.mates)} mates"
            )
            fail("num_envs", self.num_envs, allowed)
        return super().share(parts)

    @single
    @check_arguments(key=RandomKey)
    def reset(self, key: jax.Array) -> MatesState:
        """Returns the initial states of all environments."""
        key, inner_key = jax.random.split(key)
        return self._with_mates(super().reset(inner_key), self._initial_memories(), key)

    @single
    def step(self, state: WrappedState, action: jax.Array) -> MatesState:
        """Advances all environments by one step with actions (N, A, action_size); mates' replace
        some of them.
        """
        self.check_step(state, action, MatesState)
        assert isinstance(state, MatesState)
        key, *keys = jax.random.split(state.key, 1 + len(self.mates))
        seen = observations(state)
        action = jnp.asarray(action, jnp.float32)
        memories = []
        for i, (policy, memory) in enumerate(zip(self.mates, state.memories, strict=True)):
            block, own = jax.tree.map(lambda x: x[self._block(i)], (seen, action))  # noqa: B023
            theirs, after = check_act(
                "mates", policy.act(block.to(policy), memory, keys[i]), own.shape, memory
            )
            learners = state.learners[self._block(i), :, None]
            action = action.at[self._block(i)].set(jnp.where(learners, own, theirs))
            memories.append(after)
        stepped = super().step(state, action)
        return self._with_mates(stepped, self._restart(stepped, memories), key)

    @property
    def _seats(self) -> int:
        """Number of successive environments in which each mate acts once for each agent."""
        return (len(self.mates) + 1) * self.num_agents

    def _block(self, index: int) -> slice:
        """Returns the environments of a mate."""
        return slice(index + 1, None, len(self.mates) + 1)

    def _restart(self, state: WrappedState, memories: Sequence[Memory]) -> tuple[Memory, ...]:
        """Returns the mates' recurrent states, initial where an episode ended."""
        first = self._initial_memories()
        done = state.terminated | state.truncated
        return tuple(
            where_rows(done[self._block(i)], first[i], memory) for i, memory in enumerate(memories)
        )

    def _initial_memories(self) -> tuple[Memory, ...]:
        sizes = [len(range(self.num_envs)[self._block(i)]) for i in range(len(self.mates))]
        return tuple(
            policy.initial_memory(size) for policy, size in zip(self.mates, sizes, strict=True)
        )

    def _with_mates(
        self, state: WrappedState, memories: tuple[Memory, ...], key: jax.Array
    ) -> MatesState:
        turn, block = np.divmod(np.arange(self.num_envs), len(self.mates) + 1)
        theirs = (block > 0)[:, None] & (
            turn[:, None] % self.num_agents == np.arange(self.num_agents)
        )
        return MatesState(
            **{**vars(state), "key": key, "learners": jnp.asarray(~theirs), "memories": memories}
        )
