"""A trained policy outside the training loop: save, load, act."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from mqe_jax.train.checkpoint import load_tree, read_metadata, save_tree
from mqe_jax.train.config import TrainConfig, config_from_mapping, config_to_mapping
from mqe_jax.train.learner import TrainState
from mqe_jax.train.networks import Params, Sizes, make_network
from mqe_jax.train.normalize import RunningStatistics, running_init, running_normalize
from mqe_jax.train.types import Memory

POLICY_FILE = "policy.safetensors"


@dataclass(frozen=True)
class Policy:
    """A team's policy. `act` gives every agent's action; `initial_memory` what it remembers at a start."""

    params: Params  # actor and log_std
    normalizer: RunningStatistics
    sizes: Sizes
    config: TrainConfig
    metadata: Mapping[str, Any]  # task, step, and whatever the training noted

    def initial_memory(self, num_envs: int | None = None) -> Memory:
        """Returns the memory of an episode's start: leading axis N, or none for a single world."""
        memory = make_network(self.sizes, self.config).initial_memory(num_envs or 1)["actor"]
        return jax.tree.map(lambda x: x[0], memory) if num_envs is None else memory

    def act(
        self, obs: Any, memory: Memory, key: jax.Array | None = None, *, deterministic: bool = False
    ) -> tuple[jax.Array, Memory]:
        """Returns actions in [-1, 1] and the next memory: obs (N, A, O) or (A, O) -> (N, A, D) or (A, D).

        Without a key, or with `deterministic`, the action is the policy's mean. Memory is put back to
        `initial_memory` by the caller where an episode starts. Raises ValueError for another shape of obs.
        """
        obs = jnp.asarray(obs, jnp.float32)
        agents, size = self.sizes.agents, self.sizes.observation
        if obs.ndim < 2 or obs.shape[-2:] != (agents, size):
            raise ValueError(f"obs: shape {obs.shape} is not allowed; it must end in {agents} agents, {size} numbers")
        act = _acting(self.sizes, self.config)
        return act(self.params, self.normalizer, obs, memory, None if deterministic else key)


@functools.lru_cache(maxsize=32)
def _acting_cached(sizes: Sizes, settings: tuple[tuple[str, Any], ...]) -> Any:
    config = config_from_mapping(dict(settings))
    network = make_network(sizes, config)

    @jax.jit
    def act(
        params: Params,
        normalizer: RunningStatistics,
        obs: jax.Array,
        memory: Memory,
        key: jax.Array | None,
    ) -> tuple[jax.Array, Memory]:
        if config.normalize_observations:
            obs = running_normalize(normalizer, obs)
        action, _, memory = network.act(params, memory, obs, key)
        return jnp.clip(action, -1.0, 1.0), memory

    return act


def _acting(sizes: Sizes, config: TrainConfig) -> Any:
    """Returns the compiled act of a network; only the settings that shape it tell networks apart."""
    names = (
        "critic_input share_policy hidden_sizes activation recurrent gru_size action_mean "
        "normalize_observations value ratio log_std_init log_std_max log_std_min"
    ).split()
    return _acting_cached(sizes, tuple((name, getattr(config, name)) for name in names))


def policy_of(state: TrainState, sizes: Sizes, config: TrainConfig, **metadata: Any) -> Policy:
    """Returns the policy of a training state."""
    params = {name: state.params[name] for name in ("actor", "log_std")}
    return Policy(params, state.obs_normalizer.obs, sizes, config, metadata)


def save_policy(run_dir: str | Path, policy: Policy) -> Path:
    """Writes `policy.safetensors` into a run's folder, whole."""
    path = Path(run_dir) / POLICY_FILE
    metadata = {
        **policy.metadata,
        "sizes": policy.sizes._asdict(),
        "config": config_to_mapping(policy.config),
    }
    tree = {"params": policy.params, "normalizer": policy.normalizer}
    save_tree(path, tree, metadata, kind="policy")
    return path


def load_policy(run: str | Path) -> Policy:
    """Reads the policy of a run's folder, or a policy file.

    Raises ValueError, in one line naming the file, where it is missing, damaged or foreign.
    """
    path = Path(run)
    if path.is_dir():
        path = path / POLICY_FILE
    metadata = read_metadata(path, kind="policy")
    try:
        sizes = Sizes(**metadata.pop("sizes"))
        config = config_from_mapping(metadata.pop("config"))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: its settings cannot be read ({error})") from None

    def template() -> dict[str, Any]:
        params = make_network(sizes, config).init(jax.random.PRNGKey(0))
        return {
            "params": {name: params[name] for name in ("actor", "log_std")},
            "normalizer": running_init(sizes.observation),
        }

    tree = load_tree(path, jax.eval_shape(template), kind="policy").tree
    return Policy(tree["params"], tree["normalizer"], sizes, config, metadata)
