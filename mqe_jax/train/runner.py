"""The driver of a training: a run folder that holds settings, metrics, checkpoints and the policy."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import yaml

from mqe_jax.files import write_atomically
from mqe_jax.train.checkpoint import latest, load_checkpoint, save_checkpoint
from mqe_jax.train.config import TrainConfig, config_to_mapping, load_config
from mqe_jax.train.learner import Learner, TrainState, env_sizes, make_learner
from mqe_jax.train.logs import CsvLog, ProgressLog, TensorBoardLog
from mqe_jax.train.policy import policy_of, save_policy
from mqe_jax.train.types import VectorEnv

CONFIG_FILE = "config.yaml"

OnUpdate = Callable[[TrainState, dict[str, float]], None]

_MAY_CHANGE = ("total_steps", "checkpoint_every", "checkpoints_kept")


def train(
    env: VectorEnv,
    config: TrainConfig,
    run_dir: str | Path,
    resume: bool = False,
    on_update: OnUpdate | None = None,
) -> TrainState:
    """Trains until `config.total_steps` and returns the last state; everything lands in `run_dir`.

    The folder gets config.yaml, metrics.csv, tensorboard/, checkpoints/ and policy.safetensors. With
    `resume` the newest checkpoint goes on as if the training had never stopped (from the start where there
    is none yet). `on_update(state, row)` is called after every update with its row of metrics.csv.
    Raises ValueError before any work where the folder cannot be written, already holds a run that is not to
    be resumed, or holds one of other settings.
    """
    run_dir = Path(run_dir)
    learner = make_learner(env, config)
    checkpoint = _prepare_folder(run_dir, config, resume)
    state, seconds = _first_state(env, learner, config, checkpoint)
    text = yaml.safe_dump(config_to_mapping(config), sort_keys=False)
    write_atomically(run_dir / CONFIG_FILE, text.encode())
    update = jax.jit(learner.update)
    env_steps = int(state.updates) * config.steps_per_update
    csv_log, tensorboard_log = CsvLog(run_dir, env_steps), TensorBoardLog(run_dir, env_steps)
    began = time.perf_counter() - seconds
    saved = -1 if checkpoint is None else env_steps

    def save() -> None:
        nonlocal saved
        step = int(state.updates) * config.steps_per_update
        if saved != step:
            metadata = {
                "task": env.name,
                "config": config_to_mapping(config),
                "seconds": time.perf_counter() - began,
            }
            save_policy(run_dir, policy_of(state, env_sizes(env), config, task=env.name, env_steps=step))
            save_checkpoint(run_dir, state, step, metadata, config.checkpoints_kept)
            saved = step

    total_steps = config.num_updates * config.steps_per_update
    try:
        with ProgressLog(config.task or env.name, env_steps, total_steps) as progress_log:
            while env_steps < total_steps:
                update_began = time.perf_counter()
                after, metrics = update(state)
                row = _row(after, jax.device_get(metrics), config, began, update_began)
                for log in (csv_log, tensorboard_log, progress_log):
                    log.write(row)
                # Only now, so that an interrupted training is saved with no more updates than its logs show.
                state, env_steps = after, int(row["env_steps"])
                if on_update is not None:
                    on_update(state, row)
                if int(row["updates"]) % config.checkpoint_every == 0:
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
    """Reads the settings of a run's folder; raises a ValueError that names the file."""
    return load_config(Path(run_dir) / CONFIG_FILE)


def initial_key(config: TrainConfig) -> jax.Array:
    """Returns the random key (raw uint32) from which a training of these settings begins."""
    return jax.random.PRNGKey(config.seed)


def _row(
    state: TrainState, metrics: dict[str, Any], config: TrainConfig, began: float, update_began: float
) -> dict[str, float]:
    """Returns a row of metrics.csv: steps and times first, then the update's metrics by name."""
    now = time.perf_counter()
    updates = int(state.updates)
    row: dict[str, float] = {
        "env_steps": updates * config.steps_per_update,
        "updates": updates,
        "seconds": now - began,
        "fps": config.steps_per_update / (now - update_began),
    }
    row.update({name: float(np.asarray(value)) for name, value in sorted(metrics.items())})
    return row


def _prepare_folder(run_dir: Path, config: TrainConfig, resume: bool) -> Path | None:
    """Makes the run's folder and checks what it holds; returns the checkpoint to go on from, if any."""
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=run_dir):
            pass
    except OSError as error:
        raise ValueError(f"run_dir: {run_dir} cannot be written ({error.strerror or error})") from None
    checkpoint = latest(run_dir)
    if checkpoint is not None and not resume:
        raise ValueError(f"run_dir: {run_dir} already holds a run; resume it (--resume) or name another folder")
    if checkpoint is not None:
        _check_same(run_dir, config)
    return checkpoint


def _check_same(run_dir: Path, config: TrainConfig) -> None:
    """Raises a ValueError naming the first setting in which the run to resume differs."""
    before = config_to_mapping(load_run_config(run_dir))
    for name, value in config_to_mapping(config).items():
        if name not in _MAY_CHANGE and before[name] != value:
            raise ValueError(
                f"{name}: {value!r} differs from the run in {run_dir}, which has {before[name]!r}; "
                f"a resumed run may change only {', '.join(_MAY_CHANGE)}"
            )


def _first_state(
    env: VectorEnv, learner: Learner, config: TrainConfig, checkpoint: Path | None
) -> tuple[TrainState, float]:
    """Returns the state to start from and the seconds that the training has already taken."""
    if checkpoint is None:
        return jax.jit(learner.init)(initial_key(config)), 0.0
    template = jax.eval_shape(learner.init, initial_key(config))
    restored = load_checkpoint(checkpoint, template)
    if restored.metadata.get("task") != env.name:
        raise ValueError(f"{checkpoint}: belongs to task {restored.metadata.get('task')}, not {env.name}")
    state = jax.tree.map(jnp.asarray, restored.tree)
    seconds = float(restored.metadata.get("seconds", 0.0))
    if not math.isfinite(seconds):
        raise ValueError(f"{checkpoint}: seconds: {seconds} is not a finite number")
    return state, seconds
