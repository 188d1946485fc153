"""The training loop: updates, logs, and a run folder with settings, metrics, checkpoints and the policy."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import yaml

from mqe_jax.errors import InputError, NonFiniteError
from mqe_jax.files import locked, write_atomically
from mqe_jax.settings import to_mapping
from mqe_jax.train.checkpoint import (
    latest,
    load_checkpoint,
    nonfinite,
    prepare_folder,
    read_metadata,
    save_checkpoint,
)
from mqe_jax.train.config import TrainConfig, load_config
from mqe_jax.train.learner import Learner, TrainState, env_dims, make_learner
from mqe_jax.train.logs import CSV_FILE, CsvLog, ProgressLog, TensorBoardLog
from mqe_jax.train.policy import POLICY_FILE, policy_of, save_policy
from mqe_jax.train.types import VectorEnv

CONFIG_FILE = "config.yaml"

OnUpdate = Callable[[TrainState, dict[str, float]], None]

_FINITE_METRICS = ("loss/policy", "loss/value", "entropy", "approx_kl", "grad_norm")
_MAY_CHANGE = ("total_steps", "checkpoint")


def train(
    env: VectorEnv,
    config: TrainConfig,
    run_dir: str | Path,
    resume: bool = False,
    on_update: OnUpdate | None = None,
) -> TrainState:
    """Trains until `config.total_steps` and returns the last state.

    Args:
        env: the environments.
        config: settings.
        run_dir: folder for config.yaml, metrics.csv, tensorboard/, checkpoints/ and policy.safetensors.
        resume: continues a run in the folder exactly from its newest checkpoint; an empty folder starts a new run.
        on_update: called after every update with the state and its row of metrics.csv.

    Raises:
        InputError: before anything in the folder is changed: where it cannot be written, is in use by another
            training, or holds a run that is not to be resumed, has no checkpoint, or has other settings.
        NonFiniteError: after the first update that makes a loss or a weight NaN or infinite. Checkpoints and policy
            on disk are those from before.
    """
    run_dir = Path(run_dir)
    learner = make_learner(env, config)
    checkpoint = prepare_folder(run_dir, resume, (CONFIG_FILE, CSV_FILE, POLICY_FILE))
    with locked(run_dir):
        return _train(env, learner, config, run_dir, checkpoint, on_update)


def _train(
    env: VectorEnv,
    learner: Learner,
    config: TrainConfig,
    run_dir: Path,
    checkpoint: Path | None,
    on_update: OnUpdate | None,
) -> TrainState:
    """Runs the updates that are left; the folder has been checked and locked."""
    state, seconds = _first_state(env, learner, config, checkpoint)
    update = jax.jit(learner.update)
    start_time = time.perf_counter() - seconds
    env_steps = int(state.updates) * config.steps_per_update
    saved = -1 if checkpoint is None else env_steps

    def save() -> None:
        nonlocal saved
        if saved != env_steps:
            seconds = time.perf_counter() - start_time
            metadata = {"task": env.name, "config": to_mapping(config), "seconds": seconds}
            save_checkpoint(run_dir, state, env_steps, metadata, config.checkpoint.kept)
            save_policy(run_dir, policy_of(state, env_dims(env, config), config, task=env.name, env_steps=env_steps))
            saved = env_steps

    save()  # so that a training killed before its first regular checkpoint can be resumed too
    write_atomically(run_dir / CONFIG_FILE, yaml.safe_dump(to_mapping(config), sort_keys=False).encode())
    csv_log, tensorboard_log = CsvLog(run_dir, env_steps), TensorBoardLog(run_dir, env_steps)
    total_steps = config.num_updates * config.steps_per_update
    try:
        with ProgressLog(config.task or env.name, env_steps, total_steps) as progress_log:
            while env_steps < total_steps:
                update_start = time.perf_counter()
                after, metrics = update(state)
                row = _row(after, jax.device_get(metrics), config, start_time, update_start)
                _check_finite(after, row, run_dir)
                for log in (csv_log, tensorboard_log, progress_log):
                    log.write(row)
                # Assigned after logging, so that an interrupted training saves no more updates than its logs show.
                state, env_steps = after, int(row["env_steps"])
                if on_update is not None:
                    on_update(state, row)
                if int(row["updates"]) % config.checkpoint.every == 0:
                    save()
        save()
    except KeyboardInterrupt:
        save()
        raise
    finally:
        csv_log.close()
        tensorboard_log.close()
    return state


def _check_finite(state: TrainState, row: Mapping[str, float], run_dir: Path) -> None:
    """Raises a NonFiniteError naming the first metrics and parameters that an update made NaN or infinite."""
    wrong = [name for name in _FINITE_METRICS if not math.isfinite(row[name])] + nonfinite(_learned(state))
    if wrong:
        kept = latest(run_dir)
        raise NonFiniteError(
            f"{run_dir}: update {row['updates']:.0f} ({row['env_steps']:.0f} environment steps) made "
            f"{', '.join(wrong[:3])} NaN or infinite; the last finite checkpoint is {kept.name if kept else 'missing'}"
        )


def _learned(state: TrainState) -> dict[str, Any]:
    """Returns everything that updates change, without the environments."""
    return {
        "params": state.params,
        "optimizer": state.optimizer,
        "obs_normalizer": state.obs_normalizer,
        "value_normalizer": state.value_normalizer,
        "learning_rate": state.learning_rate,
    }


def load_run_config(run_dir: str | Path) -> TrainConfig:
    """Reads the settings of a run's folder; raises an InputError that names the file."""
    return load_config(Path(run_dir) / CONFIG_FILE)


