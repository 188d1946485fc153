"""The walk policy as a network of the trainer: a window of 30 observations, an adaptation network and a body.

The memory is the last 29 observations (29 x 70 numbers). The trainer stores it at the first step of each chunk only,
and `evaluate` builds the windows of the chunk's steps. The body receives the adaptation network's output without
gradient; that network is trained by regression on `LATENT_TARGET`.

The left-right symmetry of a quadruped is a loss: a mirrored observation deserves the mirrored action. Mirroring
exchanges left and right legs and reverses y, roll, yaw and the hip joints. The parameters of the four gaits stay:
exchanging a gait's left and right feet shifts its phase, which the clock shows.

Source: walk-these-ways, Margolis and Agrawal, arXiv 2212.03238.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax import robots, walk_policy
from mqe_jax.limits import Horizon, NonNegative
from mqe_jax.robots.robot import MIRRORED_JOINTS, MIRRORED_SIGNS
from mqe_jax.settings import FileName, fail
from mqe_jax.train import devices, nn
from mqe_jax.train.loss import entropy, log_prob
from mqe_jax.train.networks import EnvDims, Evaluation, GaussianSettings, Network, register_network
from mqe_jax.train.types import Memory, NetworkMemory, Params
from mqe_jax.walk.task import LATENT_TARGET
from mqe_jax.walk_policy import HISTORY, OBSERVATION_SIZE

_CRITIC = (512, 256, 128)
_PRECISION = "tensorfloat32"  # full float32 products over 2100 numbers would take most of an update on a GPU


@register_network("walk")
class WalkNetwork(GaussianSettings):
    """Settings of the walk policy and its critic, which sees the privileged observation."""

    weights: FileName | None = None
    """File of walk weights to start from, of any robot; none samples them."""
    chunk_length: Horizon = 24
    """Steps of a chunk, at whose first one the history is stored."""
    adaptation_coef: NonNegative = 1.0
    """Weight of the adaptation network's regression loss."""
    symmetry_coef: NonNegative = 0.5
    """Weight of the loss of left-right symmetry."""

    def build(self, dims: EnvDims) -> Network:
        """Returns the network; see `Network`."""
        sizes = (dims.agents, dims.observation, dims.action)
        if sizes != (1, OBSERVATION_SIZE, walk_policy.BODY_SIZES[-1]):
            fail("network.name", "walk", "another network, except in the walking environment")
        return _build(self, dims)


def windows(memory: jax.Array, is_first: jax.Array, obs: jax.Array) -> jax.Array:
    """Returns the flattened windows (L, C, 2100) of a chunk's steps; observations before an episode's start are zero.

    Args:
        memory: the 29 observations before the chunk (C, 29, 70).
        is_first: whether a step is the first of an episode (L, C) bool.
        obs: observations (L, C, 70).
    """
    steps, count = is_first.shape
    before = jnp.moveaxis(memory, 1, 0)
    rows = jnp.arange(steps)[:, None] + jnp.arange(HISTORY)
    episode = jnp.cumsum(is_first, axis=0)
    of_row = jnp.concatenate([jnp.zeros((len(before), count), episode.dtype), episode])
    alive = of_row[rows] == episode[:, None]
    window = jnp.concatenate([before, obs])[rows] * alive[..., None]
    return jnp.swapaxes(window, 1, 2).reshape(steps, count, -1)


_FEET = np.array([1, 0, 3, 2])


def _observation() -> tuple[np.ndarray, np.ndarray]:
    """Returns source (70,) and sign (70,) of each number of a mirrored observation."""
    signs = np.array([command.mirror for command in walk_policy.COMMANDS], np.float32)
    blocks: list[tuple[np.ndarray, np.ndarray]] = [
        (np.arange(3), np.array([1.0, -1.0, 1.0], np.float32)),  # gravity
        (np.arange(len(signs)), signs),
        *[(MIRRORED_JOINTS, MIRRORED_SIGNS)] * 4,  # position, velocity, last action, the one before
        (_FEET, np.ones(4, np.float32)),  # clock
    ]
    starts = np.cumsum([0, *(len(source) for source, _ in blocks)])
    source = np.concatenate([source + start for (source, _), start in zip(blocks, starts[:-1], strict=True)])
    return source, np.concatenate([sign for _, sign in blocks])


