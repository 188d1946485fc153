"""The network `mat`: a transformer over agents that act one after another.

An encoder attends over the observations of all agents and outputs each agent's value. A decoder
attends over the actions of preceding agents. Acting is sequential, evaluation is parallel under a
causal mask, and both give the same log-probabilities.

Sources: Wen et al. 2022, arXiv 2205.14953 (Multi-Agent Transformer). Widths, gains and deviation
are those of OpenRL.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core import devices
from mqe_jax.core.settings import fail
from mqe_jax.core.types import Mask, Memory, NetworkMemory, Params
from mqe_jax.train import nn
from mqe_jax.train.loss import entropy, log_prob
from mqe_jax.train.networks import ChunkResult, EnvDims, Mat, Network


def attention(
    params: Params, query: jax.Array, context: jax.Array, heads: int, active: Mask, *, causal: bool
) -> jax.Array:
    """Multi-head attention of `query` to `context`: (..., A, W), (..., A, W) -> (..., A, W).

    An agent attends to itself and to the active ones (..., A); with `causal`, to none after itself.
    Source: Vaswani et al., arXiv 1706.03762, equation 1.
    """

    def split(name: str, x: jax.Array) -> jax.Array:
        x = nn.dense(params[name], x)
        # (..., heads, A, W / heads)
        return jnp.moveaxis(x.reshape(*x.shape[:-1], heads, -1), -2, -3)

    q = split("query", query)
    k = split("key", context)
    v = split("value", context)
    weight = jnp.matmul(q, jnp.swapaxes(k, -1, -2), precision=nn.PRECISION) / math.sqrt(q.shape[-1])
    if causal:
        weight = jnp.where(np.tri(weight.shape[-1], dtype=bool), weight, -jnp.inf)
    if active is not None:
        weight = jnp.where(
            active[..., None, None, :] | np.eye(weight.shape[-1], dtype=bool), weight, -jnp.inf
        )
    weight = jax.nn.softmax(weight, axis=-1)
    mixed = jnp.moveaxis(jnp.matmul(weight, v, precision=nn.PRECISION), -3, -2)
    return nn.dense(params["projection"], mixed.reshape(*mixed.shape[:-2], -1))


def _gelu(x: jax.Array) -> jax.Array:
    return jax.nn.gelu(x, approximate=False)


def _head(params: Params, x: jax.Array) -> jax.Array:
    return nn.dense(
        params["out"], nn.layer_norm(params["norm"], _gelu(nn.dense(params["hidden"], x)))
    )


def init_params(key: jax.Array, dims: EnvDims, settings: Mat) -> Params:
    """Initialises encoder, value head, decoder and the standard-deviation parameter."""
    width = settings.width
    small = settings.gain
    large = math.sqrt(2.0)
    square_key, *keys = jax.random.split(key, 5)
    # One vmapped program for all square matrices compiles much faster than one program each.
    count = 2 + settings.blocks * (6 + 10)
    squares = iter(
        jax.vmap(lambda k: nn.orthogonal(k, (width, width), 1.0))(
            jax.random.split(square_key, count)
        )
    )

    def square(gain: float) -> Params:
        return {"weight": gain * next(squares), "bias": jnp.zeros((width,), jnp.float32)}

    def block(attentions: int) -> Params:
        layers: Params = {
            f"attention{i}": {
                name: square(small) for name in ("query", "key", "value", "projection")
            }
            for i in range(attentions)
        }
        layers |= {f"norm{i}": nn.layer_norm_init(width) for i in range(attentions + 1)}
        return {**layers, "mlp": {"0": square(large), "1": square(small)}}

    def head(k: jax.Array, n_out: int) -> Params:
        return {
            "hidden": square(large),
            "norm": nn.layer_norm_init(width),
            "out": nn.dense_init(k, width, n_out, small),
        }

    start = 1.0 if settings.deviation == "sigmoid" else settings.log_std_init
    return {
        "encoder": {
            "norm_in": nn.layer_norm_init(dims.observation),
            "embed": nn.dense_init(keys[0], dims.observation, width),
            "norm": nn.layer_norm_init(width),
            "blocks": [block(1) for _ in range(settings.blocks)],
        },
        "value_head": head(keys[1], 1),
        "decoder": {
            "embed": nn.dense_init(keys[2], dims.action, width),
            "norm": nn.layer_norm_init(width),
            "blocks": [block(2) for _ in range(settings.blocks)],
            "head": head(keys[3], dims.action),
        },
        "deviation": jnp.full((dims.action,), start, jnp.float32),
    }


def encode(params: Params, obs: jax.Array, heads: int, active: Mask = None) -> jax.Array:
    """Returns each agent's features from the observations of the active agents.

    Shapes: (..., A, O) -> (..., A, W).
    """
    x = nn.layer_norm(
        params["norm"], _gelu(nn.dense(params["embed"], nn.layer_norm(params["norm_in"], obs)))
    )
    for block in params["blocks"]:
        x = nn.layer_norm(
            block["norm0"], x + attention(block["attention0"], x, x, heads, active, causal=False)
        )
        x = nn.layer_norm(block["norm1"], x + nn.mlp(block["mlp"], x, _gelu))
    return x


def decode(
    params: Params, features: jax.Array, action: jax.Array, heads: int, active: Mask = None
) -> jax.Array:
    """Returns mean actions given those of preceding active agents.

    Shapes: features (..., A, W), actions (..., A, D) -> (..., A, D). An agent's own and later
    actions have no effect on its mean. Its token is the action of the active agent before it, and
    zero for the first one.
    """
    token = _preceding(action, active)
    x = nn.layer_norm(params["norm"], _gelu(nn.dense(params["embed"], token)))
    for block in params["blocks"]:
        x = nn.layer_norm(
            block["norm0"], x + attention(block["attention0"], x, x, heads, active, causal=True)
        )
        mixed = attention(block["attention1"], features, x, heads, active, causal=True)
        x = nn.layer_norm(block["norm1"], features + mixed)
        x = nn.layer_norm(block["norm2"], x + nn.mlp(block["mlp"], x, _gelu))
    return _head(params["head"], x)


def _preceding(action: jax.Array, active: Mask) -> jax.Array:
    """Returns the action of the active agent before each agent, zero without one: (..., A, D)."""
    tokens = []
    last = jnp.zeros_like(action[..., 0, :])
    for agent in range(action.shape[-2]):
        tokens.append(last)
        own = action[..., agent, :]
        last = own if active is None else jnp.where(active[..., agent, None], own, last)
    return jnp.stack(tokens, axis=-2)


def log_std_of(params: Params, settings: Mat) -> jax.Array:
    """Returns the log standard deviation of the actions (D,)."""
    parameter = params["deviation"]
    if settings.deviation == "sigmoid":
        return math.log(0.5) + jax.nn.log_sigmoid(parameter)
    return settings.bounded_log_std(parameter)


def network(settings: Mat, dims: EnvDims) -> Network:
    if dims.values != dims.agents:
        fail("ppo.value", "joint", "'agent' with the network 'mat', which has one value per agent")
    heads = settings.heads

    def act(
        params: Params, memory: Memory, obs: jax.Array, key: jax.Array | None, active: Mask = None
    ) -> tuple[jax.Array, jax.Array, Memory]:
        features = encode(params["encoder"], obs, heads, active)
        shape = (*obs.shape[:-1], dims.action)
        log_std = jnp.broadcast_to(log_std_of(params, settings), shape)
        noise = 0.0 if key is None else jnp.exp(log_std) * devices.normal(key, shape, obs.dtype)

        def act_at(agent: int, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            action, mean = carry
            now = (jnp.arange(dims.agents) == agent)[:, None]
            mean = jnp.where(now, decode(params["decoder"], features, action, heads, active), mean)
            return jnp.where(now, mean + noise, action), mean

        zero = jnp.zeros(shape, obs.dtype)
        action, mean = jax.lax.fori_loop(0, dims.agents, act_at, (zero, zero))
        return action, log_prob(action, mean, log_std), memory

    def value(
        params: Params,
        memory: Memory,
        is_first: jax.Array,
        obs: jax.Array,
        privileged: jax.Array,
        active: Mask = None,
    ) -> tuple[jax.Array, Memory]:
        return _head(params["value_head"], encode(params["encoder"], obs, heads, active))[
            ..., 0
        ], memory

    def evaluate(
        params: Params,
        memory: NetworkMemory,
        is_first: jax.Array,
        obs: jax.Array,
        privileged: jax.Array,
        action: jax.Array,
        active: Mask = None,
    ) -> ChunkResult:
        features = encode(params["encoder"], obs, heads, active)
        mean = decode(params["decoder"], features, action, heads, active)
        log_std = jnp.broadcast_to(log_std_of(params, settings), mean.shape)
        values = _head(params["value_head"], features)[..., 0]
        return ChunkResult(log_prob(action, mean, log_std), entropy(log_std), values)

    return Network(
        init=lambda key: init_params(key, dims, settings),
        policy_params=lambda params: {
            name: params[name] for name in ("encoder", "decoder", "deviation")
        },
        initial_memory=lambda num_envs: NetworkMemory((), ()),
        act=act,
        value=value,
        evaluate=evaluate,
    )
