"""Trained policies, which are saved, loaded and exchanged."""

import dataclasses
import functools
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from annotated_types import Ge

from mqe_jax.core import imports
from mqe_jax.core.errors import InputError, NonFiniteError
from mqe_jax.core.files import check_folder, check_locks, digest
from mqe_jax.core.precision import single
from mqe_jax.core.settings import build, check, checked, fail, to_mapping
from mqe_jax.core.types import (
    Memory,
    Observations,
    Params,
    RandomKey,
    VectorEnv,
    group_sizes,
)
from mqe_jax.train.checkpoint import Stored, nonfinite, read_file, save_tree
from mqe_jax.train.config import TrainConfig, without_retired
from mqe_jax.train.learner import TrainState
from mqe_jax.train.needs import Needs, needs_of, unmet
from mqe_jax.train.networks import EnvDims, NetworkSettings
from mqe_jax.train.normalize import RunningStatistics, running_init, running_normalize

POLICY_FILE = "policy.safetensors"


class Form(NamedTuple):
    """What trained policies have in common if they can be exchanged within compiled code."""

    needs: Needs
    """What they need of their environment."""
    network: NetworkSettings
    """Settings of their network."""
    normalize: bool
    """Whether they normalise observations."""
    deterministic: bool
    """Whether they act with their mean actions."""

    def by_name(self) -> dict[str, Any]:
        """Returns all parts by the names that settings and `Needs` have."""
        network = {f"network.{name}": value for name, value in vars(self.network).items()}
        settings = {"normalization.observations": self.normalize}
        return {
            **self.needs.by_name(),
            **network,
            **settings,
            "deterministic": self.deterministic,
        }


@jax.tree_util.register_dataclass
@dataclass(frozen=True, repr=False)
class Actor:
    """The acting half of a `TrainedPolicy`: a pytree of its arrays, whose structure is its form."""

    params: Params
    """Parameters as `Network.policy_params` returns them."""
    normalizer: RunningStatistics
    """Statistics of the observations."""
    action_scale: jax.Array
    """Factor on the network's actions () float32."""
    form: Form = dataclasses.field(metadata={"static": True})
    """What it shares with others for which it can be exchanged."""

    def __repr__(self) -> str:
        mode = "mean" if self.form.deterministic else "sampled"
        return f"<Actor of {self.form.needs.task}: {self.form.network.name}, {mode} actions>"

    @property
    def digest(self) -> str:
        """The SHA-256 of its arrays."""
        content = hashlib.sha256()
        for array in jax.tree.leaves(self):
            content.update(np.asarray(array).tobytes())
        return content.hexdigest()

    @property
    def groups(self) -> tuple[str, ...]:
        """The group of observations that it sees."""
        return (self.form.needs.group,)

    def initial_memory(self, num_envs: int) -> Memory:
        """Returns the recurrent state at an episode's start, leading axis N."""
        network = self.form.network.build(self.form.needs.dims)
        return network.initial_memory(num_envs).actor

    def act(
        self, seen: Observations, memory: Memory, key: jax.Array | None
    ) -> tuple[jax.Array, Memory]:
        """Returns actions (N, A, D) in [-1, 1] and the next recurrent state.

        Without a key, the actions are the means.
        """
        obs = seen.group(self.form.needs.group)
        key = None if self.form.deterministic else key
        return _act(self, obs, memory, key, seen.active)


@jax.jit
def _act(
    actor: Actor, obs: jax.Array, memory: Memory, key: jax.Array | None, active: jax.Array | None
) -> tuple[jax.Array, Memory]:
    dims = actor.form.needs.dims
    network = actor.form.network.build(dims)
    if actor.form.normalize:
        obs = running_normalize(actor.normalizer, obs, actor.form.network.features(dims))
    if active is not None:
        obs = jnp.where(active[..., None], obs, 0.0)
    action, _, memory = network.act(actor.params, memory, obs, key, active)
    return jnp.clip(actor.action_scale * action, -1.0, 1.0), memory


