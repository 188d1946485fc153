"""A sweep by one call: many trainings in one folder, and their report."""

import functools
import math
import secrets
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from mqe_jax import names
from mqe_jax.core.errors import InputError, NonFiniteError, one_line
from mqe_jax.core.files import write_atomically
from mqe_jax.core.imports import IMPORTED
from mqe_jax.core.limits import Positive, Seed
from mqe_jax.core.literal import echo
from mqe_jax.core.settings import checked, to_mapping
from mqe_jax.envs import QuadrupedEnv
from mqe_jax.envs.registry import task_id
from mqe_jax.presets import Layers
from mqe_jax.runs import cast
from mqe_jax.study import report as reports
from mqe_jax.study import sweep as sweeps
from mqe_jax.study.runs import Cell
from mqe_jax.study.sweep import Job, Sweep
from mqe_jax.train.config import TrainConfig


@checked
def sweep(
    file: str | Path,
    folder: str | Path,
    *,
    part: str | None = None,
    cells: Sequence[str] = (),
    seeds: Sequence[Seed] = (),
    time_limit: Positive | None = None,
    impl: str = "auto",
    dry_run: bool = False,
) -> dict[str, Any]:
    """Trains and reports all runs of a sweep, as `mqe sweep`.

    Its runs are all combinations of tasks, algorithms, variants and seeds. A second call resumes
    the sweep.

    Example:
        ```python
        from pathlib import Path

        Path("gate.yaml").write_text("{tasks: [go1gate], seeds: [0, 1]}")
        left = mqe_jax.sweep("gate.yaml", "runs/gates", dry_run=True)["left"]
        ```

    Args:
        file: YAML file with the fields of `mqe_jax.study.sweep.Sweep`.
        folder: folder of the sweep; runs go into runs/, the report into report/.
        part: name of one sweep in a file that maps names to sweeps.
        cells: patterns of the cells to train, TASK/ALGORITHM[+VARIANT]. Default: all.
        seeds: seeds to train. Default: all.
        time_limit: time after which the training in progress is saved and the sweep ends, min.
            Default: none.
        impl: physics engine: 'auto', 'jax', 'warp' or 'c'.
        dry_run: whether nothing is trained.

    Returns:
        `left`: the remaining trainings, `jobs`, and their `steps_left` and estimated `seconds`;
        `report`: files.

    Raises:
        InputError: for a file, a cell, a seed or a folder that is not allowed, or at the end if
            trainings failed.
        NonFiniteError: at the end, if the first training that failed became non-finite.
    """
    settings = sweeps.load_sweep(Path(file), part)
    for task in settings.tasks:
        task_id(task)
    options = {"cells": cells, "seeds": seeds, "time_limit": time_limit, "dry_run": dry_run}
    return _run(settings, Path(folder), impl, **options)


def _run(
    settings: Sweep,
    folder: Path,
    impl: str,
    env: QuadrupedEnv | None = None,
    *,
    cells: Sequence[str] = (),
    seeds: Sequence[int] = (),
    time_limit: float | None = None,
    dry_run: bool = False,
) -> dict[str, Any]:
    """Runs a sweep, of a passed environment if there is one; see `sweep`.

    Nobody knows whether another environment is the same, so that such a sweep does not resume.
    """
    began = time.monotonic()
    passed: dict[str, Any] = {} if env is None else {"environment": secrets.token_hex(4)}
    if IMPORTED:
        passed["imports"] = [*IMPORTED]

    def config_of(cell: Cell, layers: Layers) -> TrainConfig:
        named = {"config": settings.config and settings.config.replace("{task}", cell.task)}
        if cell.algorithm != "default":
            named["algorithm"] = cell.algorithm
        return names.settings(env or cell.task, named, layers=layers)

    def stop() -> bool:
        return time_limit is not None and time.monotonic() - began > 60.0 * time_limit

    sweeps.prepare(settings, folder, write=False)
    check = functools.partial(cast.check_start, impl=impl, task=env)
    jobs = sweeps.plan(settings, folder, config_of, cells, seeds, check, passed)
    if dry_run:
        return {"left": _estimate(folder, jobs), "report": []}
    sweeps.prepare(settings, folder)
    make = functools.partial(cast.environments, impl=impl, task=env)

    def report_failure(job, error):
        return echo(f"mqe: {_names([job])} failed: {one_line(error)}")

    others, failed = sweeps.run(jobs, make, report_failure, stop)
    if others:
        echo(f"mqe: skipped, in use by other processes: {_names(others)}")
    if stop():
        echo(f"mqe: time limit of {time_limit:g} min; the same command resumes")
    left = sweeps.remaining(jobs)
    files = reports.report(folder) if not jobs or len(left) < len(jobs) else []
    if files:
        echo(f"mqe: wrote {files[-1]} and {len(files) - 1} more files")
    if failed:
        kind = NonFiniteError if isinstance(failed[0][1], NonFiniteError) else InputError
        cells = _names([job for job, _ in failed])
        raise kind(f"cells: {len(failed)} of {len(jobs)} trainings failed: {cells}")
    return {"left": _estimate(folder, left), "report": [str(file) for file in files]}


def train_runs(
    plan: Sweep, folder: Path, file: str, impl: str, env: QuadrupedEnv | None = None
) -> list[Path]:
    """Trains all runs of a sweep, by default of its tasks; returns their folders, cell by cell.

    It also writes the sweep to a file.

    InputError if trainings failed or are left to other processes.
    """
    write_atomically(folder / file, yaml.safe_dump(to_mapping(plan), sort_keys=False).encode())
    settings = sweeps.load_sweep(folder / file)
    if left := _run(settings, folder, impl, env)["left"]["jobs"]:
        raise InputError(
            f"folder: {folder} has {len(left)} unfinished trainings; the same command resumes them"
        )
    return [
        folder / "runs" / cell.path / f"seed{seed}"
        for cell in sweeps.select(plan)
        for seed in plan.seeds
    ]


def _names(jobs: Sequence[Job]) -> str:
    return ", ".join(job.cell.path.as_posix() for job in jobs)


def _estimate(folder: Path, jobs: Sequence[Job]) -> dict[str, Any]:
    seconds = sweeps.estimate(folder, jobs)
    rows = [
        {
            "task": job.cell.task,
            "algorithm": job.cell.algorithm,
            "variant": job.cell.variant,
            "seeds": [config.seed for config in job.configs],
            "steps_left": job.steps_left,
            "seconds": None if math.isnan(s) else round(s),
        }
        for job, s in zip(jobs, seconds, strict=True)
    ]
    total = sum(seconds)
    steps = sum(job.steps_left for job in jobs)
    return {
        "jobs": rows,
        "steps_left": steps,
        "seconds": None if math.isnan(total) else round(total),
    }
