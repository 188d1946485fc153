"""PPO for teams: one pure function from a training state to the next.

A rollout of all worlds, advantages, then epochs of minibatches. The ratio that PPO clips and the network
make the difference between MAPPO, JRPO, independent PPO and their variants; both come from the settings.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mqe_jax.train.advantage import gae
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.loss import RATIOS, clipped_surrogate, value_loss
from mqe_jax.train.networks import Network, Params, Sizes, make_network
from mqe_jax.train.normalize import (
    ValueStatistics,
    running_init,
    running_update,
    value_denormalize,
    value_init,
    value_normalize,
    value_update,
)
from mqe_jax.train.optim import AdamState, Optimizer, adam
from mqe_jax.train.rollout import Cursor, ObservationNormalizer, normalize_obs, rollout
from mqe_jax.train.types import Batch, Transition, VectorEnv

Metrics = dict[str, jax.Array]
Carry = tuple[Params, AdamState, jax.Array]
"""What a gradient step changes: parameters, optimiser state, step size () before the schedule."""

_LEARNING_RATE_RANGE = (1e-5, 1e-2)
_ADAPTATION = 1.5


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrainState:
    """Everything that a training is at one moment: saved whole, it goes on as if never stopped."""

    params: Params
    optimizer: AdamState
    obs_normalizer: ObservationNormalizer
    value_normalizer: ValueStatistics
    learning_rate: jax.Array  # () float32, before the schedule
    cursor: Cursor
    key: jax.Array  # raw uint32 random key
    updates: jax.Array  # () int32, updates done


class Learner(NamedTuple):
    """`init(key) -> TrainState`; `update(TrainState) -> (TrainState, metrics)`; both pure, neither jitted."""

    init: Callable[[jax.Array], TrainState]
    update: Callable[[TrainState], tuple[TrainState, Metrics]]
    network: Network


def env_sizes(env: VectorEnv) -> Sizes:
    """Returns the widths that the networks take from the environment."""
    return Sizes(env.num_agents, env.observation_size, env.privileged_observation_size, env.action_size)


def make_learner(env: VectorEnv, config: TrainConfig) -> Learner:
    """Makes the learner of an environment.

    Raises ValueError where the settings do not fit the environment.
    """
    if env.num_envs != config.num_envs:
        raise ValueError(f"num_envs: {config.num_envs}; the environment given has {env.num_envs} worlds")
    if config.aid and not hasattr(jax.eval_shape(env.reset, jax.random.PRNGKey(0)), "aid"):
        raise ValueError(f"aid: {config.aid}; the environment {env.name} has no aid in its state")
    if config.stagger_episodes and not hasattr(env, "max_episode_steps"):
        raise ValueError(f"stagger_episodes: True; the environment {env.name} has no max_episode_steps")
    network = make_network(env_sizes(env), config)
    optimizer = adam(eps=config.adam_eps, max_grad_norm=config.max_grad_norm)

    def init(key: jax.Array) -> TrainState:
        params_key, env_key, stagger_key, key = jax.random.split(key, 4)
        env_state = env.reset(env_key)
        if config.stagger_episodes:
            env_state = _stagger(env, env_state, stagger_key)
        params = network.init(params_key)
        return _strongly_typed(
            TrainState(
                params=params,
                optimizer=optimizer.init(params),
                obs_normalizer=ObservationNormalizer(
                    running_init(env.observation_size), running_init(env.privileged_observation_size)
                ),
                value_normalizer=value_init(),
                learning_rate=jnp.float32(config.learning_rate),
                cursor=Cursor(
                    env_state=env_state,
                    memory=network.initial_memory(env.num_envs),
                    start=jnp.ones((env.num_envs,), bool),
                    episode_steps=jnp.zeros((env.num_envs,), jnp.int32),
                ),
                key=key,
                updates=jnp.zeros((), jnp.int32),
            )
        )

    def update(state: TrainState) -> tuple[TrainState, Metrics]:
        key, rollout_key, epoch_key = jax.random.split(state.key, 3)
        progress = state.updates.astype(jnp.float32) / config.num_updates
        aid = config.aid * jnp.maximum(1.0 - progress / config.aid_until, 0.0)
        cursor, transitions, metrics = rollout(
            env,
            network,
            state.params,
            state.obs_normalizer,
            _aided(state.cursor, aid) if config.aid else state.cursor,
            rollout_key,
            config.rollout_steps,
            config.normalize_observations,
        )
        batch, value_normalizer, batch_metrics = _prepare(network, config, state, transitions)
        params, optimizer_state, learning_rate, loss_metrics = _learn(
            network, optimizer, config, state, value_normalizer, batch, epoch_key
        )
        obs_normalizer = state.obs_normalizer
        if config.normalize_observations:
            obs_normalizer = ObservationNormalizer(
                running_update(obs_normalizer.obs, transitions.obs),
                running_update(obs_normalizer.privileged, transitions.privileged_obs),
            )
        new_state = TrainState(
            params=params,
            optimizer=optimizer_state,
            obs_normalizer=obs_normalizer,
            value_normalizer=value_normalizer,
            learning_rate=learning_rate,
            cursor=cursor,
            key=key,
            updates=state.updates + 1,
        )
        metrics["aid"] = aid
        return _strongly_typed(new_state), {**metrics, **batch_metrics, **loss_metrics}

    return Learner(init, update, network)


def _aided(cursor: Cursor, aid: jax.Array) -> Cursor:
    """Sets how much every world helps from its next episode on."""
    env_state = dataclasses.replace(cursor.env_state, aid=jnp.full_like(cursor.env_state.aid, aid))
    return cursor._replace(env_state=env_state)


def _stagger(env: VectorEnv, env_state: Any, key: jax.Array) -> Any:
    """Sets every world's clock to a random time, so that their first episodes end at different steps."""
    limit: int = getattr(env, "max_episode_steps")  # noqa: B009
    step = jax.random.randint(key, env_state.step.shape, 0, limit, env_state.step.dtype)
    return dataclasses.replace(env_state, step=step)


