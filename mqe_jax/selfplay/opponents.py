"""A match as an environment of one team: against opponents (`versus`), or with both teams learning
(`Mirror`).
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

import jax
import jax.numpy as jnp

from mqe_jax.acting.seats import Policy, check_policy
from mqe_jax.core import devices
from mqe_jax.core.errors import InputError
from mqe_jax.core.limits import NonNegativeInt, Number
from mqe_jax.core.precision import single
from mqe_jax.core.settings import check, check_arguments, fail
from mqe_jax.core.types import (
    AnyBatch,
    AnyPolicy,
    Memory,
    Observations,
    PyTree,
    RandomKey,
    check_act,
    observations,
    where_rows,
)
from mqe_jax.envs import VectorEnv
from mqe_jax.envs.state import EnvironmentState
from mqe_jax.envs.wrappers import Outer, Wrapper
from mqe_jax.policies import load_as
from mqe_jax.train.policy import TrainedPolicy


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class OpponentState:
    """The opponent of a block of B environments."""

    arrays: PyTree  # arrays of the opponent; empty if it cannot change
    before: PyTree  # arrays of the opponent before the last change
    # environments whose episode is still against the opponent before the change (B,) bool
    waiting: jax.Array
    memory: Memory  # recurrent state, leading axis B
    # episodes that team 0 won, drew and lost against it (3,) int32, in the order of `RESULTS`
    outcomes: jax.Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TeamState(EnvironmentState):
    """State of M environments of one team of T agents, in N matches of A agents; metrics are those
    of team 0.

    `step[::M // N]` and `assistance[::M // N]` hold one entry per match; `key` is for the
    opponents' actions.
    """

    match: EnvironmentState  # state of the matches, leading axis N
    action: jax.Array  # actions of all agents in the last step (N, A, D)
    opponents: tuple[OpponentState, ...]  # the opponent of each block of environments


class OneTeam(Outer):
    """What `Versus` and `Mirror` share: M environments of the only team, around matches."""

    def __init__(self, matches: VectorEnv | Wrapper, num_envs: int) -> None:
        if len(check("env", matches, AnyBatch).teams) != 2:
            raise InputError(f"env: {matches.name} is not a match; it has one team")
        super().__init__(matches)
        self.num_envs = num_envs
        self.num_agents = len(matches.teams[0])
        self.teams = (tuple(range(self.num_agents)),)

    def _step_matches(self, state: TeamState, action: jax.Array) -> EnvironmentState:
        """Advances the matches by a step with the actions of all agents (N, A, D)."""
        every = self.num_envs // self.inner.num_envs
        match = dataclasses.replace(
            state.match, step=state.step[::every], assistance=state.assistance[::every]
        )
        return self.inner.step(match, action)

    def _state(
        self, match: EnvironmentState, of_agents: Any, of_match: Any, **own: Any
    ) -> TeamState:
        """Returns the state of the environments: fields of agents (N, A, ...) and others (N, ...)
        mapped, or `own`.
        """
        agents = ("groups", "final_groups", "reward", "active")
        others = (
            "privileged_obs",
            "final_privileged_obs",
            "terminated",
            "truncated",
            "step",
            "assistance",
        )
        others += ("metrics", "outcome")
        metrics = {name: x for name, x in match.metrics.items() if not name.startswith("team1/")}
        team0 = dataclasses.replace(
            match, metrics=metrics, outcome=match.outcome.by_team(lambda x: x[:, :1])
        )
        fields = {name: jax.tree.map(of_agents, getattr(match, name)) for name in agents}
        fields |= {name: jax.tree.map(of_match, getattr(team0, name)) for name in others}
        return TeamState(**{**fields, "match": match, **own})


class Versus(OneTeam):
    """N matches as N environments of team 0, in K equal blocks with one opponent each; see
    `versus`.

    Every Kth environment belongs to a block, so that any consecutive K of them meet all opponents.
    """

    @check_arguments(matches=AnyBatch, opponents=Sequence[AnyPolicy], draw_reward=Number)
    def __init__(
        self, matches: VectorEnv | Wrapper, opponents: Sequence[Policy], draw_reward: float = 0.0
    ) -> None:
        super().__init__(matches, matches.num_envs)
        self.draw_reward = draw_reward
        for policy in opponents:
            check_policy(policy, matches, "an opponent")
        self.opponents = tuple(opponents)  # of the blocks at the start
        self._check_blocks(self.num_envs)

    def __repr__(self) -> str:
        return (
            f"<{type(self).__name__} of {self.num_envs} against {list(self.opponents)}: "
            f"{self.inner!r}>"
        )

    def share(self, parts: int) -> Self:
        """Returns the environments of one of several processes; each process meets all
        opponents.
        """
        self._check_blocks(self.num_envs // parts)
        return super().share(parts)

    def _check_blocks(self, num_envs: int) -> None:
        if not self.opponents or num_envs % len(self.opponents):
            fail(
                "opponents",
                len(self.opponents),
                f"a divisor of the environments of a process, {num_envs}",
            )

    @single
    @check_arguments(key=RandomKey)
    def reset(self, key: jax.Array) -> TeamState:
        """Returns the initial states of all environments, against the first opponents."""
        key, match_key = jax.random.split(key)
        match = self.inner.reset(match_key)
        opponents = []
        for policy in self.opponents:
            arrays = _arrays(policy)
            waiting = jnp.zeros((self._size,), bool)
            memory = policy.initial_memory(self._size)
            opponents.append(
                OpponentState(arrays, arrays, waiting, memory, jnp.zeros((3,), jnp.int32))
            )
        action = jnp.zeros((self.num_envs, self.inner.num_agents, self.action_size))
        return self._team_state(match, action, tuple(opponents), key)

    @single
    def step(self, state: TeamState, action: jax.Array) -> TeamState:
        """Advances all environments by one step with the actions of team 0 (N, T, D), else an
        InputError; resets.
        """
        self.check_step(state, action, TeamState)
        key, *keys = jax.random.split(state.key, 1 + len(self.opponents))
        others = []
        opponents = []
        for i, (policy, opponent) in enumerate(zip(self.opponents, state.opponents, strict=True)):
            block = jax.tree.map(lambda x: x[self._block(i)], observations(state.match))  # noqa: B023
            shape = (self._size, self.num_agents, self.action_size)
            returned = _act(policy, opponent, block.of(slice(self.num_agents, None)), keys[i])
            other, memory = check_act("opponents", returned, shape, opponent.memory)
            others.append(jnp.asarray(other, jnp.float32))
            opponents.append(dataclasses.replace(opponent, memory=memory))
        theirs = jnp.stack(others, axis=1).reshape(self.num_envs, *others[0].shape[1:])
        both = jnp.concatenate([jnp.asarray(action, jnp.float32), theirs], axis=1)
        match = self._step_matches(state, both)
        done = match.terminated | match.truncated
        ended = done[:, None] & (match.outcome.result[:, 0] > 0)
        match = dataclasses.replace(
            match, reward=match.reward + self.draw_reward * ended[:, 1:2].astype(jnp.float32)
        )
        started = tuple(
            self._restart(i, opponent, done, ended) for i, opponent in enumerate(opponents)
        )
        return self._team_state(match, both, started, key)

    @check_arguments(state=TeamState, block=NonNegativeInt, policy=TrainedPolicy, at_once=bool)
    def change(
        self, state: TeamState, block: int, policy: TrainedPolicy, *, at_once: bool = False
    ) -> TeamState:
        """Returns the state with another opponent in a block, a trained policy of the same
        form.

        Each environment keeps its opponent until its episode ends, unless `at_once`. Another change
        before that replaces only the waiting opponent, also in environments in which it already
        plays.
        """
        if not block < len(self.opponents):
            fail("block", block, f"below {len(self.opponents)}, the number of blocks")
        check_policy(policy, self.inner)
        first = self.opponents[block]
        opponent = state.opponents[block]
        if not isinstance(first, TrainedPolicy):
            raise InputError(
                f"block: the opponent of block {block} is fixed; only trained policies can be "
                "exchanged"
            )
        given = policy.form.by_name()
        known = first.form.by_name()
        for name in dict.fromkeys((*given, *known)):
            if given.get(name) != known.get(name):
                other = f"{name} {given.get(name)!r}, not {known.get(name)!r}"
                raise InputError(f"policy: of another form than block {block}: {other}")
        alike = dataclasses.replace(policy.actor, form=first.form)
        changed = exchange(opponent, alike, at_once=at_once)
        return dataclasses.replace(
            state, opponents=(*state.opponents[:block], changed, *state.opponents[block + 1 :])
        )

    @property
    def _size(self) -> int:
        return self.num_envs // len(self.opponents)

    def _block(self, index: int) -> slice:
        return slice(index, None, len(self.opponents))

    def _restart(
        self, index: int, opponent: OpponentState, done: jax.Array, ended: jax.Array
    ) -> OpponentState:
        """Counts the outcomes `ended` (N, 3); resets the recurrent state, and ends the waiting, of
        ended episodes.
        """
        done = done[self._block(index)]
        ended = ended[self._block(index)]
        first = self.opponents[index].initial_memory(self._size)
        memory = where_rows(done, first, opponent.memory)
        outcomes = opponent.outcomes + jnp.sum(
            ended & ~opponent.waiting[:, None], axis=0, dtype=jnp.int32
        )
        return dataclasses.replace(
            opponent, memory=memory, waiting=opponent.waiting & ~done, outcomes=outcomes
        )

    def _team_state(
        self,
        match: EnvironmentState,
        action: jax.Array,
        opponents: tuple[OpponentState, ...],
        key: jax.Array,
    ) -> TeamState:
        """Returns the state of team 0."""

        def cut(x):
            return x[:, : self.num_agents]

        return self._state(match, cut, lambda x: x, action=action, opponents=opponents, key=key)


@check_arguments(env=AnyBatch, draw_reward=Number)
def versus(
    env: VectorEnv | Wrapper,
    opponents: Policy | str | Path | Sequence[Policy | str | Path],
    *,
    draw_reward: float = 0.0,
) -> Versus:
    """Returns matches as environments of team 0, against opponents that control team 1.

    Opponents are policies or what `load_policy` accepts; equally many environments meet each of
    them. Trained policies act as they are loaded (sampled, unless deterministic) and can be
    exchanged (`Versus.change`). A draw adds `draw_reward`. InputError for a task that is not a
    match, and for a policy of another task.

    Example:
        ```python
        batch = mqe_jax.VectorEnv(mqe_jax.make("go1tug"), 8)
        matches = mqe_jax.versus(batch, ["scripted", "idle"])  # four against each
        print(matches.num_agents)  # 1
        ```
    """
    alone = isinstance(opponents, str | Path) or hasattr(opponents, "initial_memory")
    given: Any = [opponents] if alone else opponents
    if not isinstance(given, Sequence):
        fail("opponents", given, "a policy, or a list of policies")
    return Versus(env, [load_as("opponents", each, env.env) for each in given], draw_reward)


class Mirror(OneTeam):
    """N matches as 2 N environments of one team, two in a row per match: one policy learns as both
    teams.

    The privileged observation has one more number, the index of the team. Outcome and metrics are
    those of team 0; `diverged` and `overflow` are counted for the first.
    """

    def __init__(self, matches: VectorEnv) -> None:
        super().__init__(matches, 2 * check("env", matches, AnyBatch).num_envs)
        self.privileged_observation_size += 1

    @single
    def reset(self, key: jax.Array) -> TeamState:
        """Returns the initial states of all environments."""
        action = jnp.zeros((self.inner.num_envs, self.inner.num_agents, self.action_size))
        return self._team_state(self.inner.reset(key), action)

    @single
    def step(self, state: TeamState, action: jax.Array) -> TeamState:
        """Advances all environments by one step with actions (2 N, T, D), else an InputError;
        resets.
        """
        self.check_step(state, action, TeamState)
        both = action.reshape(self.inner.num_envs, 2 * self.num_agents, self.action_size)
        return self._team_state(self._step_matches(state, both), both)

    def _team_state(self, match: EnvironmentState, action: jax.Array) -> TeamState:
        def teams(x: jax.Array) -> jax.Array:
            return x.reshape(self.num_envs, self.num_agents, *x.shape[2:])

        def twice(x: jax.Array) -> jax.Array:
            return jnp.repeat(x, 2, axis=0)

        def privileged(x: jax.Array) -> jax.Array:
            return jnp.concatenate([twice(x), jnp.tile(jnp.arange(2.0), len(x))[:, None]], axis=1)

        names = "privileged_obs", "final_privileged_obs"
        own = {name: jax.tree.map(privileged, getattr(match, name)) for name in names}
        state = self._state(
            match, teams, twice, action=action, opponents=(), key=jnp.zeros((2,), jnp.uint32), **own
        )
        first = jnp.arange(self.num_envs) % 2 == 0
        once = {
            name: jnp.where(first, state.metrics[name], 0.0) for name in ("diverged", "overflow")
        }
        return dataclasses.replace(state, metrics=state.metrics | once)


def exchange(opponent: OpponentState, arrays: PyTree, *, at_once: bool = False) -> OpponentState:
    """Returns the opponent of a block with other arrays; see `Versus.change`."""
    if at_once:
        return dataclasses.replace(
            opponent, arrays=arrays, before=arrays, waiting=jnp.zeros_like(opponent.waiting)
        )
    pending = devices.any_of(jnp.any(opponent.waiting))
    before = jax.tree.map(
        lambda old, new: jnp.where(pending, old, new), opponent.before, opponent.arrays
    )
    waiting = jnp.where(pending, opponent.waiting, True)
    return dataclasses.replace(opponent, arrays=arrays, before=before, waiting=waiting)


def _arrays(policy: Policy) -> PyTree:
    """Returns the arrays in which a trained policy can change; none of others."""
    return jax.tree.map(jnp.asarray, policy.actor) if isinstance(policy, TrainedPolicy) else ()


def _act(
    policy: Policy, opponent: OpponentState, obs: Observations, key: jax.Array
) -> tuple[jax.Array, Any]:
    """Returns the actions of a block's opponent (B, T, D) and its next recurrent state."""
    if not isinstance(policy, TrainedPolicy):
        return policy.act(obs.to(policy), opponent.memory, key)

    def now() -> tuple[jax.Array, Any]:
        return opponent.arrays.act(obs, opponent.memory, key)

    def either() -> tuple[jax.Array, Any]:
        before = opponent.before.act(obs, opponent.memory, key)
        return where_rows(opponent.waiting, before, now())

    return jax.lax.cond(jnp.any(opponent.waiting), either, now)
