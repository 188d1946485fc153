"""Multi-agent PPO as one pure function from a learner state to the next.

A rollout of all environments, advantages, then epochs of minibatches. MAPPO, JRPO, independent PPO and their variants
differ in the ratio that PPO clips, the value (per agent or per team) and the network; all three are settings.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mqe_jax.precision import single
from mqe_jax.settings import fail
from mqe_jax.train import devices
from mqe_jax.train.checks import check_divisible, check_environment, check_teacher
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.loss import RATIOS, clipped_surrogate, gae, value_loss
from mqe_jax.train.networks import EnvDims, Network
from mqe_jax.train.normalize import (
    ValueStatistics,
    running_init,
    running_update,
    value_denormalize,
    value_init,
    value_normalize,
    value_update,
)
from mqe_jax.train.optim import AdamState, Optimizer, adam, begun_anew
from mqe_jax.train.rollout import (
    ObservationNormalizer,
    RolloutState,
    chunks,
    mean_of_team,
    minibatches,
    normalize_obs,
    rollout,
    take,
)
from mqe_jax.train.schedules import Scheduled, next_assistance, scheduled
from mqe_jax.train.types import Batch, Matchmaker, Params, PyTree, Transition, VectorEnv, replace_fields

Metrics = dict[str, Any]
Carry = tuple[Params, AdamState, jax.Array]
"""Carry of a gradient step: parameters, optimiser state, learning rate () before the schedule."""

_LEARNING_RATE_RANGE = (1e-5, 1e-2)
_ADAPTATION = 1.5


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrainState:
    """Complete learner state. Restoring it resumes training exactly (bit for bit on deterministic backends)."""

    params: Params
    optimizer: AdamState
    obs_normalizer: ObservationNormalizer
    value_normalizer: ValueStatistics
    learning_rate: jax.Array
    """Learning rate before the schedule () float32."""
    assistance: jax.Array
    """Assistance of the next update () float32, unless its annealed value is below."""
    rollout: RolloutState
    key: jax.Array
    """Random key."""
    updates: jax.Array
    """Updates done () int32."""
    extra: PyTree = ()
    """State of the league (`mqe_jax.train.types.Matchmaker`); empty without one."""


class Learner(NamedTuple):
    """`init(key) -> TrainState`; `update(TrainState) -> (TrainState, metrics)`; both pure, neither jitted."""

    init: Callable[[jax.Array], TrainState]
    update: Callable[[TrainState], tuple[TrainState, Metrics]]


def env_dims(env: VectorEnv, config: TrainConfig) -> EnvDims:
    """Returns the sizes from which a network is built; InputError if the environment lacks the policy's group."""
    sizes = {"policy": env.observation_size, **getattr(env, "group_sizes", {})}
    if config.group not in sizes:
        fail("group", config.group, f"one of {env.name}: {', '.join(sizes)}")
    return EnvDims(
        agents=env.num_agents,
        observation=sizes[config.group],
        privileged=env.privileged_observation_size,
        action=env.action_size,
        values=1 if config.ppo.value == "joint" else env.num_agents,
    )


