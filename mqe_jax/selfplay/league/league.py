"""A match against a pool of the learner's earlier policies.

The learner state keeps the pool between updates.

Source: prioritised fictitious self-play (AlphaStar, doi 10.1038/s41586-019-1724-z).
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.acting.seats import Policy
from mqe_jax.core import devices, keys
from mqe_jax.core.precision import single
from mqe_jax.core.settings import FrozenMapping, fail
from mqe_jax.core.types import RESULTS
from mqe_jax.envs import VectorEnv
from mqe_jax.envs.wrappers import Wrapper
from mqe_jax.selfplay.league import pool
from mqe_jax.selfplay.league.pool import Pool
from mqe_jax.selfplay.opponents import Versus, exchange
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.learner import TrainState
from mqe_jax.train.needs import needs_of
from mqe_jax.train.networks import Network
from mqe_jax.train.normalize import running_init
from mqe_jax.train.policy import Actor, TrainedPolicy

_FADE = 0.95  # of the counts behind the metrics, per update
_SWING = 30.0  # Elo points per update, at most; one per game beyond what was expected


class LeagueState(NamedTuple):
    """The league's part of the learner state; K blocks of environments."""

    pool: Pool  # earlier policies
    # member that each block plays (K,) int32; without meaning for blocks that play no member
    member: jax.Array
    played: jax.Array  # episodes of each block against it (K,) int32
    rating: jax.Array  # the learner's rating (), Elo points; the scripted policy has 0
    snapshot: jax.Array  # update of the last snapshot () int32
    recent: jax.Array  # recent wins, draws and losses of each block (K, 3)
    key: jax.Array  # random key


POOL = ("newest", "older", "uniform")
"""Opponents that a training makes itself: the policy, and members of its pool of earlier ones. All
others are fixed: they exist outside of the training too, and play in its evaluations."""


class Roster:
    """What the names in `TrainConfig.opponents` mean, one for each of K blocks of environments."""

    def __init__(self, names: Sequence[str]) -> None:
        def is_one_of(*kinds):
            return np.array([name in kinds for name in names], bool)

        self.names = tuple(names)
        self.newest = is_one_of("newest")
        """Blocks that play the policy itself (K,) bool."""
        self.uniform = is_one_of("uniform")
        """Blocks that draw any member of the pool with equal chance (K,) bool."""
        self.members = self.uniform | is_one_of("older")
        """Blocks that play members of the pool (K,) bool."""
        self.reference = is_one_of("scripted")
        """Blocks whose opponent has the rating 0 (K,) bool."""


