"""Rewards: named terms times weights of the same names, summed and logged in one place."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from mqe_jax.core.returned import check_names, check_shape


def weigh(
    terms: Mapping[str, jax.Array], weights: Any, teams: Sequence[Sequence[int]], active: jax.Array
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Returns the reward (A,), the weighted sum of the terms, and what is logged of it.

    A term is () if it is shared by all agents, or (A,); the fields of `weights` have the same
    names. Logged are `reward/<name>` () and their sum `average_step_reward`, of each team's first
    active agent, those of team 1 with the prefix `team1/`. The reward of an agent that is not
    `active` (A,) is 0. ValueError if names or shapes differ.
    """
    names = [field.name for field in dataclasses.fields(weights)]
    agents = sum(map(len, teams))
    check_names("rewards", terms, names)
    shapes = ((), (agents,))
    given = {
        name: check_shape(f"rewards: {name}", terms[name], *shapes).astype(jnp.float32)
        for name in names
    }
    weighted = {name: getattr(weights, name) * term for name, term in given.items()}
    total = sum(
        (jnp.broadcast_to(value, (agents,)) for value in weighted.values()), jnp.zeros(agents)
    )
    values = {
        **{f"reward/{name}": value for name, value in weighted.items()},
        "average_step_reward": total,
    }
    logged = {
        f"team{team}/{name}" if team else name: _first(value, agents, active)
        if value.ndim
        else value
        for team, agents in enumerate(teams)
        for name, value in values.items()
    }
    return jnp.where(active, total, 0.0), logged


def _first(value: jax.Array, agents: Sequence[int], active: jax.Array) -> jax.Array:
    """Returns the value () of the first active one of some agents; without any, that of the
    last.
    """
    *others, chosen = agents
    result = value[chosen]
    for agent in reversed(others):
        result = jnp.where(active[agent], value[agent], result)
    return result


def fade(
    terms: Mapping[str, jax.Array], weights: Any, factor: jax.Array | float
) -> dict[str, jax.Array]:
    """Returns the terms, those of weight 0 in `weights` times a factor ()."""

    def as_float(term):
        return jnp.asarray(term, jnp.float32)

    return {
        name: term if getattr(weights, name) else factor * as_float(term)
        for name, term in terms.items()
    }


def crowding(position: jax.Array, active: jax.Array) -> jax.Array:
    """Sum of 1 / d^2 over all ordered pairs of active robots (A,) at a distance d below 0.5 m: (A,
    D) -> ().

    Example:
        ```python
        from mqe_jax.envs.reward import crowding

        print(crowding(jax.numpy.array([[0.0, 0.0], [0.25, 0.0]]), jax.numpy.ones(2, bool)))  # 32.0
        ```
    """
    count = position.shape[0]
    apart = position[:, None] - position[None]
    square = jnp.sum(jnp.square(apart), axis=-1) + jnp.eye(count)
    near = (square < 0.5**2) & ~jnp.eye(count, dtype=bool) & active & active[:, None]
    return jnp.sum(jnp.where(near, 1.0 / jnp.maximum(square, 1e-2), 0.0))