def make_learner(
    env: VectorEnv, config: TrainConfig, *, league: Matchmaker | None = None, teacher: Any = None, processes: int = 1
) -> Learner:
    """Returns the learner of an environment.

    Args:
        env: the environments; with several processes, the share of one.
        config: settings.
        league: gives the environments their opponents between updates.
        teacher: the policy that `imitation` imitates, without recurrent state.
        processes: number of processes; `devices.Processes` compiles the functions of several.

    Raises:
        InputError: if the settings do not fit the environment.
    """
    check_environment(env, config, processes)
    check_teacher(config, teacher)
    dims = env_dims(env, config)
    network = config.network.build(dims)
    check_divisible(config, network, processes)
    optimizer = adam(eps=config.optimizer.eps, max_grad_norm=config.optimizer.max_grad_norm)

    @single
    def init(key: jax.Array) -> TrainState:
        params_key, env_key, stagger_key, key = jax.random.split(key, 4)
        env_state = env.reset(env_key)
        if config.stagger_episodes:
            env_state = _stagger(env, env_state, stagger_key)
        params = network.init(params_key)
        state = _strongly_typed(
            TrainState(
                params=params,
                optimizer=optimizer.init(params),
                obs_normalizer=ObservationNormalizer(running_init(dims.observation), running_init(dims.privileged)),
                value_normalizer=value_init(config.normalization.values),
                learning_rate=jnp.float32(config.optimizer.learning_rate),
                assistance=jnp.float32(config.curriculum.assistance),
                rollout=RolloutState(
                    env_state=env_state,
                    memory=network.initial_memory(env.num_envs),
                    is_first=jnp.ones((env.num_envs,), bool),
                    episode_steps=jnp.zeros((env.num_envs,), jnp.int32),
                    episode_return=jnp.zeros((env.num_envs,)),
                ),
                key=key,
                updates=jnp.zeros((), jnp.int32),
            )
        )
        return state if league is None else league.seat(dataclasses.replace(state, extra=league.begin(state)))

    @single
    def update(state: TrainState) -> tuple[TrainState, Metrics]:
        key, rollout_key, epoch_key = jax.random.split(state.key, 3)
        now = scheduled(config, state.updates)
        now = now._replace(assistance=jnp.minimum(now.assistance, state.assistance))
        rollout_state, transitions, metrics = rollout(
            env,
            network,
            state.params,
            state.obs_normalizer,
            _assisted(state.rollout, now.assistance) if config.curriculum.assistance else state.rollout,
            rollout_key,
            config.rollout_steps,
            normalize=config.normalization.observations,
            action_scale=config.action_scale,
            group=config.group,
        )
        batch, value_normalizer, batch_metrics = _prepare(network, config, now, state, transitions)
        if teacher is not None:
            shown = _teacher_actions(teacher, transitions.obs) / config.action_scale
            batch = batch._replace(teacher_action=chunks(shown, network.chunk_length))
        params, optimizer_state, learning_rate, loss_metrics = _learn(
            network, optimizer, config, now, state, value_normalizer, batch, epoch_key
        )
        obs_normalizer = state.obs_normalizer
        if config.normalization.observations:
            obs_normalizer = ObservationNormalizer(
                running_update(obs_normalizer.obs, transitions.obs, transitions.active),
                running_update(
                    obs_normalizer.privileged, transitions.privileged_obs, jnp.any(transitions.active, axis=-1)
                ),
            )
        new_state = TrainState(
            params=params,
            optimizer=optimizer_state,
            obs_normalizer=obs_normalizer,
            value_normalizer=value_normalizer,
            learning_rate=learning_rate,
            assistance=next_assistance(
                config, now.assistance, metrics["ended"].get("success", jnp.float32(0.5)), metrics["ended"]["episodes"]
            ),
            rollout=rollout_state,
            key=key,
            updates=state.updates + 1,
            extra=state.extra,
        )
        if league is not None:
            new_state, counted = league.after(new_state)
            metrics |= counted
        metrics |= {"assistance": now.assistance, "entropy_coef": now.entropy_coef}
        return _strongly_typed(new_state), {**metrics, **batch_metrics, **loss_metrics}

    return Learner(init, update)


def _assisted(state: RolloutState, assistance: jax.Array) -> RolloutState:
    """Sets the assistance of every environment, which takes effect with its next episode."""
    env_state = replace_fields(state.env_state, assistance=jnp.full_like(state.env_state.assistance, assistance))
    return state._replace(env_state=env_state)


def _stagger(env: VectorEnv, env_state: Any, key: jax.Array) -> Any:
    """Sets every environment's step counter to a random value, so that the first episodes end at different steps."""
    limit: int = getattr(env, "max_episode_steps")  # noqa: B009
    draw = lambda n: jax.random.randint(key, (n,), 0, limit, env_state.step.dtype)  # noqa: E731
    step = devices.rows(draw, len(env_state.step))
    return replace_fields(env_state, step=step)


def _strongly_typed(state: TrainState) -> TrainState:
    """Removes weak types, so that input and output states have the same types and `update` is traced once."""
    return jax.tree.map(lambda x: jax.lax.convert_element_type(x, x.dtype), state)


def _teacher_actions(teacher: Any, obs: jax.Array) -> jax.Array:
    """Returns the teacher's actions (T, N, A, D) for observations (T, N, A, O)."""
    flat = obs.reshape(-1, *obs.shape[2:])
    action, _ = teacher.act(flat, teacher.initial_memory(len(flat)), jax.random.PRNGKey(0))
    return action.reshape(*obs.shape[:2], *action.shape[1:])


