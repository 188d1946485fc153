"""The walking skills as networks of the trainer, with a critic of the privileged observation.

A skill sees a history of observations. The memory is the newest rows of it, without the last one.
The trainer stores the memory at the first step of each chunk only, and `evaluate` builds the
histories of the chunk's steps.

The walk policy's history is 30 observations. Its body receives the adaptation network's output
without gradient. Regression on `LATENT_TARGET` trains the adaptation network. The agile skill's
history is 9 frames. Its network sees five of them, the newest commands and the clock.

The left-right symmetry of a quadruped is a loss: a mirrored observation deserves the mirrored
action. Mirroring exchanges left and right legs and reverses y, roll, yaw and joints such as hips.
The parameters of the four gaits stay: exchanging a gait's left and right feet shifts its phase,
which the clock shows.

Source: walk-these-ways, Margolis and Agrawal, arXiv 2212.03238.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax import walk_policy
from mqe_jax.core import devices
from mqe_jax.core.limits import Horizon, NonNegative
from mqe_jax.core.settings import FileName, fail, settings_class
from mqe_jax.core.types import Mask, Memory, NetworkMemory, Params
from mqe_jax.physics import robots
from mqe_jax.physics.robots.quadruped import MIRROR, NUM_JOINTS, NUM_LEGS
from mqe_jax.physics.robots.robot import Mirror
from mqe_jax.skills import agile
from mqe_jax.skills.weights import Networks
from mqe_jax.train import nn
from mqe_jax.train.loss import entropy, log_prob
from mqe_jax.train.networks import ChunkResult, EnvDims, GaussianSettings, Network, register_network
from mqe_jax.walk.task import LATENT_TARGET
from mqe_jax.walk_policy import HISTORY, OBSERVATION_SIZE

_CRITIC = (512, 256, 128)
# full float32 products over 2100 numbers would take most of an update on a GPU
_PRECISION = "tensorfloat32"


def _join(*blocks: Mirror) -> Mirror:
    """Returns the mirror of consecutive blocks."""
    starts = np.cumsum([0, *(len(block.source) for block in blocks)])[:-1]
    sources = [block.source + start for block, start in zip(blocks, starts, strict=True)]
    return Mirror(np.concatenate(sources), np.concatenate([block.sign for block in blocks]))


def _signs(*signs: float) -> Mirror:
    return Mirror(np.arange(len(signs)), np.array(signs, np.float32))


_GRAVITY = _signs(1.0, -1.0, 1.0)
_FEET = Mirror(np.array([1, 0, 3, 2]), np.ones(4, np.float32))
_COMMANDS = _signs(*(command.mirror for command in walk_policy.COMMANDS))


@dataclasses.dataclass(frozen=True)
class Form:
    """What is specific to the network of a skill."""

    networks: Networks
    """The skill's networks and their files."""
    rows: np.ndarray
    """Rows of the history that the network sees, from the oldest to the newest."""
    row_size: int
    """Numbers of an observation in a row; only the newest observation has the others too."""
    infer: Callable[..., tuple[jax.Array, Any]]
    """From weights and inputs (..., n) to actions (..., 12), and latents or None."""
    mirror: Callable[[Mirror], Mirror]
    """From the mirror of the joints to that of an input."""

    @property
    def past(self) -> int:
        """Rows of the memory."""
        return int(self.rows[-1])

    def inputs(self, history: jax.Array, obs: jax.Array) -> jax.Array:
        """Returns the network's inputs (..., n).

        `history` are the rows that it sees (..., H, row_size), `obs` the observations (..., O).
        """
        flat = history.reshape(*history.shape[:-2], -1)
        if self.row_size == obs.shape[-1]:
            return flat
        return jnp.concatenate([flat, obs[..., self.row_size :]], axis=-1)

    def symmetry_loss(
        self, params: Any, inputs: jax.Array, mean: jax.Array, joints: Mirror
    ) -> jax.Array:
        """Returns the mean square error () of mirrored inputs' actions against mirrored actions.

        `inputs` are (B, n), the actions `mean` (B, 12); `joints` is the mirror of the joints.
        """
        mirrored = self.mirror(joints).reflect(inputs)
        other, _ = self.infer(params, mirrored, precision=_PRECISION)
        return jnp.mean(jnp.square(other - joints.reflect(mean)))


WALK_FORM = Form(
    networks=walk_policy.NETWORKS,
    rows=np.arange(HISTORY),
    row_size=OBSERVATION_SIZE,
    infer=walk_policy.infer,
    mirror=lambda joints: _join(
        *[_join(_GRAVITY, _COMMANDS, joints, joints, joints, joints, _FEET)] * HISTORY
    ),
)
AGILE_FORM = Form(
    networks=agile.NETWORKS,
    rows=agile.LENGTH - 1 - np.array(agile.OFFSETS),
    row_size=agile.FRAME_SIZE,
    infer=lambda params, inputs, precision: (
        agile.infer(params, inputs, precision=precision),
        None,
    ),
    mirror=lambda joints: _join(
        *[_join(_GRAVITY, joints, joints, joints)] * len(agile.OFFSETS),
        _signs(*(command.mirror for command in agile.COMMANDS)),
        _signs(-1.0, -1.0),  # the clock: the other pair of feet
    ),
)


