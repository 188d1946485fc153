"""Vectorised environments with automatic reset."""

import copy
import dataclasses
import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Self

import jax
import jax.numpy as jnp

from mqe_jax.core import devices
from mqe_jax.core.errors import InputError
from mqe_jax.core.limits import Environments, PositiveInt
from mqe_jax.core.memory import bytes_of, check_memory
from mqe_jax.core.precision import single
from mqe_jax.core.settings import checked, fail
from mqe_jax.core.types import RandomKey
from mqe_jax.envs.base import QuadrupedEnv
from mqe_jax.envs.state import FINAL, State, with_final
from mqe_jax.sensors.suite import ONBOARD

SEEN = ("groups", "privileged_obs")
"""Fields of observations, which describe the state after a reset."""

KEPT = (
    "assistance",
    "reward",
    "terminated",
    "truncated",
    "outcome",
    "metrics",
    "final_groups",
    "final_privileged_obs",
)
"""Fields that an auto-reset keeps; all but the first describe the last step."""

_SMALL = 4096
"""Number of environments whose memory is not checked, which saves a trace."""

Start = Callable[[jax.Array, jax.Array], State]
"""Returns an initial state from a random key and the assistance, as `QuadrupedEnv.begin`."""


def autoreset(
    env: QuadrupedEnv,
    state: State,
    start: Start | None = None,
    groups: Sequence[str] = (),
    *,
    observed: bool = True,
) -> State:
    """Replaces the state of one environment by a new one if its episode has ended.

    Resets the whole state, without a forward pass, and observes the new one. The fields in `KEPT`
    still describe the step that ended the episode, and `assistance` is kept. `start` samples the
    new state, by default the task's reset. `groups` are observed in addition to the group `policy`.

    The observations of an episode that goes on stay. If the step is not `observed`, they are made
    here, with the same noise.
    """
    done = state.terminated | state.truncated
    with jax.named_scope("reset"):
        key, reset_key = jax.random.split(state.key)
        begin = start or env.begin
        fresh = begin(reset_key, state.assistance)
        if observed:
            fresh = env.with_observations(dataclasses.replace(fresh, key=key), groups)
        left_out = ("data", "key", *KEPT) if observed else ("data", "key", *SEEN, *KEPT)

        def choose(new: jax.Array, old: jax.Array) -> jax.Array:
            return jnp.where(done, new, old)

        merged = {}
        for field in dataclasses.fields(state):
            name = field.name
            if name not in left_out:
                merged[name] = jax.tree.map(choose, getattr(fresh, name), getattr(state, name))
        data = env.physics.merge(done, fresh.data, state.data)
        noise_key = choose(key, state.key)
    state = dataclasses.replace(state, data=data, key=noise_key, **merged)
    if not observed:
        state = env.with_observations(state, groups)
    return dataclasses.replace(state, key=key)


class EnvBatch:
    """Base of all batches of environments of a task."""

    env: QuadrupedEnv
    num_envs: int  # N
    num_agents: int  # A, of each
    teams: tuple[tuple[int, ...], ...]
    action_size: int
    max_episode_steps: int
    group_sizes: Mapping[str, int]  # of the agents' observations

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {self.num_envs}: {getattr(self, 'inner', self.env)!r}>"

    def check_step(self, state: Any, action: jax.Array, kind: type) -> None:
        """Raises an InputError unless `state` is a `kind` of N environments and `action` fits.

        Actions are (N, A, action_size).
        """
        steps = jnp.shape(state.step) if isinstance(state, kind) else ()
        if steps != (self.num_envs,):
            found = f"{type(state).__name__} {steps}".removesuffix(" ()")
            raise InputError(
                f"state: {found} is not allowed; it must be the {kind.__name__} of "
                f"{self.num_envs} environments that "
                f"`reset` of this {type(self).__name__} returns; it steps all of them, without "
                "jax.vmap"
            )
        shape = (self.num_envs, self.num_agents, self.action_size)
        if getattr(action, "shape", None) != shape:
            given = getattr(action, "shape", type(action).__name__)
            raise InputError(
                f"action: shape {given}; expected {shape} (environments, agents, action size)"
            )


