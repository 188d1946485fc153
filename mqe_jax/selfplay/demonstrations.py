"""Training episodes that start in states of a demonstrator's episodes.

They are a curriculum for rare rewards.

Source: resets to demonstrated states (Tao et al., arXiv 2405.03379).
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from mqe_jax.acting.seats import Seats
from mqe_jax.core import devices
from mqe_jax.core.precision import single
from mqe_jax.core.settings import fail
from mqe_jax.core.types import PyTree, observations
from mqe_jax.envs import QuadrupedEnv, State, VectorEnv
from mqe_jax.envs.autoreset import KEPT, SEEN
from mqe_jax.envs.state import FINAL
from mqe_jax.physics.engines import STATE_FIELDS

NUM_ENVS = 128
"""Environments in which the demonstrator acts."""
MOMENTS = 16
"""States recorded of each, evenly spaced over the time limit."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class DemonstratedState(State[Any]):
    """States of N environments, and M states in which episodes can start."""

    # fields of the M states, leading axis M; of the physics state, `STATE_FIELDS`
    demonstrations: PyTree


class Demonstrated(VectorEnv):
    """A batch of environments whose episodes can start in states of a demonstrator's episodes.

    An episode starts in such a state with probability `assistance`. It then has the time that was
    left to the demonstrator. The states are the same in all runs of a task.
    """

    def __init__(
        self,
        env: QuadrupedEnv,
        num_envs: int,
        demonstrator: Seats,
        copies: int = 1,
        *,
        final: Sequence[str] = FINAL,
    ) -> None:
        """Creates the batch, as `VectorEnv`; `demonstrator` acts in it."""
        super().__init__(env, num_envs, copies, final=final)
        if self.max_episode_steps < MOMENTS:
            fail(
                "episode_length",
                env.params.episode_length,
                f"at least {MOMENTS} steps with a demonstrator",
            )
        self.demonstrator = demonstrator
        self._guide = VectorEnv(self.env, NUM_ENVS, final=()).with_groups(demonstrator.groups)

    @single
    def reset(self, key: jax.Array) -> DemonstratedState:
        """Returns N initial states of the task, with the demonstrator's states.

        The demonstrator's states do not depend on the key.
        """
        with devices.alone():
            demonstrations = self._record()
        return DemonstratedState(**vars(super().reset(key)), demonstrations=demonstrations)

    @single
    def step(self, state: State, action: jax.Array) -> DemonstratedState:
        """Advances all environments by one step and resets those that ended.

        Actions are (N, A, action_size).
        """
        self.check_step(state, action, DemonstratedState)
        assert isinstance(state, DemonstratedState)
        demonstrations = state.demonstrations

        def start(key: jax.Array, assistance: jax.Array) -> State:
            fresh_key, choice_key, index_key = jax.random.split(key, 3)
            fresh = self.env.begin(fresh_key, assistance)
            index = jax.random.randint(index_key, (), 0, len(demonstrations["step"]))
            chosen = jax.random.bernoulli(choice_key, assistance)
            begun = jax.tree.map(
                lambda x, y: jnp.where(chosen, x[index], y), demonstrations, _fields(fresh)
            )
            return dataclasses.replace(
                fresh, **{**begun, "data": fresh.data.replace(**begun["data"])}
            )

        plain = State(
            **{field.name: getattr(state, field.name) for field in dataclasses.fields(State)}
        )
        after = jax.vmap(functools.partial(self._step, start=start))(plain, action)
        return DemonstratedState(**vars(after), demonstrations=demonstrations)

    def _record(self) -> PyTree:
        guide = self._guide
        seats = self.demonstrator
        still = jnp.zeros((NUM_ENVS, guide.num_agents, guide.action_size))

        def advance(carry: tuple[State, Any], key: jax.Array) -> tuple[tuple[State, Any], None]:
            state, memory = carry
            action, memory = seats.act(observations(state), memory, key, still)
            state = guide.step(state, action)
            done = state.terminated | state.truncated
            return (state, seats.restart(memory, done)), None

        def moment(carry: tuple[State, Any], keys: jax.Array) -> tuple[tuple[State, Any], PyTree]:
            carry, _ = jax.lax.scan(advance, carry, keys)
            return carry, _fields(carry[0])

        reset_key, key = jax.random.split(jax.random.PRNGKey(0))
        keys = jax.random.split(key, (MOMENTS, self.max_episode_steps // MOMENTS))
        start = (guide.reset(reset_key), seats.initial_memory(NUM_ENVS))
        _, fields = jax.lax.scan(moment, start, keys)
        return jax.tree.map(lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:]), fields)


def _fields(state: State) -> dict[str, Any]:
    """Returns the fields of states that a start sets."""
    names = [
        field.name
        for field in dataclasses.fields(State)
        if field.name not in ("data", "key", *SEEN, *KEPT)
    ]
    return {
        **{name: getattr(state, name) for name in names},
        "data": {n: getattr(state.data, n) for n in STATE_FIELDS},
    }