_SOURCE, _SIGN = _observation()


def mirror_history(flat: jax.Array) -> jax.Array:
    """Mirrors flattened histories (..., T x 70)."""
    return (flat.reshape(*flat.shape[:-1], -1, OBSERVATION_SIZE)[..., _SOURCE] * _SIGN).reshape(flat.shape)


def mirror_action(action: jax.Array) -> jax.Array:
    """Mirrors actions (..., 12)."""
    return action[..., MIRRORED_JOINTS] * MIRRORED_SIGNS


def symmetry_loss(params: walk_policy.Params, flat: jax.Array, mean: jax.Array) -> jax.Array:
    """Returns the mean square difference () between actions of mirrored histories and mirrored actions.

    `flat` are histories (B, 2100) and `mean` their actions (B, 12).
    """
    other, _ = walk_policy.infer(params, mirror_history(flat), precision=_PRECISION)
    return jnp.mean(jnp.square(other - mirror_action(mean)))


def _build(settings: WalkNetwork, dims: EnvDims) -> Network:
    def init(key: jax.Array) -> Params:
        policy_key, critic_key = jax.random.split(key)
        if settings.weights is None:
            policy = walk_policy.init_params(policy_key)
        else:
            policy = walk_policy.load_params(robots.get("go1"), settings.weights)
        return {
            "policy": jax.tree.map(jnp.asarray, policy),
            "log_std": jnp.full(dims.action, settings.log_std_init, jnp.float32),
            "critic": nn.mlp_init(critic_key, (dims.privileged, *_CRITIC, 1), final_scale=1.0),
        }

    def policy_params(params: Params) -> Params:
        return {name: params[name] for name in ("policy", "log_std")}

    def initial_memory(num_envs: int) -> NetworkMemory:
        return NetworkMemory(jnp.zeros((num_envs, HISTORY - 1, OBSERVATION_SIZE)), ())

    def act(
        params: Params, memory: Memory, obs: jax.Array, key: jax.Array | None
    ) -> tuple[jax.Array, jax.Array, Memory]:
        window = jnp.concatenate([memory, obs], axis=-2)
        flat = window.reshape(*window.shape[:-2], -1)
        mean, _ = walk_policy.infer(params["policy"], flat, precision=_PRECISION)
        log_std = settings.bounded_log_std(params["log_std"])
        action = mean if key is None else mean + jnp.exp(log_std) * devices.normal(key, mean.shape, mean.dtype)
        return action[..., None, :], log_prob(action, mean, log_std)[..., None, :], window[..., 1:, :]

    def value(
        params: Params, memory: Memory, is_first: jax.Array, obs: jax.Array, privileged: jax.Array
    ) -> tuple[jax.Array, Memory]:
        return nn.mlp(params["critic"], privileged, jax.nn.elu, precision=_PRECISION), memory

    def evaluate(
        params: Params,
        memory: NetworkMemory,
        is_first: jax.Array,
        obs: jax.Array,
        privileged: jax.Array,
        action: jax.Array,
    ) -> Evaluation:
        flat = windows(memory.actor, is_first, obs[..., 0, :])
        mean, latent = walk_policy.infer(params["policy"], flat, precision=_PRECISION)
        log_std = jnp.broadcast_to(settings.bounded_log_std(params["log_std"]), mean.shape)
        error = jnp.mean(jnp.square(latent - privileged[..., LATENT_TARGET]))
        losses = {"adaptation": settings.adaptation_coef * error}
        if settings.symmetry_coef > 0:
            losses["symmetry"] = settings.symmetry_coef * symmetry_loss(params["policy"], flat, mean)
        return Evaluation(
            log_prob(action, mean[..., None, :], log_std[..., None, :]),
            entropy(log_std)[..., None],
            value(params, (), is_first, obs, privileged)[0],
            losses,
        )

    return Network(init, policy_params, initial_memory, act, value, evaluate, settings.chunk_length)
