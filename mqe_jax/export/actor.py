"""The actor of the network `actor_critic` as ONNX nodes."""

from __future__ import annotations

from typing import Any

import numpy as np

from mqe_jax.errors import InputError
from mqe_jax.export.graph import Graph
from mqe_jax.train.actor_critic import ActorCritic
from mqe_jax.train.policy import Policy

_LIMIT = 10.0  # clip of normalised observations (`train.normalize`)
_MIN_STD = 1e-2  # floor of the standard deviation (`train.normalize`)
_ACTIVATIONS = {"relu": "Relu", "elu": "Elu", "tanh": "Tanh"}


def check_network(policy: Policy) -> ActorCritic:
    """Returns the settings of the policy's network; InputError if it cannot be exported."""
    settings = policy.config.network
    if not isinstance(settings, ActorCritic):
        raise InputError(f"network: {settings.name!r} cannot be exported to ONNX; allowed: 'actor_critic'")
    return settings


def add_actor(graph: Graph, policy: Policy) -> str:
    """Adds inputs `obs` (N, A, O) and, with a recurrent network, `memory` (N, A, H); returns the action (N, A, D).

    The action is the deterministic one, scaled and clipped to [-1, 1]. `memory` is the recurrent state; the output
    `next_memory` is its next value.
    """
    settings, dims = check_network(policy), policy.dims
    actor: Any = policy.params["actor"]
    x = graph.input("obs", (dims.agents, dims.observation))
    if policy.config.normalization.observations:
        x = _normalized(graph, x, policy)
    for index in range(len(settings.hidden_sizes)):
        x = _dense(graph, actor["hidden"][str(index)], x)
        x = graph.op(_ACTIVATIONS[settings.activation], x)
    if settings.recurrent:
        size = settings.gru_size
        memory = graph.input("memory", (dims.agents, size))
        x = _gru(graph, actor["gru"], memory, x)
        graph.output("next_memory", x, (dims.agents, size))
    x = _dense(graph, actor["head"], x)
    if settings.action_mean == "tanh":
        x = graph.op("Tanh", x)
    return graph.clip(graph.op("Mul", x, graph.constant(policy.config.action_scale)), -1.0, 1.0)


def _normalized(graph: Graph, x: str, policy: Policy) -> str:
    mean, variance = np.asarray(policy.normalizer.mean), np.asarray(policy.normalizer.variance)
    std = np.maximum(np.sqrt(variance), np.float32(_MIN_STD))
    x = graph.op("Div", graph.op("Sub", x, graph.constant(mean)), graph.constant(std))
    return graph.clip(x, -_LIMIT, _LIMIT)


def _dense(graph: Graph, params: Any, x: str) -> str:
    return graph.affine(x, np.asarray(params["weight"]), np.asarray(params["bias"]))


def _gru(graph: Graph, params: Any, h: str, x: str) -> str:
    """The gated recurrent unit of `train.nn.gru`: gates in the order reset, update, candidate."""
    reset_x, update_x, candidate_x = graph.split_op("Split", 3, _dense(graph, params["input"], x), axis=-1)
    reset_h, update_h, candidate_h = graph.split_op("Split", 3, _dense(graph, params["hidden"], h), axis=-1)
    reset = graph.op("Sigmoid", graph.op("Add", reset_x, reset_h))
    update = graph.op("Sigmoid", graph.op("Add", update_x, update_h))
    candidate = graph.op("Tanh", graph.op("Add", candidate_x, graph.op("Mul", reset, candidate_h)))
    new = graph.op("Mul", graph.op("Sub", graph.constant(1.0), update), candidate)
    return graph.op("Add", new, graph.op("Mul", update, h))
