"""A pool of earlier policies, as arrays.

It records how the learner fares against each, draws who plays next and replaces members.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from mqe_jax.core.types import PyTree

_DECAY = 0.98  # of earlier results, per update in which a member is met
_PRIOR = 4.0  # games, drawn, that a member starts with


class Pool(NamedTuple):
    """M places for members; B stands for blocks of environments."""

    arrays: PyTree  # the members' arrays, leading axis M
    born: jax.Array  # update after which each became a member (M,) int32; -1 if the place is free
    score: jax.Array  # the learner's wins, and half of its draws, against each (M,)
    games: jax.Array  # games against each (M,)
    rating: jax.Array  # rating of each when it became a member (M,), Elo points


def new_pool(arrays: PyTree, members: int) -> Pool:
    """Returns a pool of M places with one member, which has these arrays."""
    spread = jax.tree.map(lambda x: jnp.broadcast_to(x, (members, *jnp.shape(x))), arrays)
    zeros = jnp.zeros((members,))
    return Pool(spread, jnp.full((members,), -1, jnp.int32).at[0].set(0), zeros, zeros, zeros)


def win_rate(pool: Pool) -> jax.Array:
    """Returns the learner's win rate against each place's member (M,); a draw counts half."""
    return (pool.score + 0.5 * _PRIOR) / (pool.games + _PRIOR)


def mean_win_rate(pool: Pool) -> jax.Array:
    """Returns the mean win rate over the members ()."""
    present = pool.born >= 0
    return jnp.sum(jnp.where(present, win_rate(pool), 0.0)) / jnp.sum(present.astype(jnp.float32))


def record_result(pool: Pool, member: jax.Array, score: jax.Array, games: jax.Array) -> Pool:
    """Returns the pool with the results of B blocks against their members.

    Indices of the members are (B,), scores (wins plus half of the draws) (B,), games (B,).
    """
    met = jnp.zeros_like(pool.games).at[member].add(games) > 0
    fade = jnp.where(met, _DECAY, 1.0)
    return pool._replace(
        score=(pool.score * fade).at[member].add(score),
        games=(pool.games * fade).at[member].add(games),
    )


def chances(pool: Pool, uniform: bool) -> jax.Array:
    """Returns the unnormalised log-probabilities (M,) of playing each member.

    They are equal if `uniform`, else those of weights (1 - win rate)^2.
    """
    weight = jnp.ones_like(pool.games) if uniform else jnp.square(1.0 - win_rate(pool)) + 1e-4
    return jnp.where(pool.born >= 0, jnp.log(weight), -jnp.inf)


def add(pool: Pool, arrays: PyTree, update: jax.Array, rating: jax.Array, busy: jax.Array) -> Pool:
    """Returns the pool with a new member in a free place, or in that of the member beaten most.

    It has these arrays and this rating () after an update (). Members that are `busy` (M,) bool are
    being played and stay; at least one is not.
    """
    worth = jnp.where(busy, -1.0, jnp.where(pool.born < 0, 2.0, win_rate(pool)))
    place = jnp.argmax(worth)
    return Pool(
        arrays=jax.tree.map(lambda all_, new: all_.at[place].set(new), pool.arrays, arrays),
        born=pool.born.at[place].set(update),
        score=pool.score.at[place].set(0.0),
        games=pool.games.at[place].set(0.0),
        rating=pool.rating.at[place].set(rating),
    )
