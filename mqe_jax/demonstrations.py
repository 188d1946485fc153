"""Training episodes that start in states of a demonstrator's episodes: a curriculum for rewards that are rarely met.

Source: resets to demonstrated states, moved backwards as success permits (Tao et al., arXiv 2405.03379).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from mqe_jax.engines import STATE_FIELDS
from mqe_jax.envs import QuadrupedEnv, State, VectorEnv
from mqe_jax.envs.autoreset import KEPT, SEEN
from mqe_jax.precision import single
from mqe_jax.settings import checked, fail
from mqe_jax.train import devices
from mqe_jax.train.policy import Policy, groups_of
from mqe_jax.train.types import AnyPolicy, PyTree, observations, where_rows

EPISODES = 128
"""Environments in which the demonstrator acts."""
MOMENTS = 16
"""States recorded of each, evenly spaced over the time limit."""
WINDOW = 0.25
"""Range of the phases from which episodes start."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class DemonstratedState(State[Any]):
    """States of N environments, and M states in which episodes can start."""

    demonstrations: PyTree
    """Fields of the M states, leading axis M; of the physics state, `STATE_FIELDS`. With `backward` also
    `phase`, by which they are in order: the share of the time until the success of its episode at which a state is;
    infinite of states after it, and of episodes without."""


class Demonstrated(VectorEnv):
    """A batch of environments whose episodes start in states of a demonstrator's.

    They do with the probability `assistance`, in any state; or, `backward`, always, in states whose phase is up to
    `WINDOW` below the assistance. The time of such a state counts, so its episode has the time that was left to the
    demonstrator. The states are the same in all runs of a task.
    """

    @checked(demonstrator=AnyPolicy, backward=bool)
    def __init__(
        self,
        env: QuadrupedEnv,
        num_envs: int,
        demonstrator: Policy,
        copies: int = 1,
        *,
        backward: bool = False,
        final: Sequence[str] = SEEN,
    ) -> None:
        """Creates the batch; `demonstrator` acts for all agents, the others are those of `VectorEnv`."""
        super().__init__(env, num_envs, copies, final=final)
        if (demonstrator.task, demonstrator.agents) != (env.name, env.num_agents):
            given = f"one of {demonstrator.agents} agents on {demonstrator.task}"
            fail("demonstrator", given, f"one of all {env.num_agents} agents on {env.name}")
        if self.max_episode_steps < MOMENTS:
            fail("episode_length", env.params.episode_length, f"at least {MOMENTS} steps with a demonstrator")
        self.demonstrator, self.backward = demonstrator, backward
        self._guide = VectorEnv(self.env, EPISODES, final=()).with_groups(groups_of(demonstrator))

    @single
    def reset(self, key: jax.Array) -> DemonstratedState:
        """Returns N initial states of the task, with the demonstrator's states, which do not depend on the key."""
        with devices.alone():
            demonstrations = self._record()
        return DemonstratedState(**vars(super().reset(key)), demonstrations=demonstrations)

    @single
    def step(self, state: State, action: jax.Array) -> DemonstratedState:
        """Advances all environments by one step with actions (N, A, action_size); resets those that ended."""
        self.check_step(state, action, DemonstratedState)
        assert isinstance(state, DemonstratedState)
        demonstrations = state.demonstrations
        fields = {name: x for name, x in demonstrations.items() if name != "phase"}

        def start(key: jax.Array, assistance: jax.Array) -> State:
            fresh_key, choice_key, index_key = jax.random.split(key, 3)
            fresh = self.env.begin(fresh_key, assistance)
            if self.backward:
                index, chosen = _earlier(demonstrations["phase"], assistance, index_key)
            else:
                index = jax.random.randint(index_key, (), 0, len(fields["step"]))
                chosen = jax.random.bernoulli(choice_key, assistance)
            begun = jax.tree.map(lambda x, y: jnp.where(chosen, x[index], y), fields, _fields(fresh))
            return dataclasses.replace(fresh, **{**begun, "data": fresh.data.replace(**begun["data"])})

        plain = State(**{field.name: getattr(state, field.name) for field in dataclasses.fields(State)})
        after = jax.vmap(functools.partial(self._step, start=start))(plain, action)
        return DemonstratedState(**vars(after), demonstrations=demonstrations)

    def _record(self) -> PyTree:
        """Returns the fields of the demonstrator's states; with `backward` in the order of their phases."""
        guide, policy = self._guide, self.demonstrator
        first = policy.initial_memory(EPISODES)

        def advance(carry: tuple[State, Any], key: jax.Array) -> tuple[tuple[State, Any], Any]:
            state, memory = carry
            action, memory = policy.act(observations(state).to(policy), memory, key)
            state = guide.step(state, action)
            done = state.terminated | state.truncated
            return (state, where_rows(done, first, memory)), (jnp.max(state.outcome.success, axis=-1), done)

        def moment(carry: tuple[State, Any], keys: jax.Array) -> tuple[tuple[State, Any], PyTree]:
            carry, seen = jax.lax.scan(advance, carry, keys)
            return carry, (_fields(carry[0]), seen)

        reset_key, key = jax.random.split(jax.random.PRNGKey(0))
        keys = jax.random.split(key, (MOMENTS, self.max_episode_steps // MOMENTS))
        _, (fields, (decided, done)) = jax.lax.scan(moment, (guide.reset(reset_key), first), keys)
        if self.backward:
            fields = {**fields, "phase": _phases(decided, done)}
        fields = jax.tree.map(lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:]), fields)
        return jax.tree.map(lambda x: x[jnp.argsort(fields["phase"])], fields) if self.backward else fields


def _earlier(phase: jax.Array, assistance: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the index () of a state with a phase (M,), in order, of up to `WINDOW` below the assistance, if any."""
    low, high = jnp.searchsorted(phase, jnp.stack([assistance - WINDOW, assistance]))
    return jax.random.randint(key, (), low, jnp.maximum(high, low + 1)), high > low


def _phases(decided: jax.Array, done: jax.Array) -> jax.Array:
    """Returns the phases of the states after each group of steps (M, E), from the steps of all (M, S, E).

    Each environment's first episode counts, if it is `decided`: success of it, or of a match either team's win. The
    moment of success is the first at which the measure of success has its largest value.
    """
    moments, stride = decided.shape[:2]
    decided, done = (x.reshape(moments * stride, -1) for x in (decided, done))
    first = jnp.cumsum(done, axis=0) - done.astype(jnp.int32) == 0
    decided = jnp.where(first, decided, 0.0)
    end = jnp.argmax(decided, axis=0) + 1
    steps = stride * jnp.arange(1, moments + 1)[:, None]
    return jnp.where((steps < end) & (jnp.max(decided, axis=0) > 0), steps / end, jnp.inf)


def _fields(state: State) -> dict[str, Any]:
    """Returns the fields of states that a start sets."""
    names = [field.name for field in dataclasses.fields(State) if field.name not in ("data", "key", *SEEN, *KEPT)]
    return {**{name: getattr(state, name) for name in names}, "data": {n: getattr(state.data, n) for n in STATE_FIELDS}}