def _prepare(
    network: Network, config: TrainConfig, now: Scheduled, state: TrainState, transitions: Transition
) -> tuple[Batch, ValueStatistics, Metrics]:
    """Computes values, advantages and targets of a rollout and splits it into chunks (L, C, ...).

    The critic evaluates each step's observation and final observation as a chunk of two, batched over all steps: the
    next value uses the recurrent state after the step's observation, whether or not the episode ended there.
    """
    active, normalize = transitions.active, config.normalization.observations
    obs, privileged = normalize_obs(
        state.obs_normalizer, transitions.obs, transitions.privileged_obs, active, normalize
    )
    # What the critic does not read may be missing; these observations take its place.
    last = transitions.obs if transitions.final_obs is None else transitions.final_obs
    last_privileged = transitions.final_privileged_obs
    last_privileged = transitions.privileged_obs if last_privileged is None else last_privileged
    final_obs, final_privileged = normalize_obs(state.obs_normalizer, last, last_privileged, active, normalize)
    pair, _ = network.value(
        state.params,
        transitions.memory.critic,
        jnp.zeros((2, *transitions.done.shape), bool),
        jnp.stack([obs, final_obs]),
        jnp.stack([privileged, final_privileged]),
        jnp.stack([active, active]),
    )
    value_normalizer = state.value_normalizer
    value, next_value = value_denormalize(value_normalizer, pair)
    reward, counted = jnp.where(active, transitions.reward, 0), active
    if config.ppo.value == "joint":
        reward, counted = mean_of_team(reward, active)[..., None], jnp.any(active, axis=-1, keepdims=True)
    advantage, target = gae(
        reward,
        value,
        next_value,
        transitions.terminated.astype(jnp.float32) * (1.0 - now.failure_bootstrap),
        transitions.done,
        gamma=config.ppo.gamma,
        gae_lambda=config.ppo.gae_lambda,
    )
    if config.normalization.values:
        value_normalizer = value_update(value_normalizer, target, counted, config.normalization.value_decay)
    unexplained = devices.variance(target - value, counted) / jnp.maximum(devices.variance(target, counted), 1e-8)
    metrics = {"value_mean": devices.mean_where(value, counted), "explained_variance": 1.0 - unexplained}
    if config.ppo.advantage_clip is not None:
        scale = devices.median(jnp.abs(advantage), counted) + 1e-8
        advantage = jnp.clip(advantage / scale, -now.advantage_clip, now.advantage_clip)
    if config.normalization.advantages:
        deviation = jnp.sqrt(devices.variance(advantage, counted))
        advantage = (advantage - devices.mean_where(advantage, counted)) / (deviation + 1e-8)

    steps = network.chunk_length
    batch = Batch(
        memory=jax.tree.map(lambda x: x[::steps].reshape(-1, *x.shape[2:]), transitions.memory),
        is_first=chunks(transitions.is_first, steps),
        obs=chunks(obs, steps),
        privileged_obs=chunks(privileged, steps),
        action=chunks(transitions.action, steps),
        log_prob=chunks(transitions.log_prob, steps),
        advantage=chunks(advantage, steps),
        target=chunks(target, steps),
        old_value=chunks(pair[0], steps),
        active=chunks(active, steps),
    )
    return batch, value_normalizer, metrics


def _loss(
    params: Params,
    network: Network,
    config: TrainConfig,
    now: Scheduled,
    value_normalizer: ValueStatistics,
    batch: Batch,
) -> tuple[jax.Array, Metrics]:
    """Returns the PPO loss () of a minibatch and its parts, means over active agents."""
    ppo, active = config.ppo, batch.active
    seen = batch.memory, batch.is_first, batch.obs, batch.privileged_obs
    new = network.evaluate(params, *seen, batch.action, active)
    old, now_taken = (jnp.where(active[..., None], x, 0.0) for x in (batch.log_prob, new.log_prob))
    log_ratio = RATIOS[ppo.ratio](now_taken, old)
    surrogate = clipped_surrogate(log_ratio, batch.advantage[..., None], ppo.clip, ppo.dual_clip)
    policy_loss = _mean(jnp.sum(surrogate, axis=-1), active)
    target = value_normalize(value_normalizer, batch.target)
    critic_loss = _mean(value_loss(new.value, batch.old_value, target, ppo.value_clip, ppo.huber_delta), active)
    mean_entropy = _mean(new.entropy, active)
    per_agent = RATIOS["agent"](now_taken, old)[..., 0]
    metrics = {
        "loss/policy": policy_loss,
        "loss/value": critic_loss,
        "entropy": mean_entropy,
        "approx_kl": _mean(jnp.exp(per_agent) - 1.0 - per_agent, active),
        "clip_fraction": _mean((jnp.abs(jnp.exp(log_ratio) - 1.0) > ppo.clip).astype(jnp.float32), active),
    }
    metrics |= {f"loss/{name}": value for name, value in new.losses.items()}
    actor_loss = policy_loss - now.entropy_coef * mean_entropy + sum(new.losses.values())
    if config.imitation.teacher is not None:
        taught = network.evaluate(params, *seen, batch.teacher_action, active)
        metrics["loss/imitation"] = -_mean(jnp.sum(taught.log_prob, axis=-1), active)
        actor_loss += now.imitation * metrics["loss/imitation"]
    return now.actor_coef * actor_loss + ppo.value_coef * critic_loss, metrics


