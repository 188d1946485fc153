"""Collects transitions and metrics from all environments, and forms minibatches."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mqe_jax.acting.seats import Seats
from mqe_jax.core import devices, keys
from mqe_jax.core.types import (
    Batch,
    Memory,
    NetworkMemory,
    Params,
    Transition,
    VectorEnv,
    active_of,
    final_observations,
    mean_of_team,
    observations,
    reset_memory,
)
from mqe_jax.train.config import PPO
from mqe_jax.train.loss import where_used
from mqe_jax.train.networks import Network
from mqe_jax.train.normalize import Features, RunningStatistics, running_normalize


class RolloutState(NamedTuple):
    """State that one rollout passes on to the next, with a leading axis N."""

    env_state: Any
    memory: NetworkMemory
    is_first: jax.Array  # whether the next step is the first of an episode (N,) bool
    episode_steps: jax.Array  # steps in this episode (N,) int32
    episode_return: jax.Array  # sum of rewards in this episode, mean over agents (N,)
    teacher_memory: Memory = ()  # recurrent state of the teacher


class ObservationNormalizer(NamedTuple):
    """Running statistics of the agents' and of the privileged observations."""

    obs: RunningStatistics
    privileged: RunningStatistics


def normalize_obs(
    normalizer: ObservationNormalizer,
    obs: jax.Array,
    privileged: jax.Array,
    active: jax.Array,
    enabled: bool,
    features: Features | None = None,
) -> tuple[jax.Array, jax.Array]:
    """Returns both observations as inputs of the networks.

    They are normalised if `enabled`. The observations of agents that are not `active` are 0.
    """
    if enabled:
        obs = running_normalize(normalizer.obs, obs, features)
        privileged = running_normalize(normalizer.privileged, privileged)
    return jnp.where(active[..., None], obs, 0.0), privileged


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
    group: str = "policy",
    features: Features | None = None,
    teacher: Seats | None = None,
) -> tuple[RolloutState, Transition, dict[str, Any]]:
    """Steps every environment `length` times under the policy.

    Returns the new state, transitions (T, N, ...) and metrics (). The environment receives
    `action_scale` times the sampled action. A teacher labels every step with its action. It sees
    its own group of observations without errors. Metrics are means over steps and environments,
    but `diverged` and `overflow` are counts; `ended` has the number of `episodes` that ended and
    means over them.
    """

    def one_step(
        state: RolloutState, key: jax.Array
    ) -> tuple[RolloutState, tuple[Transition, Any, Any]]:
        before = state.env_state
        memory = reset_memory(state.memory, state.is_first)
        active = active_of(before)
        used = getattr(before, "used", None)
        seen = observations(before).group(group)
        with jax.named_scope("policy"):
            obs, privileged = normalize_obs(
                normalizer, seen, before.privileged_obs, active, normalize, features
            )
            action, log_prob, actor_memory = network.act(
                network.policy_params(params), memory.actor, obs, key, active
            )
            not_first = jnp.zeros((1, *state.is_first.shape), bool)
            _, critic_memory = network.value(
                params, memory.critic, not_first, obs[None], privileged[None], active[None]
            )
        label = ()
        teacher_memory = ()
        if teacher is not None:
            remembered = teacher.restart((state.teacher_memory,), state.is_first)
            teacher_key = jax.random.fold_in(key, keys.SECOND)
            label, (teacher_memory,) = teacher.act(
                observations(before).exact(), remembered, teacher_key, jnp.zeros_like(action)
            )
        after = env.step(before, action_scale * action)
        done = after.terminated | after.truncated
        transition = Transition(
            memory=memory,
            is_first=state.is_first,
            obs=seen,
            privileged_obs=before.privileged_obs,
            final_obs=final_observations(after).get(group),
            final_privileged_obs=after.final_privileged_obs,
            action=action,
            log_prob=where_used(log_prob, used),
            reward=after.reward,
            active=active,
            terminated=after.terminated,
            done=done,
            teacher_action=label,
            used=used,
        )
        episode_steps = state.episode_steps + 1
        episode_return = state.episode_return + mean_of_team(after.reward, active)
        of_episodes = {
            "episode_length": episode_steps.astype(jnp.float32),
            "episode_return": episode_return,
        }
        ended = {**after.outcome.by_name(), **of_episodes}
        state = RolloutState(
            env_state=after,
            memory=NetworkMemory(actor_memory, critic_memory),
            is_first=done,
            episode_steps=jnp.where(done, 0, episode_steps),
            episode_return=jnp.where(done, 0.0, episode_return),
            teacher_memory=teacher_memory,
        )
        last = {name: jnp.where(done, value, 0.0) for name, value in ended.items()}
        return state, (transition, _sums(after.metrics), _sums({**last, "episodes": done}))

    state, (transitions, *sums) = jax.lax.scan(one_step, state, jax.random.split(key, length))
    steps, ended = devices.total(jax.tree.map(lambda x: jnp.sum(x, axis=0), sums))
    return state, transitions, _means(steps, ended, length * env.num_envs * devices.size())


def _sums(values: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """Returns the sums over environments: (N,) -> ()."""
    return {name: jnp.sum(value.astype(jnp.float32)) for name, value in values.items()}


def _means(
    steps: dict[str, jax.Array], ended: dict[str, jax.Array], samples: int
) -> dict[str, Any]:
    """Returns the metrics of a rollout from sums over steps and over ended episodes ()."""
    episodes = ended.pop("episodes")
    counts = ("diverged", "overflow")
    means = {name: total if name in counts else total / samples for name, total in steps.items()}
    of_episodes = {name: total / jnp.maximum(episodes, 1.0) for name, total in ended.items()}
    return {**means, "ended": {"episodes": episodes, **of_episodes}}


def chunks(x: jax.Array, length: int) -> jax.Array:
    """Splits the time axis into chunks: (T, N, ...) -> (length, T / length x N, ...)."""
    parts = x.shape[0] // length
    envs = x.shape[1]
    x = x.reshape(parts, length, *x.shape[1:])
    return jnp.swapaxes(x, 0, 1).reshape(length, parts * envs, *x.shape[3:])


def take(batch: Batch, index: jax.Array) -> Batch:
    """Returns the chunks with the given indices (C',)."""
    memory = jax.tree.map(lambda x: x[index], batch.memory)
    return jax.tree.map(lambda x: x[:, index], batch._replace(memory=()))._replace(memory=memory)


def minibatches(ppo: PPO, key: jax.Array, parts: int, envs: int) -> jax.Array:
    """Returns the chunks of every minibatch (M, C / M).

    This process has C = parts x envs chunks. They are permuted within each of `ppo.groups` groups
    of environments. Every minibatch gets equally many chunks of each group.
    """
    groups = ppo.groups // devices.size()
    keys = (
        key[None] if ppo.groups == 1 else devices.rows(lambda n: jax.random.split(key, n), groups)
    )
    of_group = envs // groups
    permuted = jax.vmap(lambda key: jax.random.permutation(key, parts * envs // groups))(keys)
    part, env = jnp.divmod(permuted, of_group)
    chunk = part * envs + jnp.arange(groups)[:, None] * of_group + env
    return jnp.swapaxes(chunk.reshape(groups, ppo.minibatches, -1), 0, 1).reshape(
        ppo.minibatches, -1
    )
