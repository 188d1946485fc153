"""The commands `sweep`, `report` and `tournament`."""

from __future__ import annotations

import functools
import math
import shlex
import time
from dataclasses import field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from mqe_jax.cli.options import Impl, Json, Repeated, Seed, TaskOptions
from mqe_jax.core import interrupts
from mqe_jax.core.errors import InputError, NonFiniteError, nearest, one_line
from mqe_jax.core.files import check_output
from mqe_jax.core.limits import Candidates, Positive
from mqe_jax.core.literal import echo, line
from mqe_jax.core.settings import fail, joined, record

if TYPE_CHECKING:
    from mqe_jax.study import sweep as sweeps


@record
class Sweep:
    """Train all combinations of tasks, algorithms, variants and seeds, and report; resumes interrupted runs."""

    file: tyro.conf.Positional[Path]
    """YAML file: tasks, algorithms, seeds, config, settings, variants (see docs/sweeps.md)."""
    json: Json = False
    part: str | None = None
    """Name of one sweep in a file that maps names to sweeps."""
    folder: Path | None = None
    """Folder of the sweep. Default: runs/PART, or runs/NAME of the file."""
    cells: Annotated[list[str], Repeated, tyro.conf.arg(metavar="CELL")] = field(default_factory=list)
    """Train these cells only: TASK/ALGORITHM, followed by +VARIANT in a sweep with variants; may be a pattern such as
    '*/mat', and may be repeated."""
    seeds: Annotated[list[int], Repeated, tyro.conf.arg(metavar="SEED")] = field(default_factory=list)
    """Train these seeds only; may be repeated."""
    time_limit: Annotated[Positive | None, tyro.conf.arg(metavar="MINUTES")] = None
    """Save the run in training after this time, min, and end; the same command resumes it."""
    dry_run: bool = False
    """Print the remaining training runs and their estimated time, without training."""
    impl: Impl = "auto"

    def run(self) -> dict[str, Any]:
        """Trains the remaining runs and writes the report, or prints their estimated time."""
        from mqe_jax.envs import ALIASES, TASKS
        from mqe_jax.runs.build import base_config, check_start, environments, for_task
        from mqe_jax.study import report as reports
        from mqe_jax.study import sweep as sweeps

        settings = sweeps.load_sweep(self.file, self.part)
        for task in settings.tasks:
            if task not in TASKS and task not in ALIASES:
                raise InputError(f"tasks: unknown {task!r}{nearest(task, TASKS)}; allowed: {', '.join(TASKS)}")
        folder = self.folder or Path("runs") / (self.part or self.file.stem)

        def config_of(task: str, algorithm: str) -> Any:
            name = settings.config and settings.config.replace("{task}", task)
            return for_task(base_config(task, name, None if algorithm == "default" else algorithm), task)

        began = time.monotonic()

        def stop() -> bool:
            return self.time_limit is not None and time.monotonic() - began > 60.0 * self.time_limit

        sweeps.prepare(settings, folder, write=False)
        check = functools.partial(check_start, impl=self.impl)
        jobs = sweeps.plan(settings, folder, config_of, self.cells, self.seeds, check)
        result = _estimate(sweeps.estimate(folder, jobs), jobs)
        if self.dry_run:
            if not self.json:
                _print(result)
            return result
        sweeps.prepare(settings, folder)
        cells = "".join(f" --cells {shlex.quote(cell)}" for cell in self.cells)
        cells += "".join(f" --seeds {seed}" for seed in self.seeds)
        part = "" if self.part is None else f" --part {shlex.quote(self.part)}"
        make = functools.partial(environments, self.impl)
        try:
            others, failed = sweeps.run(folder, jobs, make, on_failure=_tell_failure, stop=stop)
        except KeyboardInterrupt:
            resume = f"resume with: mqe sweep {self.file}{part} --folder {folder}{cells}"
            raise interrupts.Interrupted(resume) from None
        if others:
            skipped = ", ".join(job.cell.path.as_posix() for job in others)
            echo(f"mqe: skipped, in use by other processes: {skipped}")
        if stop():
            echo(f"mqe: time limit of {self.time_limit:g} min; the same command resumes")
        left = sweeps.plan(settings, folder, config_of, self.cells, self.seeds)
        files = reports.report(folder) if not jobs or len(left) < len(jobs) else []
        if files:
            echo(f"mqe: wrote {files[-1]} and {len(files) - 1} more files")
        if failed:
            kind = NonFiniteError if isinstance(failed[0][1], NonFiniteError) else InputError
            names = ", ".join(job.cell.path.as_posix() for job, _ in failed)
            raise kind(f"cells: {len(failed)} of {len(jobs)} trainings failed: {names}")
        return {"left": _estimate(sweeps.estimate(folder, left), left), "report": [str(file) for file in files]}