@dataclass(frozen=True)
class TrainedPolicy:
    """The policy of a network for a team."""

    params: Params
    """Parameters as `Network.policy_params` returns them."""
    normalizer: RunningStatistics
    """Statistics of the observations."""
    needs: Needs
    """What it needs of its environment."""
    config: TrainConfig
    """Settings with which it was trained."""
    metadata: Mapping[str, Any]
    """Further entries of the file: env_steps, the card of a shipped policy."""
    deterministic: bool = False
    """Whether it acts with its mean actions; otherwise they are sampled."""

    def __repr__(self) -> str:
        mode = "mean" if self.deterministic else "sampled"
        return f"<TrainedPolicy of {self.task}: {self.config.network.name}, {mode} actions>"

    @property
    def task(self) -> str:
        """Id of the task."""
        return self.needs.task

    @property
    def dims(self) -> EnvDims:
        """Sizes of the environment in which it was trained."""
        return self.needs.dims

    @property
    def agents(self) -> int:
        """Number of agents of the team."""
        return self.dims.agents

    @property
    def groups(self) -> tuple[str, ...]:
        """The group of observations that it sees."""
        return (self.needs.group,)

    @property
    def form(self) -> Form:
        """Everything but the arrays.

        Policies of equal form can be exchanged within compiled code.
        """
        normalize = self.config.normalization.observations
        return Form(self.needs, self.config.network, normalize, self.deterministic)

    @property
    def actor(self) -> Actor:
        """The policy as a pytree of its arrays."""
        scale = jnp.float32(self.config.action_scale)
        return Actor(self.params, self.normalizer, scale, self.form)

    def acting(self, deterministic: bool) -> Self:
        """Returns the policy that acts with its mean actions, or samples them."""
        return dataclasses.replace(self, deterministic=deterministic)

    def at_size(self, env: Any) -> Self:
        """Returns the policy for the numbers of agents and entities in an environment.

        A policy of fixed sizes stays as it is.
        """
        if not self.config.network.any_size or self.needs.group not in group_sizes(env):
            return self
        needs = self.needs.at_size(needs_of(env, self.config))
        return self if needs == self.needs else dataclasses.replace(self, needs=needs)

    def unmet(self, env: Any) -> dict[str, tuple[Any, Any]]:
        """Returns what it needs and an environment lacks: the values of both by name."""
        return unmet(self.needs, env, self.config)

    def initial_memory(self, num_envs: int | None = None) -> Memory:
        """Returns the initial recurrent state: leading axis N, or none for a single environment."""
        memory = self.actor.initial_memory(num_envs or 1)
        return jax.tree.map(lambda x: x[0], memory) if num_envs is None else memory

    @single
    @checked
    def act(
        self, obs: Any, memory: Memory, key: RandomKey | None = None
    ) -> tuple[jax.Array, Memory]:
        """Returns actions in [-1, 1] and the next memory.

        `obs` (N, A, O) or (A, O) gives actions (N, A, D) or (A, D). It may also be `Observations`,
        which say who takes part. In an array, an agent whose numbers are all 0 takes no part if the
        network mixes agents (`NetworkSettings.mixes_agents`).
        `memory` is the recurrent state; the caller resets it to `initial_memory` at an episode's
        start. Without a key, the action is the mean.

        Raises:
            InputError: for an observation of another shape.
        """
        group = self.needs.group
        seen = Observations.at(obs, group)
        given = check_obs(seen.group(group), self.dims.agents, self.dims.observation)
        active = seen.active
        if seen is not obs and self.config.network.mixes_agents:
            active = jnp.any(given != 0.0, axis=-1)
        return self.actor.act(Observations({group: given}, active), memory, key)


@functools.lru_cache(maxsize=32)
def template(dims: EnvDims, settings: NetworkSettings) -> dict[str, Any]:
    """Returns the shapes of the parameters and the statistics of a network's policy."""
    network = settings.build(dims)

    def arrays() -> dict[str, Any]:
        params = network.policy_params(network.init(jax.random.PRNGKey(0)))
        return {
            "params": params,
            "normalizer": running_init(dims.observation, settings.features(dims)),
        }

    return jax.eval_shape(arrays)


def check_obs(obs: Any, agents: int, size: int | None = None) -> jax.Array:
    """Returns observations (..., agents, size) as an array; InputError for anything else."""
    try:
        obs = jnp.asarray(obs, jnp.float32)
    except (TypeError, ValueError, OverflowError):
        fail("obs", obs, "an array of numbers")
    if obs.ndim < 2 or obs.shape[-2] != agents or size not in (None, obs.shape[-1]):
        raise InputError(
            f"obs: shape {obs.shape} is not allowed; it must end in ({agents} agents, "
            f"{size or 'their'} numbers)"
        )
    return obs


