"""The commands `sweep`, `report` and `tournament`."""

from dataclasses import field
from pathlib import Path
from typing import Annotated, Any

import tyro

from mqe_jax.cli.options import Impl, Json, Repeated, Seed, TaskOptions
from mqe_jax.core import interrupts
from mqe_jax.core.files import check_output
from mqe_jax.core.limits import Candidates, Positive
from mqe_jax.core.literal import echo
from mqe_jax.core.settings import settings_class


@settings_class
class SweepCommand:
    """Train all combinations of tasks, algorithms, variants and seeds, and report; resumes."""

    file: tyro.conf.Positional[Path]
    """YAML file: tasks, algorithms, seeds, config, settings, variants (see docs/sweeps.md)."""
    json: Json = False
    part: str | None = None
    """Name of one sweep in a file that maps names to sweeps."""
    folder: Path | None = None
    """Folder of the sweep. Default: runs/PART, or runs/NAME of the file."""
    cells: Annotated[list[str], Repeated, tyro.conf.arg(metavar="CELL")] = field(
        default_factory=list
    )
    """Train only these cells: TASK/ALGORITHM, in a sweep with variants TASK/ALGORITHM+VARIANT. May
    be a pattern such as '*/mat'; may be repeated."""
    seeds: Annotated[list[int], Repeated, tyro.conf.arg(metavar="SEED")] = field(
        default_factory=list
    )
    """Train only these seeds; may be repeated."""
    time_limit: Annotated[Positive | None, tyro.conf.arg(metavar="MINUTES")] = None
    """Save the run in training after this time, min, and end; the same command resumes it."""
    dry_run: bool = False
    """Print the remaining training runs and their estimated time, without training."""
    impl: Impl = "auto"

    def run(self) -> dict[str, Any]:
        """Trains the remaining runs and writes the report, or prints their estimated time."""
        from mqe_jax.runs.sweeping import sweep

        folder = self.folder or Path("runs") / (self.part or self.file.stem)
        names = ("part", "cells", "seeds", "time_limit", "impl", "dry_run")
        try:
            result = sweep(self.file, folder, **{name: getattr(self, name) for name in names})
        except KeyboardInterrupt:
            raise interrupts.Interrupted("the same command resumes from here") from None
        if self.dry_run and not self.json:
            _print(result["left"])
        return result["left"] if self.dry_run else result


@settings_class
class Report:
    """Write figures and tables of a sweep from its finished runs."""

    folder: tyro.conf.Positional[Path]
    """Folder of the sweep, with its runs in runs/; the report goes into report/."""
    json: Json = False

    def run(self) -> dict[str, Any]:
        """Writes the report of a sweep from its finished runs."""
        from mqe_jax.study import report as reports

        files = reports.report(self.folder)
        echo(f"mqe: wrote {files[-1]} and {len(files) - 1} more files")
        return {"report": [str(file) for file in files]}


@settings_class
class Tournament(TaskOptions):
    """Play policies against each other, or as mates in a cooperative task, and rate them.

    Writes tables, CSV and a picture.
    """

    task: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="TASK")]
    """Id of a task, such as go1wrestling or go1gate."""
    policies: Annotated[
        tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="NAME|RUN|FILE")
    ]
    """Policies. Scripted, idle and (in a match) random play too. Ratings are relative to scripted,
    or idle without it."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FOLDER")] = None
    """Folder of tournament.csv, tournament.png and, of a match, policies.csv. Default:
    runs/tournament/TASK."""
    episodes: Candidates = 64
    """Episodes of each pair on each side, or of each mixed team."""
    deterministic: bool = False
    """Use mean actions of trained policies; otherwise they are sampled, as in training."""
    seed: Seed = 0
    json: Json = False

    def run(self) -> dict[str, Any]:
        """Plays all pairs; prints a table, or returns the object for `--json`."""
        from mqe_jax.runs.playing import tournament
        from mqe_jax.selfplay.league.tournament import CSV, PICTURE, POLICIES

        folder = self.output or Path("runs") / "tournament" / self.task
        for name in (CSV, POLICIES, PICTURE):
            check_output(folder / name)
        options = {
            name: getattr(self, name) for name in ("impl", "episodes", "deterministic", "seed")
        }
        played = tournament(self.task, self.policies, env=self.overrides(), **options)
        played.save(folder)
        echo(f"mqe: wrote the tables and {folder / PICTURE}")
        if not self.json:
            print(played)
        return played.to_dict()


def _print(result: dict[str, Any]) -> None:
    total = {"task": "all", "steps_left": result["steps_left"], "seconds": result["seconds"]}
    for row in [*result["jobs"], total]:
        name = " ".join(str(row[key]) for key in ("task", "algorithm", "variant") if key in row)
        seeds = f"seeds {' '.join(map(str, row['seeds']))}" if "seeds" in row else ""
        time = "time unknown" if row["seconds"] is None else f"{row['seconds'] / 3600:.2f} h"
        print(f"{name:<45} {seeds:<20} {row['steps_left'] / 1e6:>9.3g} M steps  {time}")
