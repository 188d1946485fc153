"""A match as an environment of one team.

The team plays against opponents (`Versus`), or both teams learn (`Mirror`).
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, Self

import jax
import jax.numpy as jnp

from mqe_jax.acting.seats import Fixed, Policy, Seat, Seats, actor_of, check_policy
from mqe_jax.core import devices
from mqe_jax.core.errors import InputError
from mqe_jax.core.limits import NonNegativeInt
from mqe_jax.core.precision import single
from mqe_jax.core.settings import checked, fail
from mqe_jax.core.types import (
    Memory,
    Observations,
    RandomKey,
    observations,
    where_rows,
)
from mqe_jax.envs import VectorEnv
from mqe_jax.envs.match import OF_AGENTS, team_view
from mqe_jax.envs.state import EnvironmentState
from mqe_jax.envs.wrappers import Outer, Wrapper
from mqe_jax.train.policy import TrainedPolicy

_OF_MATCH = (
    "privileged_obs",
    "final_privileged_obs",
    "terminated",
    "truncated",
    "step",
    "assistance",
)
"""Fields of a match's state that both teams share."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class OpponentState:
    """The opponent of a block of B environments; if it can change, it acts in the block's seat."""

    arrays: Any  # the opponent, an `Actor`; empty if it cannot change
    before: Any  # the opponent before the last change
    # environments whose episode is still against the opponent before the change (B,) bool
    waiting: jax.Array
    memory: Memory  # recurrent state, leading axis B
    # episodes that team 0 won, drew and lost against it (3,) int32, in the order of `RESULTS`
    outcomes: jax.Array

    @property
    def groups(self) -> tuple[str, ...]:
        """The groups of observations that it sees."""
        return self.arrays.groups

    def initial_memory(self, num_envs: int) -> Memory:
        """Returns the recurrent state at an episode's start, leading axis N."""
        return self.arrays.initial_memory(num_envs)

    def act(self, seen: Observations, memory: Memory, key: jax.Array) -> tuple[jax.Array, Memory]:
        """Returns the actions (B, T, D) and the next recurrent state."""

        def now() -> tuple[jax.Array, Memory]:
            return self.arrays.act(seen, memory, key)

        def either() -> tuple[jax.Array, Memory]:
            before = self.before.act(seen, memory, key)
            return where_rows(self.waiting, before, now())

        return jax.lax.cond(jnp.any(self.waiting), either, now)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TeamState(EnvironmentState):
    """State of M environments of one team of T agents, in N matches of A agents.

    Metrics are those of team 0. `step[::M // N]` and `assistance[::M // N]` hold one entry per
    match. `key` is for the opponents' actions.
    """

    match: EnvironmentState  # state of the matches, leading axis N
    action: jax.Array  # actions of all agents in the last step (N, A, D)
    opponents: tuple[OpponentState, ...]  # the opponent of each block of environments


class OneTeam(Outer):
    """What `Versus` and `Mirror` share: M environments of the only team, around matches."""

    def __init__(self, matches: VectorEnv | Wrapper, num_envs: int) -> None:
        if len(matches.teams) != 2:
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