def _strongly_typed(state: TrainState) -> TrainState:
    """Removes weak types, so that the state goes in as it comes out and `update` is traced once."""
    return jax.tree.map(lambda x: jax.lax.convert_element_type(x, x.dtype), state)


def _prepare(
    network: Network, config: TrainConfig, state: TrainState, transitions: Transition
) -> tuple[Batch, ValueStatistics, Metrics]:
    """Works out values, advantages and targets of a rollout and cuts it into chunks (L, C, ...).

    The critic takes each step's observation and the one in which the step arrived as a chunk of two, all
    steps at once: its memory of the first serves the second, whether or not the episode ended there.
    """
    obs, privileged = normalize_obs(
        state.obs_normalizer, transitions.obs, transitions.privileged_obs, config.normalize_observations
    )
    final_obs, final_privileged = normalize_obs(
        state.obs_normalizer,
        transitions.final_obs,
        transitions.final_privileged_obs,
        config.normalize_observations,
    )
    pair, _ = network.value(
        state.params,
        transitions.memory["critic"],
        jnp.zeros((2, *transitions.done.shape), bool),
        jnp.stack([obs, final_obs]),
        jnp.stack([privileged, final_privileged]),
    )
    value_normalizer = state.value_normalizer
    value, next_value = value_denormalize(value_normalizer, pair)
    reward = transitions.reward
    if config.value == "joint":
        reward = jnp.mean(reward, axis=-1, keepdims=True)
    progress = state.updates.astype(jnp.float32) / config.num_updates
    share = config.failure_bootstrap * jnp.maximum(1.0 - progress / config.failure_bootstrap_until, 0.0)
    advantage, target = gae(
        reward,
        value,
        next_value,
        transitions.terminated * (1.0 - share),
        transitions.done,
        gamma=config.gamma,
        lam=config.gae_lambda,
    )
    if config.normalize_values:
        value_normalizer = value_update(value_normalizer, target, config.value_norm_decay)
    error_share = jnp.var(target - value) / jnp.maximum(jnp.var(target), 1e-8)
    metrics = {"value_mean": jnp.mean(value), "explained_variance": 1.0 - error_share}
    if config.advantage_clip is not None:
        scale = jnp.median(jnp.abs(advantage)) + 1e-8
        bound = jnp.where(progress < config.advantage_clip_until, config.advantage_clip, jnp.inf)
        advantage = jnp.clip(advantage / scale, -bound, bound)
    if config.normalize_advantages:
        advantage = (advantage - jnp.mean(advantage)) / (jnp.std(advantage) + 1e-8)

    steps = config.chunk
    batch = Batch(
        memory=jax.tree.map(lambda x: x[::steps].reshape(-1, *x.shape[2:]), transitions.memory),
        start=_chunks(transitions.start, steps),
        obs=_chunks(obs, steps),
        privileged_obs=_chunks(privileged, steps),
        action=_chunks(transitions.action, steps),
        log_prob=_chunks(transitions.log_prob, steps),
        advantage=_chunks(advantage, steps),
        target=_chunks(target, steps),
        old_value=_chunks(pair[0], steps),
    )
    return batch, value_normalizer, metrics


