"""The network protocol and the registry of networks.

A network is one registered settings class whose `build` returns the functions that the learner, the
rollout and a saved policy use. To add an architecture, register another settings class:

    @register_network("mine")
    class MyNetwork(NetworkSettings):
        width: PositiveInt = 64

        def build(self, dims: EnvDims) -> Network: ...

The settings import no JAX, so that a wrong flag of `mqe train` is named at once.

Shapes: N environments (or any leading axes), A agents, observations O, privileged observation P,
actions D, values V, chunks of L steps.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, dataclass_transform

from mqe_jax.core.blocks import Block
from mqe_jax.core.errors import nearest
from mqe_jax.core.lazy import load
from mqe_jax.core.limits import (
    Depth,
    Horizon,
    NonNegativeInt,
    Positive,
    PositiveInt,
    Robots,
    Width,
    Widths,
)
from mqe_jax.core.settings import build, check, fail, name_settings, settings_class

if TYPE_CHECKING:
    import jax

    from mqe_jax.core.types import Memory, NetworkMemory, Params
    from mqe_jax.train.normalize import Features


class EnvDims(NamedTuple):
    """Sizes of the environment of one team and of its values (`ppo.value`)."""

    agents: Robots
    observation: PositiveInt
    privileged: NonNegativeInt
    action: PositiveInt
    values: PositiveInt
    """Number of values V: one per agent, or one of the team."""
    blocks: tuple[Block, ...] = ()
    """What an agent's observation consists of; empty if the environment does not describe it."""


class ChunkResult(NamedTuple):
    """Log-probabilities, entropies and values of a chunk under the current parameters."""

    log_prob: jax.Array
    """Log-probabilities of the actions (L, C, A, D)."""
    entropy: jax.Array
    """Entropies of the actions' entries (L, C, A, D)."""
    value: jax.Array
    """Normalised values (L, C, V)."""
    losses: Mapping[str, jax.Array] = {}
    """Weighted losses () that the network adds to that of PPO, by name."""


class Network(NamedTuple):
    """The functions that make up a network.

    - `init(key) -> params`
    - `policy_params(params) -> params` returns the parameters of `act`, which a saved policy has.
    - `initial_memory(num_envs) -> memory` returns a recurrent state of zeros with leading axis N.
    - `act(policy_params, actor_memory, obs, key, active) -> (action, log_prob, actor_memory)`, with
      obs (N, A, O), active (N, A), action and log_prob (N, A, D). Actions are unbounded, and
      without a key deterministic. Agents may act autoregressively within one call.
    - `value(params, critic_memory, is_first, obs, privileged, active) -> (value, critic_memory)`,
      with is_first (L, N), obs (L, N, A, O), privileged (L, N, P), active (L, N, A), value (L, N,
      V).
    - `evaluate(params, memory, is_first (L, C), obs, privileged, action, active) -> ChunkResult`
      takes all agents in parallel.

    `active` marks the agents that take part; None: all. The observations of the others are 0; a
    network in which agents see each other (`NetworkSettings.mixes_agents`) must leave them out.
    `chunk_length` is the number of steps of truncated backpropagation through time, 1 without a
    recurrent state.
    """

    init: Callable[[jax.Array], Params]
    policy_params: Callable[[Params], Params]
    initial_memory: Callable[[int], NetworkMemory]
    act: Callable[..., tuple[jax.Array, jax.Array, Memory]]
    value: Callable[..., tuple[jax.Array, Memory]]
    evaluate: Callable[..., ChunkResult]
    chunk_length: int = 1


class NetworkSettings:
    """Base of every network's settings class."""

    name: str
    """Registered name of the network that the other fields configure."""

    @property
    def critic_reads(self) -> tuple[str, ...]:
        """The observations on which `Network.value` depends.

        Others may be missing at the end of a step.
        """
        return "obs", "privileged_obs"

    @property
    def any_size(self) -> bool:
        """Whether a policy fits any number of agents, and of entities in a block."""
        return False

    @property
    def mixes_agents(self) -> bool:
        """Whether an agent's action depends on the observations or actions of others."""
        return False

    def features(self, dims: EnvDims) -> Features | None:
        """Returns which statistics normalise the entries of an observation.

        With None, each entry has its own.
        """
        return None

    def build(self, dims: EnvDims) -> Network:
        """Returns the network for an environment; InputError if the settings do not fit it."""
        raise NotImplementedError


@settings_class
class GaussianSettings(NetworkSettings):
    """Settings of a network whose log standard deviation is a parameter."""

    name: str = ""
    """Registered name of the network."""
    log_std_init: float = 0.0
    """Initial log standard deviation of the actions."""
    log_std_max: float | None = None
    """Upper bound on the log standard deviation; none sets no bound."""
    log_std_min: float | None = None
    """Lower bound on the log standard deviation, which maintains exploration; none sets no
    bound."""

    def __post_init__(self) -> None:
        if self.log_std_max is not None and self.log_std_init > self.log_std_max:
            fail("log_std_init", self.log_std_init, f"at most log_std_max ({self.log_std_max})")
        if self.log_std_min is not None and self.log_std_init < self.log_std_min:
            fail("log_std_init", self.log_std_init, f"at least log_std_min ({self.log_std_min})")

    def bounded_log_std(self, parameter: jax.Array) -> jax.Array:
        """Returns the parameter clipped to the bounds by `nn.clip_parameter`."""
        from mqe_jax.train import nn

        low = -math.inf if self.log_std_min is None else self.log_std_min
        high = math.inf if self.log_std_max is None else self.log_std_max
        return nn.clip_parameter(parameter, low, high)


