"""Implementations of `mqe sweep` and `mqe report`."""

from __future__ import annotations

import functools
import math
import shlex
from pathlib import Path
from typing import Any

from mqe_jax import interrupts
from mqe_jax.cli.arguments import Report, Sweep
from mqe_jax.cli.output import echo
from mqe_jax.cli.setup import base_config, environments, for_task
from mqe_jax.envs import ALIASES, TASKS
from mqe_jax.errors import InputError, nearest
from mqe_jax.study import report as reports
from mqe_jax.study import sweep as sweeps
from mqe_jax.study.runs import load_reference
from mqe_jax.train.config import TrainConfig


def sweep(arguments: Sweep) -> dict[str, Any]:
    """Trains the remaining runs of a sweep and writes its report, or prints their estimated time."""
    settings = sweeps.load_sweep(arguments.file, arguments.part)
    for task in settings.tasks:
        if task not in TASKS and task not in ALIASES:
            raise InputError(f"tasks: unknown {task!r}{nearest(task, TASKS)}; allowed: {', '.join(TASKS)}")
    folder = arguments.folder or Path("runs") / (arguments.part or arguments.file.stem)

    def config_of(task: str, algorithm: str) -> TrainConfig:
        name = settings.config and settings.config.replace("{task}", task)
        return for_task(base_config(task, name, algorithm), task)

    jobs = sweeps.plan(settings, folder, config_of, arguments.cells)
    result = _estimate(folder, jobs)
    if arguments.dry_run:
        if not arguments.json:
            _print(result)
        return result
    sweeps.prepare(settings, folder)
    cells = "".join(f" --cells {shlex.quote(cell)}" for cell in arguments.cells)
    part = "" if arguments.part is None else f" --part {shlex.quote(arguments.part)}"
    with interrupts.before_exit(lambda: f"resume with: mqe sweep {arguments.file}{part} --folder {folder}{cells}"):
        others = sweeps.run(folder, jobs, functools.partial(environments, arguments.impl))
    if others:
        skipped = ", ".join(job.cell.path.as_posix() for job in others)
        echo(f"mqe: skipped, in use by other processes: {skipped}")
    files = [] if len(others) == len(jobs) > 0 else reports.report(folder)
    if files:
        echo(f"mqe: wrote {files[-1]} and {len(files) - 1} more files")
    left = sweeps.plan(settings, folder, config_of, arguments.cells)
    return {"left": _estimate(folder, left), "report": [str(file) for file in files]}


def report(arguments: Report) -> dict[str, Any]:
    """Writes the report of a sweep from its finished runs."""
    reference = None if arguments.reference is None else load_reference(arguments.reference)
    files = reports.report(arguments.folder, reference)
    echo(f"mqe: wrote {files[-1]} and {len(files) - 1} more files")
    return {"report": [str(file) for file in files]}


def _estimate(folder: Path, jobs: list[sweeps.Job]) -> dict[str, Any]:
    """Returns the remaining jobs of a sweep, one row per job, plus totals."""
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
    total = sum(seconds) if seconds else 0.0
    steps = sum(job.steps_left for job in jobs)
    return {"jobs": rows, "steps_left": steps, "seconds": None if math.isnan(total) else round(total)}


def _print(result: dict[str, Any]) -> None:
    for row in [*result["jobs"], {"task": "all", "steps_left": result["steps_left"], "seconds": result["seconds"]}]:
        name = " ".join(str(row[key]) for key in ("task", "algorithm", "variant") if key in row)
        seeds = " ".join(map(str, row.get("seeds", [])))
        time = "time unknown" if row["seconds"] is None else f"{row['seconds'] / 3600:.2f} h"
        print(f"{name:<45} {f'seeds {seeds}' if seeds else '':<20} {row['steps_left'] / 1e6:>9.3g} M steps  {time}")