class League:
    """Matches against fixed opponents, the newest policy and members of a pool; a `Matchmaker`."""

    @single
    def __init__(
        self,
        matches: VectorEnv | Wrapper,
        config: TrainConfig,
        policies: Mapping[str, Policy] = FrozenMapping(),
    ) -> None:
        """Creates the matches of a training run; `policies` has its fixed opponents by name."""
        self._roster = Roster(config.opponents)
        needs = needs_of(matches, config)
        self._dims = needs.dims
        self._config = config
        drawn = int(self._roster.members.sum())
        if drawn and config.league.members <= drawn:
            fail(
                "league.members",
                config.league.members,
                f"more than the blocks that play members, {drawn}",
            )
        params = self._network.policy_params(self._network.init(jax.random.PRNGKey(0)))
        statistics = running_init(needs.dims.observation, config.network.features(needs.dims))
        first = TrainedPolicy(params, statistics, needs, config, {})
        self._form = first.form

        opponents = [first if name in POOL else policies[name] for name in config.opponents]
        self.env = Versus(matches, opponents, config.draw_reward)
        self._members = config.league.members if drawn else 1

    def begin(self, state: TrainState) -> LeagueState:
        """Returns the first state: the initial policy is the only member."""
        blocks = len(self._roster.names)
        return LeagueState(
            pool=pool.new_pool(self._own(state), self._members),
            member=jnp.zeros((blocks,), jnp.int32),
            played=jnp.zeros((blocks,), jnp.int32),
            rating=jnp.zeros(()),
            snapshot=jnp.zeros((), jnp.int32),
            recent=jnp.zeros((blocks, 3)),
            key=jax.random.fold_in(state.key, keys.LEAGUE),
        )

    def seat(self, state: TrainState) -> TrainState:
        """Returns the state with the league's opponents in its new environments.

        They are the policy itself and members of the pool.
        """
        opponents = list(state.rollout.env_state.opponents)
        for i, opponent in enumerate(opponents):
            if self._roster.newest[i] or self._roster.members[i]:
                arrays = (
                    self._own(state) if self._roster.newest[i] else self._member(state.extra, i)
                )
                opponents[i] = dataclasses.replace(opponent, arrays=arrays, before=arrays)
        return _with_opponents(state, opponents)

    def after(self, state: TrainState) -> tuple[TrainState, dict[str, jax.Array]]:
        """Records the results of an update and gives the blocks their next opponents.

        It takes a snapshot of the policy when one is due. Returns the state and the league's
        metrics.
        """
        opponents = list(state.rollout.env_state.opponents)
        own = self._own(state)
        league = self._record(state.extra, opponents)
        league = self._snapshot(league, own, state.updates)
        league, changed = self._draw(league, opponents)
        for i, opponent in enumerate(opponents):
            if self._roster.newest[i]:
                opponent = exchange(opponent, own, at_once=True)
            elif self._roster.members[i]:
                other = exchange(opponent, self._member(league, i))
                opponent = jax.tree.map(lambda a, b: jnp.where(changed[i], a, b), other, opponent)  # noqa: B023
            opponents[i] = dataclasses.replace(opponent, outcomes=jnp.zeros_like(opponent.outcomes))
        return dataclasses.replace(_with_opponents(state, opponents), extra=league), self._metrics(
            league
        )

    def _member(self, league: LeagueState, block: int) -> Actor:
        """Returns the member that a block plays."""
        return jax.tree.map(lambda x: x[league.member[block]], league.pool.arrays)

    @property
    def _network(self) -> Network:
        return self._config.network.build(self._dims)  # whose functions cannot be pickled

    def _own(self, state: TrainState) -> Actor:
        """Returns the learner's policy."""
        scale = jnp.float32(self._config.action_scale)
        params = self._network.policy_params(state.params)
        return Actor(params, state.obs_normalizer.obs, scale, self._form)

    def _record(self, league: LeagueState, opponents: Sequence[Any]) -> LeagueState:
        counts = devices.total(jnp.stack([opponent.outcomes for opponent in opponents])).astype(
            jnp.float32
        )
        games = jnp.sum(counts, axis=1)
        score = counts[:, 0] + 0.5 * counts[:, 1]
        plays_member = self._roster.members
        reference = self._roster.reference
        members = jnp.where(plays_member, games, 0.0)
        rated = jnp.where(plays_member | reference, games, 0.0)
        theirs = jnp.where(reference, 0.0, league.pool.rating[league.member])
        expected = 1.0 / (1.0 + 10.0 ** ((theirs - league.rating) / 400.0))
        gain = jnp.sum(jnp.where(rated > 0, score - games * expected, 0.0))
        return league._replace(
            pool=pool.record_result(
                league.pool, league.member, jnp.where(plays_member, score, 0.0), members
            ),
            played=league.played + games.astype(jnp.int32),
            rating=league.rating + jnp.clip(gain, -_SWING, _SWING),
            recent=_FADE * league.recent + counts,
        )

    def _snapshot(self, league: LeagueState, own: Actor, updates: jax.Array) -> LeagueState:
        settings = self._config.league
        every = -(-settings.snapshot_steps // self._config.steps_per_update)
        since = updates - league.snapshot
        early = (since >= -(-every // 4)) & (
            pool.mean_win_rate(league.pool) >= settings.snapshot_win_rate
        )
        due = (since >= every) | early
        busy = jnp.any(
            (jnp.arange(self._members) == league.member[:, None]) & self._roster.members[:, None],
            axis=0,
        )
        grown = pool.add(league.pool, own, updates, league.rating, busy)
        return league._replace(
            pool=jax.tree.map(lambda new, old: jnp.where(due, new, old), grown, league.pool),
            snapshot=jnp.where(due, updates, league.snapshot),
        )

    def _draw(self, league: LeagueState, opponents: Sequence[Any]) -> tuple[LeagueState, jax.Array]:
        """Draws another member for blocks that have played enough; returns which did (K,) bool."""
        waiting = jnp.stack([devices.any_of(jnp.any(opponent.waiting)) for opponent in opponents])
        enough = self._roster.members & (league.played >= self._config.league.episodes) & ~waiting
        key, *keys = jax.random.split(league.key, 1 + len(opponents))
        drawn = [
            jax.random.categorical(k, pool.chances(league.pool, uniform))
            for k, uniform in zip(keys, self._roster.uniform, strict=True)
        ]
        member = jnp.where(enough, jnp.stack(drawn).astype(jnp.int32), league.member)
        return league._replace(
            member=member, played=jnp.where(enough, 0, league.played), key=key
        ), jnp.asarray(enough)

    def _metrics(self, league: LeagueState) -> dict[str, jax.Array]:
        metrics = {
            "league/rating": league.rating,
            "league/members": jnp.sum(league.pool.born >= 0),
            "league/win_rate": pool.mean_win_rate(league.pool),
        }
        names = np.array(self._roster.names)
        for name in dict.fromkeys(self._roster.names):
            recent = jnp.sum(league.recent[names == name], axis=0)
            for i, outcome in enumerate(RESULTS):
                metrics[f"league/{outcome}/{name}"] = recent[i] / jnp.maximum(jnp.sum(recent), 1.0)
        return metrics


def _with_opponents(state: TrainState, opponents: Sequence[Any]) -> TrainState:
    """Returns the state whose environments have these opponents."""
    env_state = dataclasses.replace(state.rollout.env_state, opponents=tuple(opponents))
    return dataclasses.replace(state, rollout=state.rollout._replace(env_state=env_state))
