"""Rollouts as chunks of steps, and the minibatches of chunks."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mqe_jax.train import devices
from mqe_jax.train.config import PPO
from mqe_jax.train.types import Batch


def chunks(x: jax.Array, length: int) -> jax.Array:
    """Splits the time axis into chunks: (T, N, ...) -> (length, T / length x N, ...)."""
    parts, envs = x.shape[0] // length, x.shape[1]
    x = x.reshape(parts, length, *x.shape[1:])
    return jnp.swapaxes(x, 0, 1).reshape(length, parts * envs, *x.shape[3:])


def take(batch: Batch, index: jax.Array) -> Batch:
    """Returns the chunks with the given indices (C',)."""
    memory = jax.tree.map(lambda x: x[index], batch.memory)
    rest = {name: getattr(batch, name)[:, index] for name in Batch._fields if name != "memory"}
    return Batch(memory=memory, **rest)


def minibatches(ppo: PPO, key: jax.Array, parts: int, envs: int) -> jax.Array:
    """Returns the chunks of every minibatch (M, C / M), of the C = parts x envs chunks of this process.

    The environments of all processes are `ppo.groups` groups. The chunks of each are permuted, and every minibatch gets
    equally many of them, so that a process with whole groups has its share of every minibatch.
    """
    groups = ppo.groups // devices.size()
    keys = key[None] if ppo.groups == 1 else devices.rows(lambda n: jax.random.split(key, n), groups)
    part, env = jnp.divmod(
        jax.vmap(lambda key: jax.random.permutation(key, parts * envs // groups))(keys), envs // groups
    )
    chunk = part * envs + jnp.arange(groups)[:, None] * (envs // groups) + env
    return jnp.swapaxes(chunk.reshape(groups, ppo.minibatches, -1), 0, 1).reshape(ppo.minibatches, -1)
