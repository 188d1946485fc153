"""The network `actor_critic`: actors and critic of dense layers, optionally recurrent.

The critic is centralised or decentralised.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from mqe_jax.core import devices, keys
from mqe_jax.core.settings import fail
from mqe_jax.core.types import Mask, Memory, NetworkMemory, Params
from mqe_jax.train import nn
from mqe_jax.train.encoder import Encoder, by_block, of_team, plain
from mqe_jax.train.loss import entropy, log_prob
from mqe_jax.train.networks import ActorCritic, Blocks, ChunkResult, EnvDims, Network

_ACTIVATIONS: dict[str, Callable[[jax.Array], jax.Array]] = {
    "relu": jax.nn.relu,
    "elu": jax.nn.elu,
    "tanh": jnp.tanh,
}


def _trunk_init(
    key: jax.Array, encoder: Encoder, n_out: int, final_scale: float, settings: ActorCritic
) -> Params:
    hidden_key, gru_key, head_key = jax.random.split(key, 3)
    width = settings.hidden_sizes[-1]
    params: Params = {
        "hidden": nn.mlp_init(
            hidden_key, (encoder.size, *settings.hidden_sizes), final_scale=math.sqrt(2.0)
        ),
        "head": nn.dense_init(
            head_key, settings.gru_size if settings.recurrent else width, n_out, final_scale
        ),
    }
    if settings.recurrent:
        params["gru"] = nn.gru_init(gru_key, width, settings.gru_size)
    if settings.openrl_layers:
        linear_key = jax.random.fold_in(hidden_key, keys.LINEAR)
        params["linear"] = nn.dense_init(linear_key, width, width)
        widths = (
            *settings.hidden_sizes,
            width,
            *((settings.gru_size,) if settings.recurrent else ()),
        )
        params["norm"] = {str(i): nn.layer_norm_init(size) for i, size in enumerate(widths)}
    encoder_key = jax.random.fold_in(key, keys.ENCODER) if settings.recurrent else gru_key
    if encoded := encoder.init(encoder_key):
        params["encoder"] = encoded
    return params


def _hidden(params: Params, x: jax.Array, settings: ActorCritic) -> jax.Array:
    """Applies the hidden layers, without the last normalisation: (B, n_in) -> (B, width)."""
    activation = _ACTIVATIONS[settings.activation]
    if not settings.openrl_layers:
        return nn.mlp(params["hidden"], x, activation, activate_last=True)
    x = activation(nn.dense(params["hidden"]["0"], x))
    for i in range(1, len(settings.hidden_sizes)):
        norm = params["norm"][str(i - 1)]
        x = activation(nn.norm_dense(norm, params["hidden"][str(i)], x))
    return nn.norm_dense(params["norm"][str(len(settings.hidden_sizes) - 1)], params["linear"], x)


def _trunk(
    params: Params,
    memory: Memory,
    is_first: jax.Array,
    x: jax.Array,
    encoder: Encoder,
    settings: ActorCritic,
) -> tuple[jax.Array, Memory]:
    """Runs the layers over L steps: x (L, ..., n_in) -> (L, ..., n_out), memory.

    The recurrent state `memory` is (..., H) or (). It restarts where `is_first` (L, ...) is true.
    """
    x = encoder.apply(params.get("encoder", {}), x)
    lead = x.shape[:-1]
    # XLA's code for a CPU takes twice as long with more axes than two.
    x = _hidden(params, x.reshape(-1, x.shape[-1]), settings)
    norms = [params["norm"][str(i)] for i in range(len(params.get("norm", ())))]
    if settings.recurrent:
        if norms:
            x = nn.layer_norm(norms[-2], x)

        def step(h: jax.Array, inputs: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            first_t, x_t = inputs
            h = nn.gru(params["gru"], jnp.where(first_t[..., None], 0.0, h), x_t)
            return h, h

        x = x.reshape(*lead, x.shape[-1])
        memory, x = jax.lax.scan(step, memory, (is_first, x), unroll=min(lead[0], 8))
        x = x.reshape(-1, x.shape[-1])
    head = params["head"]
    x = nn.norm_dense(norms[-1], head, x) if norms else nn.dense(head, x)
    return x.reshape(*lead, x.shape[-1]), memory


def network(settings: ActorCritic, dims: EnvDims) -> Network:
    by_blocks = isinstance(settings, Blocks)
    encoder = by_block(settings, dims) if by_blocks else plain(dims.observation)
    agents = dims.agents
    share = settings.share_policy
    own = settings.critic_input == "own"
    if own and dims.values != agents:
        fail(
            "network.critic_input",
            "own",
            "'privileged' or 'observations' when ppo.value is 'joint'",
        )
    if settings.critic_input == "privileged" and not dims.privileged:
        fail(
            "network.critic_input",
            "privileged",
            "'observations' or 'own': there is no privileged observation",
        )
    critic_rows = agents if own else 1
    encoders = {
        "privileged": plain(dims.privileged),
        "observations": of_team(encoder, agents),
        "own": encoder,
    }
    critic_encoder = encoders[settings.critic_input]
    critic_out = 1 if own else dims.values
    critic_shared = share or not own

    def init(key: jax.Array) -> Params:
        actor_key, critic_key = jax.random.split(key)

        def actor_init(k: jax.Array) -> Params:
            return _trunk_init(k, encoder, dims.action, settings.action_gain, settings)

        def critic_init(k: jax.Array) -> Params:
            return _trunk_init(k, critic_encoder, critic_out, 1.0, settings)

        if not share:
            actor_key = jax.random.split(actor_key, agents)
        if not critic_shared:
            critic_key = jax.random.split(critic_key, agents)
        log_std_shape = (dims.action,) if share else (agents, dims.action)
        return {
            "actor": actor_init(actor_key) if share else jax.vmap(actor_init)(actor_key),
            "log_std": jnp.full(log_std_shape, settings.log_std_init, jnp.float32),
            "critic": critic_init(critic_key)
            if critic_shared
            else jax.vmap(critic_init)(critic_key),
        }

    def policy_params(params: Params) -> Params:
        return {name: params[name] for name in ("actor", "log_std")}

    def initial_memory(num_envs: int) -> NetworkMemory:
        if not settings.recurrent:
            return NetworkMemory((), ())
        return NetworkMemory(
            actor=jnp.zeros((num_envs, agents, settings.gru_size)),
            critic=jnp.zeros((num_envs, critic_rows, settings.gru_size)),
        )

    def run(
        params: Params,
        encoder: Encoder,
        shared: bool,
        memory: Memory,
        is_first: jax.Array,
        x: jax.Array,
    ) -> tuple[jax.Array, Memory]:
        trunk: Any = functools.partial(_trunk, encoder=encoder, settings=settings)
        if not shared:  # a set of parameters for each agent
            trunk = jax.vmap(trunk, in_axes=(0, -2, -1, -2), out_axes=(-2, -2))
        return trunk(params, memory, jnp.broadcast_to(is_first[..., None], x.shape[:-1]), x)

    def distribution(
        params: Params, memory: Memory, is_first: jax.Array, obs: jax.Array
    ) -> tuple[jax.Array, jax.Array, Memory]:
        mean, memory = run(params["actor"], encoder, share, memory, is_first, obs)
        if settings.action_mean == "tanh":
            mean = jnp.tanh(mean)
        log_std = settings.bounded_log_std(params["log_std"])
        return mean, jnp.broadcast_to(log_std, mean.shape), memory

    def act(
        params: Params, memory: Memory, obs: jax.Array, key: jax.Array | None, active: Mask = None
    ) -> tuple[jax.Array, jax.Array, Memory]:
        is_first = jnp.zeros((1, *obs.shape[:-2]), bool)
        mean, log_std, memory = distribution(params, memory, is_first, obs[None])
        mean = mean[0]
        log_std = log_std[0]
        action = mean
        if key is not None:
            action = mean + jnp.exp(log_std) * devices.normal(key, mean.shape, mean.dtype)
        return action, log_prob(action, mean, log_std), memory

    def value(
        params: Params,
        memory: Memory,
        is_first: jax.Array,
        obs: jax.Array,
        privileged: jax.Array,
        active: Mask = None,
    ) -> tuple[jax.Array, Memory]:
        if settings.critic_input == "privileged":
            x = privileged[..., None, :]
        elif settings.critic_input == "observations":
            x = obs.reshape(*obs.shape[:-2], 1, agents * dims.observation)
        else:
            x = obs
        out, memory = run(params["critic"], critic_encoder, critic_shared, memory, is_first, x)
        return out.reshape(*out.shape[:-2], critic_rows * critic_out), memory

    def evaluate(
        params: Params,
        memory: NetworkMemory,
        is_first: jax.Array,
        obs: jax.Array,
        privileged: jax.Array,
        action: jax.Array,
        active: Mask = None,
    ) -> ChunkResult:
        mean, log_std, _ = distribution(params, memory.actor, is_first, obs)
        values, _ = value(params, memory.critic, is_first, obs, privileged)
        return ChunkResult(log_prob(action, mean, log_std), entropy(log_std), values)

    chunk_length = settings.chunk_length if settings.recurrent else 1
    return Network(init, policy_params, initial_memory, act, value, evaluate, chunk_length)
