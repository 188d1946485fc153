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
    values = {}
    total = jnp.zeros(agents)
    for name in names:
        term = check_shape(f"rewards: {name}", terms[name], (), (agents,))
        value = getattr(weights, name) * term.astype(jnp.float32)
        total = total + jnp.broadcast_to(value, (agents,))
        values[f"reward/{name}"] = value
    values["average_step_reward"] = total
    logged = {}
    for number, team in enumerate(teams):
        prefix = f"team{number}/" if number else ""
        for name, value in values.items():
            logged[f"{prefix}{name}"] = _first(value, team, active) if value.ndim else value
    return jnp.where(active, total, 0.0), logged


def _first(value: jax.Array, agents: Sequence[int], active: jax.Array) -> jax.Array:
    """Returns the value () of the first active one of some agents, or of the last one."""
    *others, chosen = agents
    result = value[chosen]
    for agent in reversed(others):
        result = jnp.where(active[agent], value[agent], result)
    return result


def fade(
    terms: Mapping[str, jax.Array], weights: Any, factor: jax.Array | float
) -> dict[str, jax.Array]:
    """Returns the terms, those of weight 0 in `weights` times a factor ()."""

    faded = dict(terms)
    for name, term in terms.items():
        if not getattr(weights, name):
            faded[name] = factor * jnp.asarray(term, jnp.float32)
    return faded


def crowding(position: jax.Array, active: jax.Array) -> jax.Array:
    """Returns the sum of 1 / d^2 over all ordered pairs of robots at a distance d below 0.5 m.

    Positions are (A, D), m. Only `active` robots (A,) count.

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
