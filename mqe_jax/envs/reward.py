"""Rewards: named terms times weights of the same names, summed and logged in one place."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp


def weigh(terms: Mapping[str, jax.Array], weights: Any, num_agents: int) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Returns the weighted sum of the terms per agent, and the weighted terms for logging.

    A term is () if it is shared by all agents, or (A,); of the latter the first agent's value is logged.

    Args:
        terms: unweighted terms by name.
        weights: a record whose fields have the same names.
        num_agents: A.

    Returns:
        reward (A,), and `reward/<name>` () of every term with their sum `average_step_reward`.

    Raises:
        ValueError: if the names differ.
    """
    names = [field.name for field in dataclasses.fields(weights)]
    if set(terms) != set(names):
        raise ValueError(f"reward: terms {sorted(terms)} do not match the weights {sorted(names)}")
    weighted = {name: getattr(weights, name) * jnp.asarray(terms[name], jnp.float32) for name in names}
    total = sum((jnp.broadcast_to(value, (num_agents,)) for value in weighted.values()), jnp.zeros(num_agents))
    logged = {f"reward/{name}": value if value.ndim == 0 else value[0] for name, value in weighted.items()}
    logged["average_step_reward"] = total[0]
    return total, logged


def faded(terms: Mapping[str, jax.Array], weights: Any, factor: jax.Array | float) -> dict[str, jax.Array]:
    """Returns the terms, those of weight 0 in the record `weights` times a factor ()."""
    return {name: term if getattr(weights, name) else factor * term for name, term in terms.items()}


def crowding(position: jax.Array, within: float = 0.5) -> jax.Array:
    """Sum of 1 / d^2 over all ordered pairs of robots at a distance d below `within` m: (A, D) -> ()."""
    count = position.shape[0]
    apart = position[:, None] - position[None]
    square = jnp.sum(jnp.square(apart), axis=-1) + jnp.eye(count)
    near = (square < within**2) & ~jnp.eye(count, dtype=bool)
    return jnp.sum(jnp.where(near, 1.0 / jnp.maximum(square, 1e-2), 0.0))
