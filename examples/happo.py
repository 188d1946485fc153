"""HAPPO: each agent has its own actor, and the actors learn one after the other.

The advantage of an actor's turn is multiplied by the probability ratios of the agents that have had
theirs, so that it responds to what they do now. Source: Kuba et al., arXiv 2109.11251. `python
examples/happo.py` trains Narrow Gate; a few minutes on a CPU. Once registered, it is selected by
`stages: {name: happo}` in YAML.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

import mqe_jax
from mqe_jax.core.types import Batch, where_rows
from mqe_jax.train.algorithms import StagesSettings, register_stages
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.loss import ratio_per_agent
from mqe_jax.train.networks import Network
from mqe_jax.train.schedules import Scheduled
from mqe_jax.train.stages import Carry, Metrics, Stages

SETTINGS = {
    "stages.name": "happo",
    "network.share_policy": False,
    "network.critic_input": "privileged",
    "ppo.value": "joint",
}


@register_stages("happo")
class Happo(StagesSettings):
    """Settings of the algorithm."""

    random_order: bool = True
    """Draw the order of the agents' turns for every update; else they keep that of their ids."""

    def build(self, network: Network, config: TrainConfig) -> Stages:
        """Returns the stages of a training."""
        return Turns(network, config, random_order=self.random_order)


class Turns(Stages):
    """An update in a turn of each agent; the critic learns in every turn."""

    def __init__(self, network: Network, config: TrainConfig, *, random_order: bool) -> None:
        super().__init__(network, config)
        self.random_order = random_order

    def update(
        self, carry: Carry, batch: Batch, now: Scheduled, key: jax.Array
    ) -> tuple[Carry, Metrics]:
        agents = batch.active.shape[-1]
        order_key, key = jax.random.split(key)
        order = jnp.arange(agents)
        if self.random_order:
            order = jax.random.permutation(order_key, agents)

        def turn(before: tuple[Carry, jax.Array], inputs: tuple[jax.Array, jax.Array]) -> Any:
            carry, factor = before
            agent, key = inputs
            mine = jnp.arange(agents) == agent
            advantage = batch.advantage * factor[..., None]
            own = batch._replace(advantage=advantage, learners=batch.learners & mine)
            learned, metrics = super(Turns, self).update(carry, own, now, key)
            learned = self._of(mine, learned, carry)
            return (learned, factor * self._ratio(learned, batch)[..., agent]), metrics

        start = (carry, jnp.ones(batch.is_first.shape))
        (carry, _), metrics = jax.lax.scan(turn, start, (order, jax.random.split(key, agents)))
        return carry, jax.tree.map(jnp.mean, metrics)

    def _of(self, mine: jax.Array, learned: Carry, before: Carry) -> Carry:
        """Returns what was learned, without the other agents' actors; `mine` is (A,).

        Adam's moments would still move those.
        """

        def of(new: Any, old: Any) -> Any:
            actors = self.network.policy_params(new)
            return {**new, **where_rows(mine, actors, self.network.policy_params(old))}

        params, adam, rate = learned
        old_params, old_adam, _ = before
        mean = of(adam.mean, old_adam.mean)
        square = of(adam.square, old_adam.square)
        return of(params, old_params), adam._replace(mean=mean, square=square), rate

    def _ratio(self, carry: Carry, batch: Batch) -> jax.Array:
        """Returns the ratios of the actions' probabilities now and at collection (L, C, A)."""
        seen = (batch.memory, batch.is_first, batch.obs, batch.privileged_obs)
        new = self.network.evaluate(carry[0], *seen, batch.action, batch.active)
        ratio = jnp.exp(ratio_per_agent(new.log_prob, batch.log_prob)[..., 0])
        return jnp.where(batch.learners, ratio, 1.0)


def main(updates: int = 20, **settings: object) -> list[float]:
    """Trains, and returns the average step reward after every update."""
    init, update = mqe_jax.make_learner("go1gate", {"config": "demo", **SETTINGS, **settings})
    state = jax.jit(init)(jax.random.PRNGKey(0))
    step = jax.jit(update)
    rewards = []
    for _ in range(updates):
        state, metrics = step(state)
        rewards.append(float(metrics["average_step_reward"]))
    return rewards


if __name__ == "__main__":
    for number, reward in enumerate(main(), start=1):
        print(f"update {number}: {reward:+.4f}")
