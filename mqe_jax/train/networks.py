"""Actor and critic networks as `init` / `apply` functions over nested dicts.

The learner knows a network only as `Network`: another one, such as a transformer over agents, needs no other
trainer. Shapes: N worlds (or any leading axes), A agents, observations O, actions D, values V, chunks of L.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mqe_jax.train import nn
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.loss import entropy, log_prob
from mqe_jax.train.types import Memory

Params = nn.Params

_ACTIVATIONS: dict[str, Callable[[jax.Array], jax.Array]] = {
    "relu": jax.nn.relu,
    "elu": jax.nn.elu,
    "tanh": jnp.tanh,
}


class Sizes(NamedTuple):
    """Widths that an environment sets."""

    agents: int
    observation: int
    privileged: int
    action: int


class Evaluation(NamedTuple):
    """What the current parameters say of a chunk."""

    log_prob: jax.Array  # (L, C, A, D)
    entropy: jax.Array  # (L, C, A)
    value: jax.Array  # (L, C, V), normalised


class Network(NamedTuple):
    """The functions that make a network.

    `init(key) -> params`
    `initial_memory(num_envs) -> memory`: `{"actor": ..., "critic": ...}`, zeros with leading axis N
    `act(params, actor_memory, obs (N, A, O), key or None) -> (action, log_prob (N, A, D), actor_memory)`;
    without a key the action is the mean
    `value(params, critic_memory, start (L, N), obs (L, N, A, O), privileged (L, N, P)) -> (value (L, N, V),
    critic_memory)`
    `evaluate(params, memory, start (L, C), obs, privileged, action) -> Evaluation`
    """

    init: Callable[[jax.Array], Params]
    initial_memory: Callable[[int], Memory]
    act: Callable[[Params, Memory, jax.Array, jax.Array | None], tuple[jax.Array, jax.Array, Memory]]
    value: Callable[[Params, Memory, jax.Array, jax.Array, jax.Array], tuple[jax.Array, Memory]]
    evaluate: Callable[[Params, Memory, jax.Array, jax.Array, jax.Array, jax.Array], Evaluation]


def reset_memory(memory: Memory, start: jax.Array) -> Memory:
    """Zeroes the memory of the worlds in which an episode starts: leaves (N, ...), start (N,) bool."""

    def zero(leaf: jax.Array) -> jax.Array:
        return jnp.where(start.reshape(start.shape + (1,) * (leaf.ndim - start.ndim)), 0.0, leaf)

    return jax.tree.map(zero, memory)


def _trunk_init(key: jax.Array, n_in: int, n_out: int, final_scale: float, config: TrainConfig) -> Params:
    """Makes hidden layers, an optional recurrent unit and an output layer."""
    hidden_key, gru_key, head_key = jax.random.split(key, 3)
    gain = math.sqrt(2.0)
    params: Params = {
        "hidden": nn.mlp_init(hidden_key, (n_in, *config.hidden_sizes), final_scale=gain),
        "head": nn.dense_init(
            head_key, config.gru_size if config.recurrent else config.hidden_sizes[-1], n_out, final_scale
        ),
    }
    if config.recurrent:
        params["gru"] = nn.gru_init(gru_key, config.hidden_sizes[-1], config.gru_size)
    return params


def _trunk(
    params: Params, memory: Memory, start: jax.Array, x: jax.Array, config: TrainConfig
) -> tuple[jax.Array, Memory]:
    """Runs L steps: memory (..., H) or (), start (L, ...) bool, x (L, ..., n_in) -> (L, ..., n_out), memory.

    Only the recurrent unit goes step by step; the layers around it take all steps at once.
    """
    x = nn.mlp(params["hidden"], x, _ACTIVATIONS[config.activation], activate_last=True)
    if "gru" in params:

        def remember(h: jax.Array, inputs: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            start_t, x_t = inputs
            h = nn.gru(params["gru"], jnp.where(start_t[..., None], 0.0, h), x_t)
            return h, h

        memory, x = jax.lax.scan(remember, memory, (start, x), unroll=min(x.shape[0], 8))
    return nn.dense(params["head"], x), memory


def _over_agents(function: Callable[..., Any], share: bool) -> Callable[..., Any]:
    """Makes `_trunk` act on arrays with an agent axis before the last, with one set of parameters or A."""
    if share:
        return function
    return jax.vmap(function, in_axes=(0, -2, -1, -2), out_axes=(-2, -2))


def make_network(sizes: Sizes, config: TrainConfig) -> Network:
    """Makes the actor and the centralised critic that the settings describe.

    The actor is shared by the agents (their id is in the observation) or one for each; the critic is one
    network of the privileged or of all observations, or (`own`) one per agent like the actor.
    """
    agents = sizes.agents
    own = config.critic_input == "own"
    critic_rows = agents if own else 1
    critic_in = {
        "privileged": sizes.privileged,
        "observations": agents * sizes.observation,
        "own": sizes.observation,
    }[config.critic_input]
    critic_out = 1 if own or config.value == "joint" else agents
    critic_shared = config.share_policy or not own

    def init(key: jax.Array) -> Params:
        actor_key, critic_key = jax.random.split(key)

        def actor_init(k: jax.Array) -> Params:
            return _trunk_init(k, sizes.observation, sizes.action, config.action_gain, config)

        def critic_init(k: jax.Array) -> Params:
            return _trunk_init(k, critic_in, critic_out, 1.0, config)

        if not config.share_policy:
            actor_key = jax.random.split(actor_key, agents)
        if not critic_shared:
            critic_key = jax.random.split(critic_key, agents)
        log_std_shape = (sizes.action,) if config.share_policy else (agents, sizes.action)
        return {
            "actor": actor_init(actor_key) if config.share_policy else jax.vmap(actor_init)(actor_key),
            "log_std": jnp.full(log_std_shape, config.log_std_init, jnp.float32),
            "critic": critic_init(critic_key) if critic_shared else jax.vmap(critic_init)(critic_key),
        }

    def initial_memory(num_envs: int) -> Memory:
        if not config.recurrent:
            return {"actor": (), "critic": ()}
        return {
            "actor": jnp.zeros((num_envs, agents, config.gru_size)),
            "critic": jnp.zeros((num_envs, critic_rows, config.gru_size)),
        }

    def run(params: Params, share: bool, memory: Memory, start: jax.Array, x: jax.Array) -> Any:
        def trunk(params: Params, memory: Memory, start: jax.Array, x: jax.Array) -> tuple[jax.Array, Memory]:
            return _trunk(params, memory, start, x, config)

        start = jnp.broadcast_to(start[..., None], x.shape[:-1])
        return _over_agents(trunk, share)(params, memory, start, x)

    def distribution(
        params: Params, memory: Memory, start: jax.Array, obs: jax.Array
    ) -> tuple[jax.Array, jax.Array, Memory]:
        mean, memory = run(params["actor"], config.share_policy, memory, start, obs)
        if config.action_mean == "tanh":
            mean = jnp.tanh(mean)
        log_std = params["log_std"]
        if config.log_std_max is not None:
            log_std = jnp.minimum(log_std, config.log_std_max)
        if config.log_std_min is not None:
            log_std = jnp.maximum(log_std, config.log_std_min)
        return mean, jnp.broadcast_to(log_std, mean.shape), memory

    def act(
        params: Params, memory: Memory, obs: jax.Array, key: jax.Array | None
    ) -> tuple[jax.Array, jax.Array, Memory]:
        start = jnp.zeros((1, *obs.shape[:-2]), bool)
        mean, log_std, memory = distribution(params, memory, start, obs[None])
        mean, log_std = mean[0], log_std[0]
        action = mean
        if key is not None:
            action = mean + jnp.exp(log_std) * jax.random.normal(key, mean.shape, mean.dtype)
        return action, log_prob(action, mean, log_std), memory

    def value(
        params: Params, memory: Memory, start: jax.Array, obs: jax.Array, privileged: jax.Array
    ) -> tuple[jax.Array, Memory]:
        if config.critic_input == "privileged":
            x = privileged[..., None, :]
        elif config.critic_input == "observations":
            x = obs.reshape(*obs.shape[:-2], 1, critic_in)
        else:
            x = obs
        out, memory = run(params["critic"], critic_shared, memory, start, x)
        return out.reshape(*out.shape[:-2], critic_rows * critic_out), memory

    def evaluate(
        params: Params,
        memory: Memory,
        start: jax.Array,
        obs: jax.Array,
        privileged: jax.Array,
        action: jax.Array,
    ) -> Evaluation:
        mean, log_std, _ = distribution(params, memory["actor"], start, obs)
        values, _ = value(params, memory["critic"], start, obs, privileged)
        return Evaluation(log_prob(action, mean, log_std), entropy(log_std), values)

    return Network(init, initial_memory, act, value, evaluate)
