"""Steps all worlds under the current policy and gathers what there is to learn from."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mqe_jax.train.networks import Network, Params, reset_memory
from mqe_jax.train.normalize import RunningStatistics, running_normalize
from mqe_jax.train.types import Memory, Transition, VectorEnv


class Cursor(NamedTuple):
    """Where the worlds stand between two rollouts; leading axis N."""

    env_state: Any
    memory: Memory
    start: jax.Array  # (N,) bool, the next step is the first of an episode
    episode_steps: jax.Array  # (N,) int32, steps since the episode began


class ObservationNormalizer(NamedTuple):
    """Running statistics of the agents' and of the privileged observations."""

    obs: RunningStatistics
    privileged: RunningStatistics


def normalize_obs(
    normalizer: ObservationNormalizer, obs: jax.Array, privileged: jax.Array, enabled: bool
) -> tuple[jax.Array, jax.Array]:
    """Returns both observations as the networks see them."""
    if not enabled:
        return obs, privileged
    return running_normalize(normalizer.obs, obs), running_normalize(normalizer.privileged, privileged)


def rollout(
    env: VectorEnv,
    network: Network,
    params: Params,
    normalizer: ObservationNormalizer,
    cursor: Cursor,
    key: jax.Array,
    length: int,
    normalize: bool,
) -> tuple[Cursor, Transition, dict[str, jax.Array]]:
    """Steps every world `length` times; returns the new cursor, transitions (T, N, ...) and metrics ().

    Environment metrics are means over steps and worlds, except: names that begin with `success` are means
    over the steps that ended an episode (NaN where none did), and `diverged` is a count.
    """

    def one_step(cursor: Cursor, key: jax.Array) -> tuple[Cursor, tuple[Transition, dict[str, jax.Array]]]:
        before = cursor.env_state
        memory = reset_memory(cursor.memory, cursor.start)
        obs, privileged = normalize_obs(normalizer, before.obs, before.privileged_obs, normalize)
        action, log_prob, actor_memory = network.act(params, memory["actor"], obs, key)
        no_start = jnp.zeros((1, *cursor.start.shape), bool)
        _, critic_memory = network.value(params, memory["critic"], no_start, obs[None], privileged[None])
        after = env.step(before, action)
        done = after.terminated | after.truncated
        transition = Transition(
            memory=memory,
            start=cursor.start,
            obs=before.obs,
            privileged_obs=before.privileged_obs,
            final_obs=after.final_obs,
            final_privileged_obs=after.final_privileged_obs,
            action=action,
            log_prob=log_prob,
            reward=after.reward,
            terminated=after.terminated,
            done=done,
        )
        episode_steps = cursor.episode_steps + 1
        sums = _sums(after.metrics, done, episode_steps)
        cursor = Cursor(
            env_state=after,
            memory={"actor": actor_memory, "critic": critic_memory},
            start=done,
            episode_steps=jnp.where(done, 0, episode_steps),
        )
        return cursor, (transition, sums)

    cursor, (transitions, sums) = jax.lax.scan(one_step, cursor, jax.random.split(key, length))
    return cursor, transitions, _means(sums, length * env.num_envs)


def _at_episode_end(name: str) -> bool:
    return name.startswith("success")


def _sums(metrics: dict[str, jax.Array], done: jax.Array, episode_steps: jax.Array) -> dict[str, jax.Array]:
    """Returns sums over worlds, of one step."""
    sums = {
        name: jnp.sum(jnp.where(done, value, 0.0) if _at_episode_end(name) else value)
        for name, value in metrics.items()
    }
    sums["episodes"] = jnp.sum(done.astype(jnp.float32))
    sums["episode_length"] = jnp.sum(jnp.where(done, episode_steps, 0).astype(jnp.float32))
    return sums


def _means(sums: dict[str, jax.Array], samples: int) -> dict[str, jax.Array]:
    """Returns the means of the sums per step (T,)."""
    totals = {name: jnp.sum(value) for name, value in sums.items()}
    episodes = totals["episodes"]
    means = {}
    for name, total in totals.items():
        if name in ("episodes", "diverged"):
            means[name] = total
        elif _at_episode_end(name) or name == "episode_length":
            means[name] = jnp.where(episodes > 0, total / jnp.maximum(episodes, 1.0), jnp.nan)
        else:
            means[name] = total / samples
    return means
