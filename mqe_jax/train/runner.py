"""The training loop: updates, logs, and a run folder with settings, metrics, checkpoints and the policy."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import yaml

from mqe_jax.errors import InputError
from mqe_jax.files import write_atomically
from mqe_jax.settings import to_mapping
from mqe_jax.train.checkpoint import latest, load_checkpoint, save_checkpoint
from mqe_jax.train.config import TrainConfig, load_config
from mqe_jax.train.learner import Learner, TrainState, env_dims, make_learner
from mqe_jax.train.logs import CsvLog, ProgressLog, TensorBoardLog
from mqe_jax.train.policy import policy_of, save_policy
from mqe_jax.train.types import VectorEnv

CONFIG_FILE = "config.yaml"

OnUpdate = Callable[[TrainState, dict[str, float]], None]

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
        resume: continues exactly from the newest checkpoint (from the start where there is none yet).
        on_update: called after every update with the state and its row of metrics.csv.

    Raises:
        InputError: before any work, where the folder cannot be written, already holds a run that is not to be
            resumed, or holds one of other settings.
    """
    run_dir = Path(run_dir)
    learner = make_learner(env, config)
    checkpoint = _prepare_folder(run_dir, config, resume)
    state, seconds = _first_state(env, learner, config, checkpoint)
    text = yaml.safe_dump(to_mapping(config), sort_keys=False)
    write_atomically(run_dir / CONFIG_FILE, text.encode())
    update = jax.jit(learner.update)
    env_steps = int(state.updates) * config.steps_per_update
    csv_log, tensorboard_log = CsvLog(run_dir, env_steps), TensorBoardLog(run_dir, env_steps)
    start_time = time.perf_counter() - seconds
    saved = -1 if checkpoint is None else env_steps

    def save() -> None:
        nonlocal saved
        step = int(state.updates) * config.steps_per_update
        if saved != step:
            metadata = {
                "task": env.name,
                "config": to_mapping(config),
                "seconds": time.perf_counter() - start_time,
            }
            save_policy(run_dir, policy_of(state, env_dims(env, config), config, task=env.name, env_steps=step))
            save_checkpoint(run_dir, state, step, metadata, config.checkpoint.kept)
            saved = step

    total_steps = config.num_updates * config.steps_per_update
    try:
        with ProgressLog(config.task or env.name, env_steps, total_steps) as progress_log:
            while env_steps < total_steps:
                update_began = time.perf_counter()
                after, metrics = update(state)
                row = _row(after, jax.device_get(metrics), config, start_time, update_began)
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


def _prepare_folder(run_dir: Path, config: TrainConfig, resume: bool) -> Path | None:
    """Creates the run's folder and checks its content; returns the checkpoint to resume from, if any."""
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=run_dir):
            pass
    except OSError as error:
        raise InputError(f"run_dir: {run_dir} cannot be written ({error.strerror or error})") from None
    checkpoint = latest(run_dir)
    if checkpoint is not None and not resume:
        raise InputError(f"run_dir: {run_dir} already holds a run; resume it (--resume) or name another folder")
    if checkpoint is not None:
        _check_same(run_dir, config)
    return checkpoint


def _check_same(run_dir: Path, config: TrainConfig) -> None:
    """Raises an InputError naming the first setting in which the run to resume differs."""
    before = dict(_leaves(to_mapping(load_run_config(run_dir))))
    for name, value in _leaves(to_mapping(config)):
        if name.split(".")[0] not in _MAY_CHANGE and before.get(name) != value:
            raise InputError(
                f"{name}: {value!r} differs from the run in {run_dir}, which has {before.get(name)!r}; "
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
    template = jax.eval_shape(learner.init, initial_key(config))
    restored = load_checkpoint(checkpoint, template)
    if restored.metadata.get("task") != env.name:
        raise InputError(f"{checkpoint}: belongs to task {restored.metadata.get('task')}, not {env.name}")
    state = jax.tree.map(jnp.asarray, restored.tree)
    seconds = float(restored.metadata.get("seconds", 0.0))
    if not math.isfinite(seconds):
        raise InputError(f"{checkpoint}: seconds: {seconds} is not a finite number")
    return state, seconds
