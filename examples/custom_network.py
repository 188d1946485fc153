"""A custom network: its actors see the mean of all agents' encoded observations.

Each actor's input is the agent's observation beside that mean. `python examples/custom_network.py`
trains it for a minute on a CPU, on the environment of foreign_env.py. Once it is registered,
`network: {name: mean_field}` in YAML selects it like the package's networks.
"""

from __future__ import annotations

import foreign_env
import jax
import jax.numpy as jnp

from mqe_jax.core.settings import PositiveInt
from mqe_jax.core.types import NetworkMemory, Params
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
            params: Params = {"log_std": jnp.full(dims.action, -0.5)}
            for name, own_key in zip(sizes, jax.random.split(key, 3), strict=True):
                params[name] = nn.mlp_init(own_key, sizes[name], final_scale=0.1)
            return params

        def encode(params, obs, active):
            own = nn.mlp(params["encoder"], obs, activate_last=True)
            mean = own.mean(-2, keepdims=True, where=True if active is None else active[..., None])
            return jnp.concatenate([own, jnp.broadcast_to(mean, own.shape)], axis=-1)

        def act(params, memory, obs, key, active=None):
            mean = nn.mlp(params["actor"], encode(params, obs, active))
            action = mean
            if key is not None:
                action += jnp.exp(params["log_std"]) * jax.random.normal(key, mean.shape)
            return action, log_prob(action, mean, params["log_std"]), memory

        def value(params, memory, is_first, obs, privileged, active=None):
            return nn.mlp(params["critic"], encode(params, obs, active))[..., 0], memory

        def evaluate(params, memory, is_first, obs, privileged, action, active=None):
            mean = nn.mlp(params["actor"], encode(params, obs, active))
            spread = jnp.broadcast_to(params["log_std"], mean.shape)
            values, _ = value(params, (), is_first, obs, privileged, active)
            return ChunkResult(log_prob(action, mean, spread), entropy(spread), values)

        def policy_params(params):
            return {name: params[name] for name in ("encoder", "actor", "log_std")}

        def initial_memory(num_envs):
            return NetworkMemory((), ())

        return Network(init, policy_params, initial_memory, act, value, evaluate)


if __name__ == "__main__":
    first, *_, last = foreign_env.main(network={"name": "mean_field", "width": 64})
    print(f"distance at the end of an episode: {first:.2f} m before, {last:.2f} m after")