def policy_of(
    state: TrainState, env: VectorEnv, config: TrainConfig, **metadata: Any
) -> TrainedPolicy:
    """Returns the policy of a learner state, which learns in an environment."""
    needs = needs_of(env, config)
    policy_params = config.network.build(needs.dims).policy_params(state.params)
    return TrainedPolicy(policy_params, state.obs_normalizer.obs, needs, config, metadata)


@checked
def save_policy(
    run_dir: str | Path, policy: TrainedPolicy, name: str = POLICY_FILE, *, half: bool = False
) -> Path:
    """Writes a policy into a folder, which it creates.

    The write is atomic. The file also holds whether the policy acts with its mean actions. With
    `half`, its parameters are float16.

    Example:
        ```python
        from mqe_jax.train.policy import save_policy

        file = save_policy("runs/own", mqe_jax.load_policy("go1gate"))
        policy = mqe_jax.load_policy(file)
        ```

    Raises:
        InputError: for a folder that cannot be written.
        NonFiniteError: for weights or statistics that are NaN or infinite.
    """
    path = Path(run_dir) / name
    arrays, metadata = _file_content(policy, half)
    if wrong := nonfinite(arrays):
        raise NonFiniteError(
            f"{path}: not written, because {wrong[0]} holds NaN or infinite numbers"
        )
    check_locks(path)
    check_folder(path.parent)
    save_tree(path, arrays, metadata, kind="policy")
    return path


def _file_content(policy: TrainedPolicy, half: bool) -> tuple[dict[str, Any], dict[str, Any]]:
    """Returns the arrays and the metadata of a policy's file."""
    params = policy.params
    if half:
        params = jax.tree.map(
            lambda x: x.astype(jnp.float16) if x.dtype == jnp.float32 else x, params
        )
    records = {"needs": to_mapping(policy.needs), "config": to_mapping(policy.config)}
    metadata = {**policy.metadata, **records, "deterministic": policy.deterministic}
    return {"params": params, "normalizer": policy.normalizer}, metadata


@single
def read_policy(run: str | Path) -> TrainedPolicy:
    """Reads the policy of a run folder, or a policy file.

    Parameters stored as float16 become float32.

    Raises:
        InputError: naming the file, if it is missing, damaged, of another format or non-finite.
    """
    file = policy_path(run)
    return policy_in(read_file(file, kind="policy"))


def needed_imports(metadata: Mapping[str, Any]) -> str:
    """Returns the flags of `mqe` for imports of a policy's training that this process lacks."""
    names = check("imports", metadata.get("imports", ()), tuple[str, ...])
    return imports.flags(name for name in names if name not in imports.IMPORTED)


def policy_path(run: str | Path) -> Path:
    """Returns the policy file of a run folder, or a policy file itself."""
    path = Path(run)
    return path / POLICY_FILE if path.is_dir() else path


@single
def policy_in(stored: Stored) -> TrainedPolicy:
    """Returns the policy that a file holds; errors as `read_policy`."""
    metadata = dict(stored.metadata)
    if "members" in metadata:
        raise InputError(
            f"{stored.path}: holds a mixture of policies, which version 0.4 does not read"
        )
    flags = ""
    try:
        flags = needed_imports(metadata)
        needed = metadata.pop("needs")
        needs = build(Needs, needed)
        config = build(TrainConfig, without_retired(metadata.pop("config")))
        weights = config.env.get("skill_weights")
        if weights and needs.control == "command" and "skill_weights" not in needed:  # before 0.4
            known = digest(weights) if Path(weights).is_file() else "unknown"
            needs = dataclasses.replace(needs, skill_weights=known)
        deterministic = check("deterministic", metadata.pop("deterministic", False), bool)
        check("env_steps", metadata.get("env_steps", 0), Annotated[int, Ge(0)])
    except (KeyError, TypeError, AttributeError, InputError) as error:
        hint = f"; add {flags}" if flags else ""
        raise InputError(f"{stored.path}: its settings cannot be read ({error}){hint}") from None
    tree = stored.tree(template(needs.dims, config.network), half=True)
    return TrainedPolicy(tree["params"], tree["normalizer"], needs, config, metadata, deterministic)
