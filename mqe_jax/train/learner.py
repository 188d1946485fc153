"""Multi-agent PPO as one pure function from a learner state to the next.

A rollout of all environments, advantages, then epochs of minibatches. MAPPO, JRPO, independent PPO
and their variants differ in the ratio that PPO clips, the value (per agent or per team) and the
network; all three are settings.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mqe_jax.acting.seats import Seats
from mqe_jax.core import devices
from mqe_jax.core.precision import single
from mqe_jax.core.settings import fail
from mqe_jax.core.types import (
    Batch,
    Matchmaker,
    Params,
    PyTree,
    Transition,
    VectorEnv,
    replace_fields,
)
from mqe_jax.train.checks import check_divisible, check_environment, check_teacher
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.needs import needs_of
from mqe_jax.train.normalize import (
    Features,
    ValueStatistics,
    running_init,
    running_update,
    value_denormalize,
    value_init,
    value_normalize,
    value_update,
)
from mqe_jax.train.optim import AdamState, restart
from mqe_jax.train.rollout import (
    ObservationNormalizer,
    RolloutState,
    chunks,
    normalize_obs,
    rollout,
)
from mqe_jax.train.schedules import Scheduled, current_values
from mqe_jax.train.stages import Metrics, Stages


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrainState:
    """Complete learner state.

    Restoring it resumes training exactly (bit for bit on deterministic backends).
    """

    params: Params
    optimizer: AdamState
    obs_normalizer: ObservationNormalizer
    value_normalizer: ValueStatistics
    learning_rate: jax.Array  # learning rate before the schedule () float32
    rollout: RolloutState
    key: jax.Array  # random key
    updates: jax.Array  # updates done () int32
    extra: PyTree = ()  # state of the league (`mqe_jax.core.types.Matchmaker`); empty without one


class Learner(NamedTuple):
    """A training as two pure functions, which the caller jits.

    `init(key) -> TrainState`; `update(TrainState) -> (TrainState, metrics)`.
    """

    init: Callable[[jax.Array], TrainState]
    update: Callable[[TrainState], tuple[TrainState, Metrics]]


def make_learner(
    env: VectorEnv,
    config: TrainConfig,
    *,
    league: Matchmaker | None = None,
    teacher: Any = None,
    processes: int = 1,
) -> Learner:
    """Returns the learner of an environment; InputError if the settings do not fit it.

    Of several `processes`, `env` is the share of one, and `devices.Processes` compiles the
    functions. `teacher` is the policy that `imitation` imitates.
    """
    dims = needs_of(env, config).dims
    check_environment(env, config, dims, processes)
    check_teacher(config, teacher)
    guide = None if teacher is None else Seats.of(env, teacher)
    network = config.network.build(dims)
    features = config.network.features(dims)
    check_divisible(config, network, processes)
    algorithm = config.stages.build(network, config)
    if not isinstance(algorithm, Stages):
        fail("stages", algorithm, "what build returns: mqe_jax.train.stages.Stages or a subclass")
    # messages are not imitated
    moving = getattr(getattr(env, "env", env), "moving", lambda action: action)

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
                optimizer=algorithm.optimizer.init(params),
                obs_normalizer=ObservationNormalizer(
                    running_init(dims.observation, features), running_init(dims.privileged)
                ),
                value_normalizer=value_init(config.normalization.values),
                learning_rate=jnp.float32(config.optimizer.learning_rate),
                rollout=RolloutState(
                    env_state=env_state,
                    memory=network.initial_memory(env.num_envs),
                    is_first=jnp.ones((env.num_envs,), bool),
                    episode_steps=jnp.zeros((env.num_envs,), jnp.int32),
                    episode_return=jnp.zeros((env.num_envs,)),
                    teacher_memory=() if guide is None else guide.initial_memory(env.num_envs)[0],
                ),
                key=key,
                updates=jnp.zeros((), jnp.int32),
            )
        )
        return (
            state
            if league is None
            else league.seat(dataclasses.replace(state, extra=league.begin(state)))
        )

    @single
    def update(state: TrainState) -> tuple[TrainState, Metrics]:
        key, rollout_key, epoch_key = jax.random.split(state.key, 3)
        now = current_values(config, state.updates)
        rollout_state, transitions, metrics = rollout(
            env,
            network,
            state.params,
            state.obs_normalizer,
            _set_assistance(state.rollout, now.assistance)
            if config.curriculum.assistance
            else state.rollout,
            rollout_key,
            config.rollout_steps,
            normalize=config.normalization.observations,
            features=features,
            action_scale=config.action_scale,
            group=config.group,
            teacher=guide,
        )
        batch, value_normalizer, batch_metrics = _prepare(
            algorithm, now, state, transitions, features
        )
        if guide is not None:
            labels = moving(transitions.teacher_action) / config.action_scale
            batch = batch._replace(teacher_action=chunks(labels, network.chunk_length))
        carry = state.params, restart(state.optimizer, now.actor_begins), state.learning_rate
        with jax.named_scope("learner"):
            carry, loss_metrics = algorithm.update(carry, batch, now, epoch_key)
        params, optimizer_state, learning_rate = carry
        loss_metrics["learning_rate"] = learning_rate * now.learning_rate_factor
        obs_normalizer = state.obs_normalizer
        if config.normalization.observations:
            some = jnp.any(transitions.active, axis=-1)
            obs_normalizer = ObservationNormalizer(
                running_update(obs_normalizer.obs, transitions.obs, transitions.active, features),
                running_update(obs_normalizer.privileged, transitions.privileged_obs, some),
            )
        new_state = TrainState(
            params=params,
            optimizer=optimizer_state,
            obs_normalizer=obs_normalizer,
            value_normalizer=value_normalizer,
            learning_rate=learning_rate,
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


def _set_assistance(state: RolloutState, assistance: jax.Array) -> RolloutState:
    """Sets the assistance of every environment, which takes effect with its next episode."""
    env_state = replace_fields(
        state.env_state, assistance=jnp.full_like(state.env_state.assistance, assistance)
    )
    return state._replace(env_state=env_state)


def _stagger(env: VectorEnv, env_state: Any, key: jax.Array) -> Any:
    """Sets every environment's step counter to a random value.

    The first episodes then end at different steps.
    """
    limit: int = getattr(env, "max_episode_steps")  # noqa: B009

    def draw(n):
        return jax.random.randint(key, (n,), 0, limit, env_state.step.dtype)

    step = devices.rows(draw, len(env_state.step))
    return replace_fields(env_state, step=step)


def _strongly_typed(state: TrainState) -> TrainState:
    """Removes weak types from a state, so that JAX traces `update` once.

    The input and output states of `update` then have the same types.
    """
    return jax.tree.map(lambda x: jax.lax.convert_element_type(x, x.dtype), state)


def _prepare(
    stages: Stages,
    now: Scheduled,
    state: TrainState,
    transitions: Transition,
    features: Features | None,
) -> tuple[Batch, ValueStatistics, Metrics]:
    """Computes values, advantages and targets of a rollout and splits it into chunks (L, C, ...).

    The critic evaluates each step's observation and final observation as a chunk of two, batched
    over all steps. The next value then uses the recurrent state after the step's observation, even
    if the episode ended there.
    """
    network = stages.network
    config = stages.config
    active = transitions.active
    normalize = config.normalization.observations
    obs, privileged = normalize_obs(
        state.obs_normalizer,
        transitions.obs,
        transitions.privileged_obs,
        active,
        normalize,
        features,
    )
    # What the critic does not read may be missing; these observations take its place.
    last = transitions.obs if transitions.final_obs is None else transitions.final_obs
    last_privileged = transitions.final_privileged_obs
    last_privileged = transitions.privileged_obs if last_privileged is None else last_privileged
    final_obs, final_privileged = normalize_obs(
        state.obs_normalizer, last, last_privileged, active, normalize, features
    )
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
    advantage, target = stages.advantages(now, transitions, value, next_value)
    counted = stages.value_mask(transitions.active)
    if config.normalization.values:
        value_normalizer = value_update(
            value_normalizer, target, counted, config.normalization.value_decay
        )
    unexplained = devices.variance(target - value, counted) / jnp.maximum(
        devices.variance(target, counted), 1e-8
    )
    metrics = {
        "value_mean": devices.mean_where(value, counted),
        "explained_variance": 1.0 - unexplained,
    }
    steps = network.chunk_length
    batch = Batch(
        memory=jax.tree.map(lambda x: x[::steps].reshape(-1, *x.shape[2:]), transitions.memory),
        is_first=chunks(transitions.is_first, steps),
        obs=chunks(obs, steps),
        privileged_obs=chunks(privileged, steps),
        action=chunks(transitions.action, steps),
        log_prob=chunks(transitions.log_prob, steps),
        advantage=chunks(advantage, steps),
        target=chunks(value_normalize(value_normalizer, target), steps),
        old_value=chunks(pair[0], steps),
        active=chunks(active, steps),
        learners=chunks(transitions.active, steps),
        used=None if transitions.used is None else chunks(transitions.used, steps),
    )
    return batch, value_normalizer, metrics
