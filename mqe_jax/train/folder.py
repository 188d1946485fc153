"""A run folder: its files, and what is checked and locked before a training writes to it.

| file | contents |
|---|---|
| config.yaml | settings |
| metrics.csv | one row an update (`logs.CsvLog`); other loggers write tensorboard/ and wandb/ |
| policy.safetensors | the newest policy (`policy.save_policy`) |
| checkpoints/ | complete learner states (`checkpoint.save_checkpoint`) |
| evaluations.json | evaluations in training (`monitor.EvaluationLog`); best/ has the best policy |
"""

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import yaml

from mqe_jax.core.errors import InputError
from mqe_jax.core.files import check_folder, lock, write_atomically
from mqe_jax.core.settings import to_mapping
from mqe_jax.train.checkpoint import checkpoint_step, latest, list_checkpoints
from mqe_jax.train.config import CONFIG_FILE, TrainConfig, load_config
from mqe_jax.train.logs import CSV_FILE
from mqe_jax.train.monitor import EVALUATIONS_FILE
from mqe_jax.train.policy import POLICY_FILE

RUN_FILES = (CONFIG_FILE, CSV_FILE, POLICY_FILE, EVALUATIONS_FILE)
"""Names of a run's files beside its checkpoints."""

_FOLDERS = ("checkpoints", "best", "tensorboard", "wandb")
_OUTPUT = (".log", ".out", ".err", ".txt")  # of commands, in the folder of their run


@contextlib.contextmanager
def open_folders(folders: Sequence[Path], resume: bool) -> Iterator[None]:
    """Creates run folders and locks them while a training runs.

    InputError for a folder that holds a run, or with `resume` for one that cannot be resumed.
    """
    with contextlib.ExitStack() as locks:
        check_folders(folders, resume)
        for folder in folders:
            locks.enter_context(lock(folder))
        for folder in folders:
            check_run(folder, resume)
        yield


def check_folders(folders: Sequence[Path], resume: bool) -> None:
    """Raises an InputError if a training cannot start or, with `resume`, continue in folders."""
    for folder in folders:
        check_links(folder)
        check_alone(folder)
        check_folder(folder)
        check_run(folder, resume)
    if resume:
        common_checkpoints(folders)


def write_config(folder: Path, config: TrainConfig) -> None:
    """Writes the settings of a run."""
    write_atomically(
        folder / CONFIG_FILE, yaml.safe_dump(to_mapping(config), sort_keys=False).encode()
    )


def load_run_config(run_dir: str | Path) -> TrainConfig:
    """Reads the settings of a run folder; raises an InputError that names the file."""
    return load_config(Path(run_dir) / CONFIG_FILE)


def common_checkpoints(folders: Sequence[Path]) -> list[Path | None]:
    """Returns each folder's checkpoint at the newest step that all have.

    Without such a step, all are None, for a start from scratch. That is an InputError if a folder
    has checkpoints, but none of step 0.
    """
    if not folders:
        return []
    by_step = [
        {checkpoint_step(path): path for path in list_checkpoints(folder)} for folder in folders
    ]
    common = set.intersection(*map(set, by_step))
    if common:
        return [steps[max(common)] for steps in by_step]
    if all(not steps or 0 in steps for steps in by_step):
        return [None] * len(folders)
    newest = [
        f"{run.name} {max(steps, default='none')}"
        for run, steps in zip(folders, by_step, strict=True)
    ]
    hint = f"({', '.join(newest)}); resume them separately"
    raise InputError(f"run_dir: {folders[0].parent}: no step has checkpoints of all seeds {hint}")


def check_links(run_dir: Path) -> None:
    """Raises an InputError if a training would replace or remove a link in the folder."""
    for name in (*RUN_FILES, *_FOLDERS):
        if (run_dir / name).is_symlink():
            raise InputError(
                f"run_dir: {run_dir / name} is a symbolic link; it must be in the run folder itself"
            )


def check_alone(run_dir: Path) -> None:
    """Raises an InputError for a folder inside another run's, or one that holds runs of seeds."""
    seeds = [folder for folder in sorted(run_dir.glob("seed*")) if latest(folder)]
    others = [run_dir.parent] * (latest(run_dir.parent) is not None) + seeds
    if others:
        raise InputError(
            f"run_dir: {run_dir} cannot hold a run, because {others[0]} holds another run; "
            "resume that one with all of its seeds, or name another folder"
        )


def check_run(run_dir: Path, resume: bool = False) -> None:
    """Raises an InputError for a folder that holds a run, unless `resume` continues it.

    A folder with other files but no checkpoint is an error in both cases.
    """
    checkpoint = latest(run_dir)
    if checkpoint is not None and not resume:
        raise InputError(
            f"run_dir: {run_dir} already holds a run; resume it, or name another folder"
        )
    inside = [path for path in sorted(run_dir.glob("[!.]*")) if path.suffix not in _OUTPUT]
    held = [path.name for path in inside if not path.is_dir() or any(path.glob("[!.]*"))]
    if held and checkpoint is None:
        raise InputError(
            f"run_dir: {run_dir} holds {', '.join(held[:3])} but no checkpoint; name another folder"
        )
