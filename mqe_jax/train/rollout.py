"""Steps all environments under the current policy and collects transitions and metrics."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mqe_jax.train.networks import Network, reset_memory
from mqe_jax.train.normalize import RunningStatistics, running_normalize
from mqe_jax.train.types import NetworkMemory, Params, Transition, VectorEnv


class RolloutState(NamedTuple):
    """State carried between rollouts: environment states, recurrent states, episode counters; leading axis N."""

    env_state: Any
    memory: NetworkMemory
    is_first: jax.Array  # (N,) bool, the next step is the first of an episode
    episode_steps: jax.Array  # (N,) int32, steps since the episode began


class ObservationNormalizer(NamedTuple):
    """Running statistics of the agents' and of the privileged observations."""

    obs: RunningStatistics
    privileged: RunningStatistics


def normalize_obs(
    normalizer: ObservationNormalizer, obs: jax.Array, privileged: jax.Array, enabled: bool
) -> tuple[jax.Array, jax.Array]:
    """Returns both observations as the networks take them: normalised where `enabled`."""
    if not enabled:
        return obs, privileged
    return running_normalize(normalizer.obs, obs), running_normalize(normalizer.privileged, privileged)


def rollout(
    env: VectorEnv,
    network: Network,
    params: Params,
    normalizer: ObservationNormalizer,
    state: RolloutState,
    key: jax.Array,
    length: int,
    *,
    normalize: bool,
    action_scale: float,
) -> tuple[RolloutState, Transition, dict[str, jax.Array]]:
    """Steps every environment `length` times; returns the new state, transitions (T, N, ...) and metrics ().

    The environment gets `action_scale` times the sampled action. Its metrics are means over steps and environments,
    except: names that begin with `success` are means over the steps that ended an episode (NaN where none did), and
    `diverged` is a count.
    """

    def one_step(state: RolloutState, key: jax.Array) -> tuple[RolloutState, tuple[Transition, dict[str, jax.Array]]]:
        before = state.env_state
        memory = reset_memory(state.memory, state.is_first)
        obs, privileged = normalize_obs(normalizer, before.obs, before.privileged_obs, normalize)
        action, log_prob, actor_memory = network.act(network.acting(params), memory.actor, obs, key)
        not_first = jnp.zeros((1, *state.is_first.shape), bool)
        _, critic_memory = network.value(params, memory.critic, not_first, obs[None], privileged[None])
        after = env.step(before, action_scale * action)
        done = after.terminated | after.truncated
        transition = Transition(
            memory=memory,
            is_first=state.is_first,
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
        episode_steps = state.episode_steps + 1
        sums = _sums(after.metrics, done, episode_steps)
        state = RolloutState(
            env_state=after,
            memory=NetworkMemory(actor_memory, critic_memory),
            is_first=done,
            episode_steps=jnp.where(done, 0, episode_steps),
        )
        return state, (transition, sums)

    state, (transitions, sums) = jax.lax.scan(one_step, state, jax.random.split(key, length))
    return state, transitions, _means(sums, length * env.num_envs)


def _at_episode_end(name: str) -> bool:
    return name.startswith("success")


def _sums(metrics: dict[str, jax.Array], done: jax.Array, episode_steps: jax.Array) -> dict[str, jax.Array]:
    """Returns the sums over environments of one step."""
    sums = {
        name: jnp.sum(jnp.where(done, value, 0.0) if _at_episode_end(name) else value)
        for name, value in metrics.items()
    }
    sums["episodes"] = jnp.sum(done.astype(jnp.float32))
    sums["episode_length"] = jnp.sum(jnp.where(done, episode_steps, 0).astype(jnp.float32))
    return sums


def _means(sums: dict[str, jax.Array], samples: int) -> dict[str, jax.Array]:
    """Returns the metrics of a rollout from its sums per step (T,)."""
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
