"""The stages of an update of the learner: advantages, loss, gradient steps."""

from typing import Any

import jax
import jax.numpy as jnp

from mqe_jax.core import devices
from mqe_jax.core.types import Batch, Params, Transition
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.loss import RATIOS, clipped_surrogate, gae, value_loss, where_used
from mqe_jax.train.networks import Network
from mqe_jax.train.optim import AdamState, adam
from mqe_jax.train.rollout import mean_of_team, minibatches, take
from mqe_jax.train.schedules import Scheduled

Metrics = dict[str, Any]
Carry = tuple[Params, AdamState, jax.Array]
"""What gradient steps change: parameters, optimiser state, learning rate () before the schedule."""

_LEARNING_RATE_RANGE = (1e-5, 1e-2)
_ADAPTATION = 1.5


class Stages:
    """The stages of PPO: pure functions, which a subclass overrides for another algorithm.

    `mqe_jax.train.algorithms` registers such a subclass.

    Example:
        ```python
        from mqe_jax.train.stages import Stages

        class Logged(Stages):
            def loss(self, params, batch, now):
                loss, metrics = super().loss(params, batch, now)
                return loss, {**metrics, "loss/whole": loss}
        ```
    """

    def __init__(self, network: Network, config: TrainConfig) -> None:
        self.network = network
        self.config = config
        self.optimizer = adam(
            eps=config.optimizer.eps, max_grad_norm=config.optimizer.max_grad_norm
        )

    def value_mask(self, learners: jax.Array) -> jax.Array:
        """Returns which values (..., V) count.

        `learners` (..., A) says from which agents the policy learns.
        """
        return (
            jnp.any(learners, axis=-1, keepdims=True)
            if self.config.ppo.value == "joint"
            else learners
        )

    def advantages(
        self, now: Scheduled, transitions: Transition, value: jax.Array, next_value: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Returns the advantages and the value targets of a rollout (T, N, V), in units of reward.

        `value` are those of the observations and `next_value` those of the states that the steps
        reached (T, N, V).
        """
        config = self.config
        active = transitions.active
        reward = jnp.where(active, transitions.reward, jnp.zeros_like(transitions.reward))
        counted = self.value_mask(transitions.active)
        if config.ppo.value == "joint":
            reward = mean_of_team(reward, active)[..., None]
        advantage, target = gae(
            reward,
            value,
            next_value,
            transitions.terminated.astype(jnp.float32) * (1.0 - now.failure_bootstrap),
            transitions.done,
            gamma=config.ppo.gamma,
            gae_lambda=config.ppo.gae_lambda,
        )
        if config.normalization.advantages:
            deviation = jnp.sqrt(devices.variance(advantage, counted))
            advantage = (advantage - devices.mean_where(advantage, counted)) / (deviation + 1e-8)
        return advantage, target

    def loss(self, params: Params, batch: Batch, now: Scheduled) -> tuple[jax.Array, Metrics]:
        """Returns the PPO loss () of a minibatch and its parts.

        These are means over the agents that learn.
        """
        network = self.network
        config = self.config
        ppo = self.config.ppo
        learners = batch.learners
        seen = batch.memory, batch.is_first, batch.obs, batch.privileged_obs

        def evaluate(action):
            return network.evaluate(params, *seen, action, batch.active)

        if config.imitation.teacher is None:
            new = evaluate(batch.action)
            teacher_log_prob = None
        else:  # what depends on no action is computed once
            size = batch.teacher_action.shape[-1]
            label = batch.action.at[..., :size].set(batch.teacher_action)
            both = jax.vmap(evaluate)(jnp.stack([batch.action, label]))
            new = jax.tree.map(lambda x: x[0], both)
            teacher_log_prob = where_used(both.log_prob[1], batch.used)[..., :size]
        new_log_prob = where_used(new.log_prob, batch.used)
        entropies = jnp.sum(where_used(new.entropy, batch.used), axis=-1)
        old = jnp.where(learners[..., None], batch.log_prob, 0.0)
        now_taken = jnp.where(learners[..., None], new_log_prob, 0.0)
        log_ratio = RATIOS[ppo.ratio](now_taken, old)
        surrogate = clipped_surrogate(
            log_ratio, batch.advantage[..., None], ppo.clip, ppo.dual_clip
        )
        policy_loss = _mean(jnp.sum(surrogate, axis=-1), learners)
        error = value_loss(
            new.value, batch.old_value, batch.target, ppo.value_clip, ppo.huber_delta
        )
        critic_loss = _mean(error, learners)
        mean_entropy = _mean(entropies, learners)
        per_agent = RATIOS["agent"](now_taken, old)[..., 0]
        metrics = {
            "loss/policy": policy_loss,
            "loss/value": critic_loss,
            "entropy": mean_entropy,
            "approx_kl": _mean(jnp.exp(per_agent) - 1.0 - per_agent, learners),
            "clip_fraction": _mean(
                (jnp.abs(jnp.exp(log_ratio) - 1.0) > ppo.clip).astype(jnp.float32), learners
            ),
        }
        metrics |= {f"loss/{name}": value for name, value in new.losses.items()}
        actor_loss = policy_loss - now.entropy_coef * mean_entropy + sum(new.losses.values())
        if teacher_log_prob is not None:
            metrics["loss/imitation"] = -_mean(jnp.sum(teacher_log_prob, axis=-1), learners)
            actor_loss += now.imitation * metrics["loss/imitation"]
        return now.actor_coef * actor_loss + ppo.value_coef * critic_loss, metrics

    def update(
        self, carry: Carry, batch: Batch, now: Scheduled, key: jax.Array
    ) -> tuple[Carry, Metrics]:
        """Runs the epochs of gradient steps over a rollout's batch.

        Returns their result and mean metrics.
        """
        config = self.config
        parts = config.rollout_steps // batch.is_first.shape[0]
        begun = carry[1].updates

        def step(carry: Carry, minibatch: Batch) -> tuple[Carry, Metrics]:
            params, optimizer_state, learning_rate = carry
            own = jax.grad(self.loss, has_aux=True)(params, minibatch, now)
            gradient, metrics = devices.mean(own)
            target_kl = config.optimizer.target_kl
            if target_kl is not None:
                initial = config.optimizer.learning_rate
                adapted = _adapt(learning_rate, metrics["approx_kl"], target_kl, initial)
                falls_only = (now.learning_rate_factor < 1.0) | (jnp.float32(now.actor_coef) < 1.0)
                adapted = jnp.where(falls_only, jnp.minimum(adapted, learning_rate), adapted)
                # The first gradient step starts from the policy that acted.
                first = optimizer_state.updates == begun
                learning_rate = jnp.where(first, learning_rate, adapted)
            params, optimizer_state, grad_norm = self.optimizer.update(
                gradient, optimizer_state, params, learning_rate * now.learning_rate_factor
            )
            return (params, optimizer_state, learning_rate), {**metrics, "grad_norm": grad_norm}

        def epoch(carry: Carry, epoch_key: jax.Array) -> tuple[Carry, Metrics]:
            if config.ppo.minibatches == 1:
                return step(carry, batch)
            index = minibatches(config.ppo, epoch_key, parts, batch.is_first.shape[1] // parts)
            carry, metrics = jax.lax.scan(lambda c, i: step(c, take(batch, i)), carry, index)
            return carry, jax.tree.map(jnp.mean, metrics)

        carry, metrics = jax.lax.scan(epoch, carry, jax.random.split(key, config.ppo.epochs))
        return carry, jax.tree.map(jnp.mean, metrics)


def _mean(x: jax.Array, learners: jax.Array) -> jax.Array:
    """Returns the mean over learners of values (L, C, A, ...).

    Values (L, C, 1, ...) are those of teams, of which each with a learner counts. The count is a
    mean over processes, over which the gradient is averaged.
    """
    mask = learners if x.shape[:3] == learners.shape else jnp.any(learners, axis=-1, keepdims=True)
    mask = jnp.broadcast_to(mask.reshape(*mask.shape, *(1,) * (x.ndim - mask.ndim)), x.shape)
    count = devices.mean(jnp.sum(mask.astype(jnp.float32)))
    return jnp.sum(jnp.where(mask, x, 0.0)) / jnp.maximum(count, 1.0)


def _adapt(learning_rate: jax.Array, kl: jax.Array, target_kl: float, initial: float) -> jax.Array:
    """Returns a learning rate that keeps the KL divergence near its target.

    It falls if the divergence is above twice the target, and rises if below half of it. Its range
    includes the `initial` rate.
    """
    factor = jnp.where(
        kl > 2.0 * target_kl, 1.0 / _ADAPTATION, jnp.where(kl < 0.5 * target_kl, _ADAPTATION, 1.0)
    )
    rates = *_LEARNING_RATE_RANGE, initial
    return jnp.clip(learning_rate * factor, min(rates), max(rates))