NETWORKS: dict[str, type[NetworkSettings]] = {}
"""Settings classes by the name that `network.name` gives."""


@dataclass_transform(frozen_default=True, kw_only_default=True)
def register_network(name: str) -> Callable[[type[Any]], type[Any]]:
    """Registers a class as the settings of a network.

    The class becomes a settings class. The functions of its network compute in single precision.
    """
    # Type checkers would not see what `checked` returns as a decorator of settings classes.
    check("name", name, str)

    def register(cls: type[Any]) -> type[Any]:
        if not isinstance(cls, type) or not callable(getattr(cls, "build", None)):
            fail("network", cls, "a class of settings with a method build(dims)")
        build_own = cls.build

        @functools.wraps(build_own)
        def build_single(self: Any, dims: EnvDims) -> Network:
            from mqe_jax.core.precision import single

            return Network._make(
                single(part) if callable(part) else part for part in build_own(self, dims)
            )

        cls.build = build_single
        NETWORKS[name] = name_settings(cls, name)
        return NETWORKS[name]

    return register


def network_settings(value: Any) -> Any:
    """Returns the settings that a mapping with a `name` describes (by default actor_critic)."""
    if not isinstance(value, Mapping):
        return value
    name = value.get("name", "actor_critic")
    if not isinstance(name, str) or name not in NETWORKS:
        hint = nearest(name, NETWORKS)
        fail("name", name, f"a registered network: {', '.join(NETWORKS)}{hint}")
    return build(NETWORKS[name], value)


@register_network("actor_critic")
class ActorCritic(GaussianSettings):
    """Settings of actor and critic: hidden layers, an optional recurrent unit, a Gaussian policy.

    Example:
        ```python
        from mqe_jax.train.networks import ActorCritic

        config = mqe_jax.TrainConfig(network=ActorCritic(hidden_sizes=(128, 64), recurrent=False))
        ```
    """

    critic_input: Literal["privileged", "observations", "own"] = "privileged"
    """Critic input: the privileged observation, all agents' observations, or each agent's own."""
    share_policy: bool = True
    """Share one actor between all agents, distinguished only by an id in their observations; else
    one per agent."""
    hidden_sizes: Widths = (64,)
    """Widths of the hidden layers of actor and critic."""
    activation: Literal["relu", "elu", "tanh"] = "relu"
    """Activation after each hidden layer."""
    openrl_layers: bool = False
    """Add the layers of OpenRL's networks: a normalisation after each hidden layer and after the
    recurrent unit, and a linear layer with its own normalisation after the hidden layers."""
    recurrent: bool = True
    """Use a gated recurrent unit after the hidden layers of actor and critic."""
    gru_size: Width = 64
    """Width of the recurrent unit."""
    chunk_length: Horizon = 2
    """Steps of truncated backpropagation through time; used with `recurrent`."""
    action_gain: Positive = 0.01
    """Gain of the orthogonal initialisation of the action layer."""
    action_mean: Literal["linear", "tanh"] = "linear"
    """Output activation of the mean action: linear (unbounded) or tanh."""

    @property
    def critic_reads(self) -> tuple[str, ...]:
        return ("privileged_obs",) if self.critic_input == "privileged" else ("obs",)

    def build(self, dims: EnvDims) -> Network:
        return load("mqe_jax.train.actor_critic:network")(self, dims)


@register_network("blocks")
class Blocks(ActorCritic):
    """Settings of an actor and critic that encode an observation block by block.

    The layout describes the blocks. Entities of one kind share parameters, so that the sizes of the
    actor do not depend on their number. Convolutions encode images. Entities of a kind share the
    statistics of their features; masks and pixels have none.
    """

    entity_sizes: Widths = (64, 64)
    """Widths of the layers that encode each entity; maxima and means over a block's entities
    follow."""
    image_channels: Widths = (16, 32)
    """Channels of the convolutions of images, each of which halves height and width."""
    image_size: Width = 64
    """Width of the layer after the convolutions."""

    @property
    def any_size(self) -> bool:
        return self.share_policy

    def features(self, dims: EnvDims) -> Features:
        from mqe_jax.train.normalize import features_of

        return features_of(dims.blocks)


@register_network("mat")
class Mat(GaussianSettings):
    """Settings of the multi-agent transformer."""

    blocks: Depth = 1
    """Blocks of the encoder and of the decoder."""
    heads: Width = 1
    """Attention heads; a divisor of `width`."""
    width: Width = 64
    """Width of every layer."""
    gain: Positive = 0.01
    """Gain of the orthogonal initialisation of attention, of residual branches' last layers, and of
    output layers."""
    deviation: Literal["sigmoid", "free"] = "sigmoid"
    """Standard deviation of the actions: 0.5 x sigmoid(parameter), 0.366 initially (OpenRL), or an
    unconstrained log, the only choice that uses log_std_*."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.width % self.heads:
            fail("heads", self.heads, f"a divisor of width ({self.width})")

    @property
    def critic_reads(self) -> tuple[str, ...]:
        return ("obs",)

    @property
    def mixes_agents(self) -> bool:
        return True

    def build(self, dims: EnvDims) -> Network:
        return load("mqe_jax.train.mat:network")(self, dims)