def _chunks(x: jax.Array, length: int) -> jax.Array:
    """Cuts time into chunks: (T, N, ...) -> (length, T / length x N, ...)."""
    x = x.reshape(x.shape[0] // length, length, *x.shape[1:])
    return jnp.swapaxes(x, 0, 1).reshape(length, -1, *x.shape[3:])


def _take(batch: Batch, index: jax.Array) -> Batch:
    """Returns the chunks of the given numbers (C',)."""
    memory = jax.tree.map(lambda x: x[index], batch.memory)
    rest = {name: getattr(batch, name)[:, index] for name in Batch._fields if name != "memory"}
    return Batch(memory=memory, **rest)


def _loss(
    params: Params,
    network: Network,
    config: TrainConfig,
    value_normalizer: ValueStatistics,
    entropy_coef: jax.Array,
    batch: Batch,
) -> tuple[jax.Array, Metrics]:
    """Returns the PPO loss () of a minibatch and its parts."""
    now = network.evaluate(params, batch.memory, batch.start, batch.obs, batch.privileged_obs, batch.action)
    log_ratio = RATIOS[config.ratio](now.log_prob, batch.log_prob)
    surrogate = clipped_surrogate(log_ratio, batch.advantage[..., None], config.clip, config.dual_clip)
    policy_loss = jnp.mean(jnp.sum(surrogate, axis=-1))
    target = value_normalize(value_normalizer, batch.target)
    critic_loss = jnp.mean(value_loss(now.value, batch.old_value, target, config.value_clip, config.huber_delta))
    mean_entropy = jnp.mean(now.entropy)
    per_agent = RATIOS["agent"](now.log_prob, batch.log_prob)
    metrics = {
        "loss/policy": policy_loss,
        "loss/value": critic_loss,
        "entropy": mean_entropy,
        "approx_kl": jnp.mean(jnp.exp(per_agent) - 1.0 - per_agent),
        "clip_fraction": jnp.mean((jnp.abs(jnp.exp(log_ratio) - 1.0) > config.clip).astype(jnp.float32)),
    }
    return policy_loss + config.value_coef * critic_loss - entropy_coef * mean_entropy, metrics


def _adapted(learning_rate: jax.Array, kl: jax.Array, target_kl: float) -> jax.Array:
    """Returns a smaller step size where the policy moved too far, a larger one where it hardly moved."""
    factor = jnp.where(kl > 2.0 * target_kl, 1.0 / _ADAPTATION, jnp.where(kl < 0.5 * target_kl, _ADAPTATION, 1.0))
    return jnp.clip(learning_rate * factor, *_LEARNING_RATE_RANGE)


def _learn(
    network: Network,
    optimizer: Optimizer,
    config: TrainConfig,
    state: TrainState,
    value_normalizer: ValueStatistics,
    batch: Batch,
    key: jax.Array,
) -> tuple[Params, AdamState, jax.Array, Metrics]:
    """Passes `epochs` times over the batch; returns parameters, optimiser, step size and mean metrics."""
    progress = state.updates.astype(jnp.float32) / config.num_updates
    schedule = jnp.maximum(1.0 - progress, 0.0) if config.learning_rate_schedule == "linear" else 1.0
    entropy_coef = jnp.float32(config.entropy_coef)
    if config.entropy_coef_final is not None:
        entropy_coef += jnp.minimum(progress, 1.0) * (config.entropy_coef_final - config.entropy_coef)
    chunks = batch.start.shape[1]

    def step(carry: Carry, minibatch: Batch) -> tuple[Carry, Metrics]:
        params, optimizer_state, learning_rate = carry
        gradient, metrics = jax.grad(_loss, has_aux=True)(
            params, network, config, value_normalizer, entropy_coef, minibatch
        )
        if config.target_kl is not None:
            learning_rate = _adapted(learning_rate, metrics["approx_kl"], config.target_kl)
        params, optimizer_state, grad_norm = optimizer.update(
            gradient, optimizer_state, params, learning_rate * schedule
        )
        return (params, optimizer_state, learning_rate), {**metrics, "grad_norm": grad_norm}

    def epoch(carry: Carry, epoch_key: jax.Array) -> tuple[Carry, Metrics]:
        if config.minibatches == 1:
            return step(carry, batch)
        index = jax.random.permutation(epoch_key, chunks).reshape(config.minibatches, -1)
        carry, metrics = jax.lax.scan(lambda c, i: step(c, _take(batch, i)), carry, index)
        return carry, jax.tree.map(jnp.mean, metrics)

    carry = (state.params, state.optimizer, state.learning_rate)
    carry, metrics = jax.lax.scan(epoch, carry, jax.random.split(key, config.epochs))
    params, optimizer_state, learning_rate = carry
    metrics = jax.tree.map(jnp.mean, metrics)
    metrics["learning_rate"] = learning_rate * schedule
    metrics["entropy_coef"] = entropy_coef
    return params, optimizer_state, learning_rate, metrics