class Versus(OneTeam):
    """N matches as N environments of team 0, in K equal blocks with one opponent each.

    Every Kth environment belongs to a block, so that any consecutive K of them meet all opponents.
    See `mqe_jax.versus`.
    """

    def __init__(
        self, matches: VectorEnv | Wrapper, opponents: Sequence[Policy], draw_reward: float = 0.0
    ) -> None:
        super().__init__(matches, matches.num_envs)
        self.draw_reward = draw_reward
        for policy in opponents:
            check_policy(policy, matches, "an opponent")
        team = self.inner.teams[1]
        self.seats = Seats(
            tuple(
                Seat(actor_of(policy), team, team, (block, len(opponents)))
                for block, policy in enumerate(opponents)
            )
        )
        """The opponents of the blocks at the start."""
        self._check_blocks(self.num_envs)

    def __repr__(self) -> str:
        opponents = [seat.policy for seat in self.seats.seats]
        return f"<{type(self).__name__} of {self.num_envs} against {opponents}: {self.inner!r}>"

    def share(self, parts: int) -> Self:
        """Returns the environments of one of several processes.

        Each process meets all opponents.
        """
        self._check_blocks(self.num_envs // parts)
        return super().share(parts)

    def _check_blocks(self, num_envs: int) -> None:
        blocks = len(self.seats.seats)
        if not blocks or num_envs % blocks:
            raise InputError(
                f"opponents: {num_envs} environments of a process do not divide among {blocks} "
                "opponents"
            )

    @single
    @checked
    def reset(self, key: RandomKey) -> TeamState:
        """Returns the initial states of all environments, against the first opponents."""
        key, match_key = jax.random.split(key)
        match = self.inner.reset(match_key)
        opponents = []
        memories = self.seats.initial_memory(self.num_envs)
        for seat, memory in zip(self.seats.seats, memories, strict=True):
            fixed = isinstance(seat.policy, Fixed)
            policy = () if fixed else jax.tree.map(jnp.asarray, seat.policy)
            waiting = jnp.zeros((self.num_envs // len(memories),), bool)
            outcomes = jnp.zeros((3,), jnp.int32)
            opponents.append(OpponentState(policy, policy, waiting, memory, outcomes))
        action = jnp.zeros((self.num_envs, self.inner.num_agents, self.action_size))
        return self._team_state(match, action, tuple(opponents), key)

    @single
    def step(self, state: TeamState, action: jax.Array) -> TeamState:
        """Advances all environments by one step and resets those that ended.

        InputError unless the actions are those of team 0 (N, T, D).
        """
        self.check_step(state, action, TeamState)
        key, *keys = jax.random.split(state.key, 1 + len(state.opponents))
        seats = self._seats_of(state)
        action = jnp.asarray(action, jnp.float32)
        both = jnp.concatenate([action, jnp.zeros_like(action)], axis=1)
        memories = tuple(opponent.memory for opponent in state.opponents)
        both, memories = seats.act(observations(state.match), memories, tuple(keys), both)
        match = self._step_matches(state, both)
        done = match.terminated | match.truncated
        ended = done[:, None] & (match.outcome.result[:, 0] > 0)
        draw = self.draw_reward * ended[:, 1:2].astype(jnp.float32)
        match = dataclasses.replace(match, reward=match.reward + draw)
        opponents = []
        memories = seats.restart(memories, done)
        for seat, opponent, memory in zip(seats.seats, state.opponents, memories, strict=True):
            block = seat.rows(self.num_envs)
            counted = ended[block] & ~opponent.waiting[:, None]
            opponents.append(
                dataclasses.replace(
                    opponent,
                    memory=memory,
                    waiting=opponent.waiting & ~done[block],
                    outcomes=opponent.outcomes + jnp.sum(counted, axis=0, dtype=jnp.int32),
                )
            )
        return self._team_state(match, both, tuple(opponents), key)

    def _seats_of(self, state: TeamState) -> Seats:
        """Returns the seats in which the opponents of a state act."""
        seats = []
        for seat, opponent in zip(self.seats.seats, state.opponents, strict=True):
            fixed = isinstance(seat.policy, Fixed)
            seats.append(seat if fixed else dataclasses.replace(seat, policy=opponent))
        return Seats(tuple(seats))

    @checked
    def change(
        self,
        state: TeamState,
        block: NonNegativeInt,
        policy: TrainedPolicy,
        *,
        at_once: bool = False,
    ) -> TeamState:
        """Returns the state with another opponent in a block.

        The opponent is a trained policy of the same form. Each environment keeps its opponent until
        its episode ends, unless `at_once`. Another change before that replaces only the waiting
        opponent, also in environments in which it already plays.
        """
        if not block < len(state.opponents):
            fail("block", block, f"below {len(state.opponents)}, the number of blocks")
        check_policy(policy, self.inner)
        opponent = state.opponents[block]
        if isinstance(self.seats.seats[block].policy, Fixed):
            raise InputError(
                f"block: the opponent of block {block} is fixed; only trained policies can be "
                "exchanged"
            )
        given = policy.form.by_name()
        known = opponent.arrays.form.by_name()
        for name in dict.fromkeys((*given, *known)):
            if given.get(name) != known.get(name):
                other = f"{name} {given.get(name)!r}, not {known.get(name)!r}"
                raise InputError(f"policy: of another form than block {block}: {other}")
        alike = dataclasses.replace(policy.actor, form=opponent.arrays.form)
        changed = exchange(opponent, alike, at_once=at_once)
        return dataclasses.replace(
            state, opponents=(*state.opponents[:block], changed, *state.opponents[block + 1 :])
        )

    def _team_state(
        self,
        match: EnvironmentState,
        action: jax.Array,
        opponents: tuple[OpponentState, ...],
        key: jax.Array,
    ) -> TeamState:
        """Returns the state of team 0."""
        fields = {name: getattr(match, name) for name in _OF_MATCH}
        fields |= team_view(match, self.num_agents)
        return TeamState(**fields, match=match, action=action, opponents=opponents, key=key)


class Mirror(OneTeam):
    """N matches as 2 N environments of one team: one policy learns as both teams.

    The teams of a match are consecutive environments. The privileged observation has one more
    number, the index of the team. Outcome and metrics are those of team 0. `diverged` and
    `overflow` count for the first environment of a match.
    """

    def __init__(self, matches: VectorEnv) -> None:
        super().__init__(matches, 2 * matches.num_envs)
        self.privileged_observation_size += 1

    @single
    def reset(self, key: jax.Array) -> TeamState:
        """Returns the initial states of all environments."""
        action = jnp.zeros((self.inner.num_envs, self.inner.num_agents, self.action_size))
        return self._team_state(self.inner.reset(key), action)

    @single
    def step(self, state: TeamState, action: jax.Array) -> TeamState:
        """Advances all environments by one step and resets those that ended.

        InputError unless the actions are (2 N, T, D).
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

        team0 = team_view(match, self.num_agents)
        shared = {name: getattr(match, name) for name in _OF_MATCH}
        shared |= {name: team0[name] for name in ("outcome", "metrics")}
        fields = {name: jax.tree.map(twice, value) for name, value in shared.items()}
        for name in ("privileged_obs", "final_privileged_obs"):
            fields[name] = jax.tree.map(privileged, getattr(match, name))
        for name in OF_AGENTS:
            fields[name] = jax.tree.map(teams, getattr(match, name))
        first = jnp.arange(self.num_envs) % 2 == 0
        for name in ("diverged", "overflow"):
            fields["metrics"][name] = jnp.where(first, fields["metrics"][name], 0.0)
        key = jnp.zeros((2,), jnp.uint32)
        return TeamState(**fields, match=match, action=action, opponents=(), key=key)


def exchange(opponent: OpponentState, arrays: Any, *, at_once: bool = False) -> OpponentState:
    """Returns the state of a block with another opponent of the same form; see `Versus.change`."""
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