def _mean(x: jax.Array, active: jax.Array) -> jax.Array:
    """Returns the mean over active agents of values (L, C, A, ...); of a team's, (L, C, 1, ...), over teams with any.

    The count is a mean over processes, over which the gradient is averaged.
    """
    mask = active if x.shape[:3] == active.shape else jnp.any(active, axis=-1, keepdims=True)
    mask = jnp.broadcast_to(mask.reshape(*mask.shape, *(1,) * (x.ndim - mask.ndim)), x.shape)
    count = devices.mean(jnp.sum(mask.astype(jnp.float32)))
    return jnp.sum(jnp.where(mask, x, 0.0)) / jnp.maximum(count, 1.0)


def _adapted(learning_rate: jax.Array, kl: jax.Array, target_kl: float) -> jax.Array:
    """Returns a smaller learning rate where the KL divergence exceeds the target, a larger one where it is below."""
    factor = jnp.where(kl > 2.0 * target_kl, 1.0 / _ADAPTATION, jnp.where(kl < 0.5 * target_kl, _ADAPTATION, 1.0))
    return jnp.clip(learning_rate * factor, *_LEARNING_RATE_RANGE)


def _learn(
    network: Network,
    optimizer: Optimizer,
    config: TrainConfig,
    now: Scheduled,
    state: TrainState,
    value_normalizer: ValueStatistics,
    batch: Batch,
    key: jax.Array,
) -> tuple[Params, AdamState, jax.Array, Metrics]:
    """Runs the epochs over the batch; returns parameters, optimiser state, learning rate and mean metrics."""
    parts = config.rollout_steps // batch.is_first.shape[0]

    def step(carry: Carry, minibatch: Batch) -> tuple[Carry, Metrics]:
        params, optimizer_state, learning_rate = carry
        own = jax.grad(_loss, has_aux=True)(params, network, config, now, value_normalizer, minibatch)
        gradient, metrics = devices.mean(own)
        if config.optimizer.target_kl is not None:
            adapted = _adapted(learning_rate, metrics["approx_kl"], config.optimizer.target_kl)
            falls_only = (now.learning_rate_factor < 1.0) | (jnp.float32(now.actor_coef) < 1.0)
            learning_rate = jnp.where(falls_only, jnp.minimum(adapted, learning_rate), adapted)
        params, optimizer_state, grad_norm = optimizer.update(
            gradient, optimizer_state, params, learning_rate * now.learning_rate_factor
        )
        return (params, optimizer_state, learning_rate), {**metrics, "grad_norm": grad_norm}

    def epoch(carry: Carry, epoch_key: jax.Array) -> tuple[Carry, Metrics]:
        if config.ppo.minibatches == 1:
            return step(carry, batch)
        index = minibatches(config.ppo, epoch_key, parts, batch.is_first.shape[1] // parts)
        carry, metrics = jax.lax.scan(lambda c, i: step(c, take(batch, i)), carry, index)
        return carry, jax.tree.map(jnp.mean, metrics)

    carry = (state.params, begun_anew(state.optimizer, now.actor_begins), state.learning_rate)
    carry, metrics = jax.lax.scan(epoch, carry, jax.random.split(key, config.ppo.epochs))
    params, optimizer_state, learning_rate = carry
    metrics = jax.tree.map(jnp.mean, metrics)
    metrics["learning_rate"] = learning_rate * now.learning_rate_factor
    return params, optimizer_state, learning_rate, metrics
