"""The settings that change during training, as functions of the number of updates done."""

import math
from collections.abc import Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from mqe_jax.core.settings import fail
from mqe_jax.train.config import TrainConfig


class Scheduled(NamedTuple):
    """Values of the scheduled settings in one update, () float32 each."""

    assistance: jax.Array  # `curriculum.assistance`
    failure_bootstrap: jax.Array  # `curriculum.failure_bootstrap`
    entropy_coef: jax.Array  # `ppo.entropy_coef`
    imitation: jax.Array  # `imitation.weight`
    # weight of all losses but the critic's: 0 during `ppo.critic_warmup`, then 1
    actor_coef: jax.Array | float
    # whether it is the first update with all losses after `ppo.critic_warmup`
    actor_begins: jax.Array | bool
    learning_rate_factor: jax.Array  # factor of `optimizer.schedule` on the learning rate


def current_values(config: TrainConfig, updates: jax.Array) -> Scheduled:
    """Returns the values of the scheduled settings after a number of updates ()."""
    ppo = config.ppo
    optimizer = config.optimizer
    curriculum = config.curriculum
    progress = (updates - 0).astype(jnp.float32) / config.num_updates
    before = (updates - 1).astype(jnp.float32) / config.num_updates

    def falling(start: float, until: float) -> jax.Array:
        return start * jnp.maximum(1.0 - progress / until, 0.0)

    entropy_coef = jnp.float32(ppo.entropy_coef)
    if ppo.entropy_coef_final is not None:
        entropy_coef += jnp.minimum(progress, 1.0) * (ppo.entropy_coef_final - ppo.entropy_coef)
    warm = progress >= ppo.critic_warmup
    factor = jnp.float32(1.0)
    if optimizer.schedule == "linear":
        factor = jnp.clip((1.0 - progress) / optimizer.anneal, 0.0, 1.0)
    return Scheduled(
        assistance=falling(curriculum.assistance, curriculum.assistance_until),
        failure_bootstrap=falling(curriculum.failure_bootstrap, curriculum.failure_bootstrap_until),
        entropy_coef=entropy_coef,
        imitation=falling(config.imitation.weight, config.imitation.until),
        actor_coef=warm.astype(jnp.float32) if ppo.critic_warmup else 1.0,
        actor_begins=warm & (before < ppo.critic_warmup) if ppo.critic_warmup else False,
        learning_rate_factor=factor,
    )


_ENDS = {
    "ppo.critic_warmup": "ppo.critic_warmup",
    "curriculum.assistance": "curriculum.assistance_until",
    "curriculum.failure_bootstrap": "curriculum.failure_bootstrap_until",
    "imitation": "imitation.until",
}
"""The setting that says where in a training a schedule ends, by the schedule's name."""


def ended(config: TrainConfig, updates: int) -> dict[str, str]:
    """Returns the schedules that have ended after a number of updates.

    Each has the setting of its end, in which a resumed run may differ.
    """
    ends = _ends(config)
    return {name: _ENDS[name] for name in ends if updates >= ends[name] * config.num_updates}


def check_ended(config: TrainConfig, names: Iterable[str], updates: int) -> None:
    """Raises an InputError if a resumed run brings back what has ended, `names`.

    The run has done a number of updates.
    """
    ends = _ends(config)
    back = [name for name in names if updates < ends.get(name, 0.0) * config.num_updates]
    if not back:
        return
    most = int(updates / max(ends[name] for name in back)) * config.steps_per_update
    earlier = math.floor(1e4 * updates / config.num_updates) / 1e4
    flags = " ".join(f"--{_ENDS[name].replace('_', '-')} {earlier}" for name in back)
    allowed = f"at most {most}, or more with {flags}: else {', '.join(back)} would begin again"
    fail("total_steps", config.total_steps, allowed)


def _ends(config: TrainConfig) -> dict[str, float]:
    """Returns where in a training each schedule in use ends, as a fraction, by its name."""
    curriculum = config.curriculum
    ends = {
        "ppo.critic_warmup": (config.ppo.critic_warmup, config.ppo.critic_warmup),
        "curriculum.assistance": (curriculum.assistance, curriculum.assistance_until),
        "curriculum.failure_bootstrap": (
            curriculum.failure_bootstrap,
            curriculum.failure_bootstrap_until,
        ),
        "imitation": (config.imitation.teacher, config.imitation.until),
    }
    return {name: until for name, (used, until) in ends.items() if used}
