"""A custom network: each actor's input is the agent's observation and the mean of all agents'
encoded observations.

`python examples/custom_network.py` trains it for a minute on a CPU, on the environment of
foreign_env.py. Once registered, it is selected by `network: {name: mean_field}` in YAML like the
package's networks.
"""

from __future__ import annotations

import foreign_env
import jax
import jax.numpy as jnp

from mqe_jax.core.settings import PositiveInt
from mqe_jax.core.types import NetworkMemory
from mqe_jax.train import nn
from mqe_jax.train.loss import entropy, log_prob
from mqe_jax.train.networks import ChunkResult, EnvDims, Network, NetworkSettings, register_network


@register_network("mean_field")
class MeanField(NetworkSettings):
    """Settings of the network."""

    width: PositiveInt = 32
    """Width of the hidden layers."""

    def build(self, dims: EnvDims) -> Network:
        """Returns the network for an environment."""

        def init(key):
            sizes = {
                "encoder": (dims.observation, self.width),
                "actor": (2 * self.width, self.width, dims.action),
                "critic": (2 * self.width, self.width, 1),
            }
            keys = jax.random.split(key, 3)
            params = {
                name: nn.mlp_init(k, sizes[name], final_scale=0.1)
                for k, name in zip(keys, sizes, strict=True)
            }
            return {**params, "log_std": jnp.full(dims.action, -0.5)}

        def encode(params, obs, active):
            own = nn.mlp(params["encoder"], obs, activate_last=True)
            mean = own.mean(-2, keepdims=True, where=True if active is None else active[..., None])
            return jnp.concatenate([own, jnp.broadcast_to(mean, own.shape)], axis=-1)

        def act(params, memory, obs, key, active=None):
            mean = nn.mlp(params["actor"], encode(params, obs, active))
            noise = (
                0.0
                if key is None
                else jnp.exp(params["log_std"]) * jax.random.normal(key, mean.shape)
            )
            return mean + noise, log_prob(mean + noise, mean, params["log_std"]), memory

        def value(params, memory, is_first, obs, privileged, active=None):
            return nn.mlp(params["critic"], encode(params, obs, active))[..., 0], memory

        def evaluate(params, memory, is_first, obs, privileged, action, active=None):
            mean = nn.mlp(params["actor"], encode(params, obs, active))
            spread = jnp.broadcast_to(params["log_std"], mean.shape)
            values, _ = value(params, (), is_first, obs, privileged, active)
            return ChunkResult(log_prob(action, mean, spread), entropy(spread), values)

        def policy_params(params):
            return {name: params[name] for name in ("encoder", "actor", "log_std")}

        return Network(
            init, policy_params, lambda num_envs: NetworkMemory((), ()), act, value, evaluate
        )


if __name__ == "__main__":
    history = foreign_env.main(network={"name": "mean_field", "width": 64})
    print(
        f"distance at the end of an episode: {history[0]:.2f} m before, {history[-1]:.2f} m after"
    )