@settings_class
class HistorySettings(GaussianSettings):
    """Settings of a walking skill and its critic, which sees the privileged observation."""

    weights: FileName | None = None
    """File of the skill's weights to start from, of any robot; none samples them."""
    chunk_length: Horizon = 24
    """Steps of a chunk, at whose first one the history is stored."""
    symmetry_coef: NonNegative = 0.5
    """Weight of the loss of left-right symmetry."""
    mirror_signs: tuple[Literal[-1, 1], ...] = (-1, 1, 1) * NUM_LEGS
    """Signs of the joint angles of a mirrored robot. `train_skill` sets those of the robot."""

    form: ClassVar[Form]
    """What is specific to this network."""

    def build(self, dims: EnvDims) -> Network:
        form = self.form
        inputs = next(iter(form.networks.widths.values()))[0]
        expected = inputs - (len(form.rows) - 1) * form.row_size
        if len(self.mirror_signs) != NUM_JOINTS:
            fail("network.mirror_signs", self.mirror_signs, f"{NUM_JOINTS} numbers, -1 or 1")
        if (dims.agents, dims.observation, dims.action) != (1, expected, NUM_JOINTS):
            fail(
                "network.name",
                self.name,
                "another network, except in the walking environment of that skill",
            )
        return _build(self, form, dims)


@register_network("walk")
class WalkNetwork(HistorySettings):
    """Settings of the walk policy and its critic."""

    form = WALK_FORM
    adaptation_coef: NonNegative = 1.0
    """Weight of the adaptation network's regression loss."""


@register_network("agile")
class AgileNetwork(HistorySettings):
    """Settings of the agile skill and its critic."""

    form = AGILE_FORM


def windows(memory: jax.Array, is_first: jax.Array, obs: jax.Array, kept: np.ndarray) -> jax.Array:
    """Returns H rows of the histories of a chunk's steps (L, C, H, O).

    Rows before an episode's start are zero. `memory` are the rows before the chunk (C, T, O), `obs`
    its rows (L, C, O), `kept` the rows to return, of T + 1.
    """
    steps, count = is_first.shape
    before = jnp.moveaxis(memory, 1, 0)
    rows = jnp.arange(steps)[:, None] + kept
    episode = jnp.cumsum(is_first, axis=0)
    of_row = jnp.concatenate([jnp.zeros((len(before), count), episode.dtype), episode])
    alive = (of_row[rows] == episode[:, None]).astype(obs.dtype)
    return jnp.swapaxes(jnp.concatenate([before, obs])[rows] * alive[..., None], 1, 2)


def _build(settings: HistorySettings, form: Form, dims: EnvDims) -> Network:
    joints = Mirror(MIRROR.source, np.array(settings.mirror_signs, np.float32))

    def init(key: jax.Array) -> Params:
        policy_key, critic_key = jax.random.split(key)
        if settings.weights is None:
            policy = form.networks.init(policy_key)
        else:
            policy = form.networks.load(robots.get("go1"), settings.weights, warns=False)
        return {
            "policy": jax.tree.map(jnp.asarray, policy),
            "log_std": jnp.full(dims.action, settings.log_std_init, jnp.float32),
            "critic": nn.mlp_init(critic_key, (dims.privileged, *_CRITIC, 1), final_scale=1.0),
        }

    def policy_params(params: Params) -> Params:
        return {name: params[name] for name in ("policy", "log_std")}

    def initial_memory(num_envs: int) -> NetworkMemory:
        return NetworkMemory(jnp.zeros((num_envs, form.past, form.row_size)), ())

    def act(
        params: Params, memory: Memory, obs: jax.Array, key: jax.Array | None, active: Mask = None
    ) -> tuple[jax.Array, jax.Array, Memory]:
        history = jnp.concatenate([memory, obs[..., : form.row_size]], axis=-2)
        inputs = form.inputs(history[..., form.rows, :], obs[..., 0, :])
        mean, _ = form.infer(params["policy"], inputs, precision=_PRECISION)
        log_std = settings.bounded_log_std(params["log_std"])
        action = mean
        if key is not None:
            action += jnp.exp(log_std) * devices.normal(key, mean.shape, mean.dtype)
        return (
            action[..., None, :],
            log_prob(action, mean, log_std)[..., None, :],
            history[..., 1:, :],
        )

    def value(
        params: Params,
        memory: Memory,
        is_first: jax.Array,
        obs: jax.Array,
        privileged: jax.Array,
        active: Mask = None,
    ) -> tuple[jax.Array, Memory]:
        return nn.mlp(params["critic"], privileged, jax.nn.elu, precision=_PRECISION), memory

    def evaluate(
        params: Params,
        memory: NetworkMemory,
        is_first: jax.Array,
        obs: jax.Array,
        privileged: jax.Array,
        action: jax.Array,
        active: Mask = None,
    ) -> ChunkResult:
        obs = obs[..., 0, :]
        history = windows(memory.actor, is_first, obs[..., : form.row_size], form.rows)
        inputs = form.inputs(history, obs)
        mean, latent = form.infer(params["policy"], inputs, precision=_PRECISION)
        log_std = jnp.broadcast_to(settings.bounded_log_std(params["log_std"]), mean.shape)
        losses = {}
        if isinstance(settings, WalkNetwork):
            error = jnp.mean(jnp.square(latent - privileged[..., LATENT_TARGET]))
            losses["adaptation"] = settings.adaptation_coef * error
        if settings.symmetry_coef > 0:
            asymmetry = form.symmetry_loss(params["policy"], inputs, mean, joints)
            losses["symmetry"] = settings.symmetry_coef * asymmetry
        return ChunkResult(
            log_prob(action, mean[..., None, :], log_std[..., None, :]),
            entropy(log_std)[..., None],
            value(params, (), is_first, obs, privileged)[0],
            losses,
        )

    return Network(init, policy_params, initial_memory, act, value, evaluate, settings.chunk_length)