class VectorEnv(EnvBatch):
    """A batch of environments with automatic reset, as used for training and evaluation.

    Example:
        ```python
        batch = mqe_jax.VectorEnv(mqe_jax.make("go1gate"), 64)
        state = jax.jit(batch.reset)(jax.random.PRNGKey(0))
        print(state.obs.shape)  # (64, 2, 16)
        ```
    """

    groups: tuple[str, ...] = ("policy",)
    """Groups that are observed, `policy` among them."""

    @checked
    def __init__(
        self,
        env: QuadrupedEnv,
        num_envs: Environments,
        copies: PositiveInt = 1,
        *,
        final: Sequence[str] = FINAL,
    ) -> None:
        """Creates the batch.

        `copies` is the number of batches under an outer `vmap`, such as one per seed; buffers are
        sized for all. `final` says which observations a step also returns as they were before any
        reset: `obs`, those of all groups, and `privileged_obs`. A critic needs those that it
        reads, and each takes time.
        """
        if not isinstance(env, QuadrupedEnv):
            fail("env", env, "the environment of a task, such as mqe_jax.make('go1gate')")
        self.env = env.with_num_envs(num_envs * copies)
        self.num_envs = num_envs
        self.copies = copies
        self.final = tuple(final)
        if not {*final} <= {*FINAL}:
            fail("final", final, f"some of {', '.join(FINAL)}")
        if num_envs * copies > _SMALL:
            state = jax.eval_shape(functools.partial(VectorEnv.reset, self), jax.random.PRNGKey(0))
            share = num_envs * copies // jax.process_count()
            needed = copies * bytes_of(state) / jax.process_count()
            needed += self.env.physics.own_bytes(share)
            check_memory("num_envs", num_envs * copies, needed)
        self.name = env.name
        self.max_episode_steps = env.max_steps
        self.num_agents = env.num_agents
        self.teams = env.teams
        self.observation_size = env.observation_size
        self.privileged_observation_size = env.privileged_observation_size
        self.action_size = env.action_size
        self.group_sizes = env.group_sizes

    def with_groups(self, names: Iterable[str]) -> Self:
        """Returns the batch that also observes further groups.

        InputError for a group that the task does not have.
        """
        wanted = {"policy", *names}
        for name in sorted(wanted.difference(self.group_sizes)):
            hint = f"; the task parameter senses adds {ONBOARD}" if name == ONBOARD else ""
            fail("group", name, f"one of {self.name}: {', '.join(self.group_sizes)}{hint}")
        other = copy.copy(self)
        other.groups = tuple(name for name in self.group_sizes if name in wanted)
        return other

    @checked
    def reset(self, key: RandomKey) -> State:
        """Returns N initial states; every leaf has a leading axis N."""
        keys = devices.rows(lambda n: jax.random.split(key, n), self.num_envs)
        return jax.vmap(self._reset)(keys)

    @checked
    def share(self, parts: PositiveInt) -> Self:
        """Returns the batch of one of several processes.

        InputError if the environments do not divide evenly.
        """
        other = copy.copy(self)
        other.num_envs = devices.share("num_envs", self.num_envs, parts)
        other.env = self.env.with_num_envs(other.num_envs * self.copies)
        return other

    def step(self, state: State, action: jax.Array) -> State:
        """Advances all environments by one step with actions (N, A, action_size).

        Environments whose episode ended are reset.
        """
        self.check_step(state, action, State)
        return jax.vmap(self._step)(state, action)

    @single
    def _reset(self, key: jax.Array) -> State:
        state = self.env.with_observations(self.env.begin(key), self.groups)
        return with_final(state, self.final)

    @single
    def _step(self, state: State, action: jax.Array, start: Start | None = None) -> State:
        """Advances one environment, and resets it to `start` if its episode ended (`autoreset`)."""
        state = self.env.advance(state, action)
        if self.final:
            state = with_final(self.env.with_observations(state, self.groups), self.final)
        return autoreset(self.env, state, start, self.groups, observed=bool(self.final))