def initial_key(config: TrainConfig) -> jax.Array:
    """Returns the initial random key (raw uint32) of a training."""
    return jax.random.PRNGKey(config.seed)


def _row(
    state: TrainState, metrics: dict[str, Any], config: TrainConfig, start_time: float, update_began: float
) -> dict[str, float]:
    """Returns a row of metrics.csv: steps and times first, then the update's metrics by name."""
    now = time.perf_counter()
    updates = int(state.updates)
    row: dict[str, float] = {
        "env_steps": updates * config.steps_per_update,
        "updates": updates,
        "seconds": now - start_time,
        "fps": config.steps_per_update / (now - update_began),
    }
    row.update({name: float(np.asarray(value)) for name, value in sorted(metrics.items())})
    return row


def _check_same(path: Path, before: Mapping[str, Any], config: TrainConfig) -> None:
    """Raises an InputError naming the first setting in which the run to resume differs."""
    old = dict(_leaves(before))
    for name, value in _leaves(to_mapping(config)):
        if name.split(".")[0] not in _MAY_CHANGE and old.get(name) != value:
            raise InputError(
                f"{name}: {value!r} differs from the run in {path}, which has {old.get(name)!r}; "
                f"a resumed run may change only {', '.join(_MAY_CHANGE)}"
            )


def _leaves(mapping: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yields the dotted names and values of nested settings."""
    for name, value in mapping.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _first_state(
    env: VectorEnv, learner: Learner, config: TrainConfig, checkpoint: Path | None
) -> tuple[TrainState, float]:
    """Returns the initial or restored state and the seconds already spent."""
    if checkpoint is None:
        return jax.jit(learner.init)(initial_key(config)), 0.0
    metadata = read_metadata(checkpoint, kind="checkpoint")
    if metadata.get("task") != env.name:
        raise InputError(f"{checkpoint}: belongs to task {metadata.get('task')}, not {env.name}")
    _check_same(checkpoint.parent.parent, metadata.get("config", {}), config)
    template = jax.eval_shape(learner.init, initial_key(config))
    restored = load_checkpoint(checkpoint, template)
    if wrong := nonfinite(_learned(restored.tree)):
        raise InputError(f"{checkpoint}: {wrong[0]} holds NaN or infinite numbers")
    return jax.tree.map(jnp.asarray, restored.tree), float(metadata.get("seconds", 0.0))