@record
class Report:
    """Write figures and tables of a sweep from its finished runs, with reference values."""

    folder: tyro.conf.Positional[Path]
    """Folder of the sweep, with its runs in runs/; the report goes into report/."""
    reference: Path | None = None
    """YAML file of reference values, such as the paper's in results/paper/reference.yaml."""
    json: Json = False

    def run(self) -> dict[str, Any]:
        """Writes the report of a sweep from its finished runs."""
        from mqe_jax.study import report as reports
        from mqe_jax.study.runs import load_reference

        reference = None if self.reference is None else load_reference(self.reference)
        files = reports.report(self.folder, reference)
        echo(f"mqe: wrote {files[-1]} and {len(files) - 1} more files")
        return {"report": [str(file) for file in files]}


@record
class Tournament(TaskOptions):
    """Play policies of a match against each other, and rate them: table, CSV and picture."""

    task: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="TASK")]
    """Id of a match, such as go1wrestling."""
    policies: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="NAME|RUN|FILE")]
    """Policies; scripted, idle and random play too. Ratings are relative to scripted, or idle without it."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FOLDER")] = Path("runs/tournament")
    """Folder of tournament.csv and tournament.png."""
    episodes: Candidates = 64
    """Episodes of each pair on each side."""
    deterministic: bool = False
    """Use mean actions of trained policies; otherwise they are sampled, as in training."""
    seed: Seed = 0
    json: Json = False

    def run(self) -> dict[str, Any]:
        """Plays all pairs; prints a table, or returns the object for `--json`."""
        import jax

        from mqe_jax.policies import load_policy, parameters_for
        from mqe_jax.runs.build import anchors, make_env
        from mqe_jax.selfplay.league import tournament

        for name in (tournament.CSV, tournament.PICTURE):
            check_output(self.output / name)
        params = joined(parameters_for(self.task, *self.policies), self.overrides())
        env, _ = make_env(self.task, self.impl, params, 1)
        if len(env.teams) < 2:
            fail("task", self.task, "a match: it has one team")
        names = list(dict.fromkeys([*self.policies, *anchors(env)]))
        _, matches = make_env(self.task, self.impl, params, len(names) * self.episodes)
        policies = {name: load_policy(name, matches.env, deterministic=self.deterministic) for name in names}
        results = tournament.round_robin(matches, policies, jax.random.PRNGKey(self.seed))
        ratings = tournament.rate(results, names.index(anchors(env)[0]))
        tournament.save(self.output, names, results, ratings)
        echo(f"mqe: wrote {self.output / tournament.CSV} and {tournament.PICTURE}")
        share = tournament.scores(results) / (2 * self.episodes)
        order = sorted(range(len(names)), key=lambda i: -ratings.value[i])
        if not self.json:
            print(f"{'policy':<32} rating (95% interval); points of 100 games against each, in the same order")
            for i in order:
                row = " ".join(f"{100 * share[i, j]:4.0f}" if i != j else "    " for j in order)
                low, value, high = (x[i] for x in (ratings.low, ratings.value, ratings.high))
                print(f"{line(names[i]):<32} {value:6.0f} ({low:.0f} to {high:.0f})  {row}")
        rows = [{"policy": names[i], **{k: float(x[i]) for k, x in ratings._asdict().items()}} for i in order]
        return {"task": self.task, "ratings": rows, "policies": names, "results": results.tolist()}


def _tell_failure(job: sweeps.Job, error: Exception) -> None:
    echo(f"mqe: {job.cell.path.as_posix()} failed: {one_line(error)}")


def _estimate(seconds: list[float], jobs: list[sweeps.Job]) -> dict[str, Any]:
    """Returns the remaining jobs of a sweep and their estimated times, one row per job, plus totals."""
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
