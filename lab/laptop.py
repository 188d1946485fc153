"""Trains every task on two CPU cores, measures the teams and fills tables of the documentation.

`python -m lab.laptop` takes about nine hours of two cores; the same command resumes. It trains
lab/laptop.yaml, one seed of all tasks after the other, and evaluates 256 episodes of each team
without assistance, in matches against the scripted team on both sides. After each seed it writes
results/laptop.csv, the table of docs/first_hour.md, and the file that `mqe tasks --long` shows.
`python -m lab.laptop --config student` does the same with lab/student.yaml, results/student.csv and
the table of docs/sensors.md, in about an hour. `--table` only writes tables and file from the
results.
"""

import argparse
import csv
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lab.measure import Measurement, measure, plan
from lab.paper_page import filled
from mqe_jax.acting.results import Rate
from mqe_jax.core.errors import InputError, NonFiniteError, one_line
from mqe_jax.core.files import parsing, write_atomically
from mqe_jax.core.literal import echo
from mqe_jax.envs.registry import SHIPPED
from mqe_jax.runs.sweeping import sweep
from mqe_jax.study.runs import is_finished, read_curve, table
from mqe_jax.study.sweep import load_sweep
from mqe_jax.train.logs import CSV_FILE

ROOT = Path(__file__).parents[1]
CONFIGS = ("laptop", "student")
"""Settings that are measured: sweeps are lab/CONFIG.yaml, results RESULTS/CONFIG.csv."""
RESULTS = ROOT / "results"
LEVELS = ROOT / "mqe_jax" / "envs" / "levels.json"
PAGES = {"levels": ROOT / "docs" / "first_hour.md", "students": ROOT / "docs" / "sensors.md"}
"""Pages by the section that has the table."""
CORES = 2
"""Cores of the laptop: a training takes its processor minutes divided by them."""
OTHER = "other machine"
"""In the source of a training whose cores were about half as fast."""
EPISODES = 256

Row = Mapping[str, Any]


def train(
    file: Path, folder: Path, seed: int, tasks: Sequence[str], impl: str = "auto"
) -> list[Row]:
    """Trains tasks of a sweep with a seed, measures what is finished; returns a row of each.

    What is trained or measured already is not done again. A training that fails is reported.
    InputError for a folder whose runs come from other settings.
    """
    options: dict[str, Any] = {"cells": [f"{task}/*" for task in tasks], "seeds": [seed]}
    sweep(file, folder, **options, impl=impl, dry_run=True)  # checks all trainings
    try:
        sweep(file, folder, **options, impl=impl)
    except (InputError, NonFiniteError) as error:
        echo(f"lab: {one_line(error)}")
    runs = {task: folder / "runs" / task / "default" / f"seed{seed}" for task in tasks}
    runs = {task: run for task, run in runs.items() if is_finished(run)}
    if not runs:
        return []
    against = {"opponent": "scripted", "sides": "both"}
    part = Measurement(
        measure="evaluate",
        tasks=tuple(runs),
        arguments={"episodes": EPISODES},
        by_task={
            task: {"policy": str(run)} | (against if len(SHIPPED[task].teams) > 1 else {})
            for task, run in runs.items()
        },
        variants={f"seed{seed}": {}},
    )
    measure(part, folder, impl)
    found = {item.task: item.result() for item in plan(part, folder, impl)}
    return [_row(task, seed, runs[task], result) for task, result in found.items() if result]


def _row(task: str, seed: int, run: Path, result: Mapping[str, Any]) -> Row:
    curve = read_curve(run / CSV_FILE)
    name = "win_rate" if "win_rate" in result else "success_rate"
    low, high = result["intervals"][name]
    return {
        "task": task,
        "seed": seed,
        "env_steps": curve["env_steps"][-1],
        "processor_minutes": curve["processor_seconds"].sum() / 60,
        "episodes": result["episodes"],
        "rate": result[name],
        "low": low,
        "high": high,
        "source": "lab.laptop",
    }


def read(path: Path) -> list[dict[str, Any]]:
    """Reads a table of trainings; numbers that are missing are NaN."""
    with path.open(encoding="utf-8", newline="") as file, parsing(path, "a table of trainings"):
        return [
            {
                name: text if name in ("task", "source") else float(text or "nan")
                for name, text in row.items()
            }
            for row in csv.DictReader(file)
        ]


def keep(file: Path, rows: Sequence[Row]) -> None:
    """Writes rows into a table of trainings, in place of those of the same tasks and seeds."""
    every = {(row["task"], int(row["seed"])): row for row in [*read(file), *rows]}
    order = list(SHIPPED)
    ordered = sorted(every.items(), key=lambda item: (order.index(item[0][0]), item[0][1]))
    write_atomically(file, table([row for _, row in ordered]).encode())


def levels() -> dict[str, dict[str, Any]]:
    """Returns minutes and level of each task by device, `laptop` and `gpu`.

    Minutes are the mean of the trainings whose time is known, of a slower machine's only if there
    are no others. `level` is the mean rate, `worst` and `best` are those of single trainings. A
    device on which no time is known is left out.
    """
    times = {
        "laptop": (read(RESULTS / "laptop.csv"), "processor_minutes", CORES),
        "gpu": (read(RESULTS / "trainings.csv"), "gpu_minutes", 1),
    }
    found: dict[str, dict[str, Any]] = {}
    for task in SHIPPED:
        for device, (rows, column, share) in times.items():
            own = [row for row in rows if row["task"] == task]
            quiet = [row for row in own if OTHER not in row["source"]] or own
            known = [row[column] / share for row in quiet if math.isfinite(row[column])]
            if not known:
                continue
            rates = [row["rate"] for row in own]
            found.setdefault(task, {})[device] = {
                "minutes": round(float(np.mean(known)), 1),
                "level": round(float(np.mean(rates)), 4),
                "worst": min(rates),
                "best": max(rates),
                "trainings": len(rates),
            }
    return found


def markdown(found: Mapping[str, Mapping[str, Any]]) -> str:
    """Returns the table of the tasks with a level on a laptop; minutes of a slower machine end
    with *.
    """
    rows = read(RESULTS / "laptop.csv")
    known = {row["task"] for row in rows if OTHER not in row["source"]}
    lines = ["| task | minutes | mean, % | worst, % |", "|---|---|---|---|"]
    for task, devices in found.items():
        if "laptop" not in devices:
            continue
        minutes, *levels = _cells(devices["laptop"])
        cells = [f"`{task}`", minutes if task in known else f"{minutes}*", *levels]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _cells(one: Mapping[str, Any]) -> list[str]:
    mean, worst = (f"{100 * one[name]:.1f}".replace("100.0", "100") for name in ("level", "worst"))
    return [f"{one['minutes']:g}", mean, f"{worst} of {one['trainings']}"]


def students() -> str:
    """Returns the table of students."""
    every = read(RESULTS / "student.csv")
    lines = ["| task | minutes | student, % |", "|---|---|---|"]
    for task in dict.fromkeys(row["task"] for row in every):
        rows = [row for row in every if row["task"] == task]
        minutes = np.mean([row["processor_minutes"] for row in rows]) / CORES
        rate = Rate.of(float(np.mean([row["rate"] for row in rows])), EPISODES * len(rows))
        lines.append(f"| `{task}` | {minutes:.1f} | {rate.percent} |")
    return "\n".join(lines)


def tables() -> dict[str, str]:
    """Returns the tables by the section of their page."""
    return {"levels": markdown(levels()), "students": students()}


def update() -> None:
    """Writes the tables of `PAGES` and the file of `mqe tasks --long`."""
    write_atomically(LEVELS, (json.dumps(levels(), indent=1) + "\n").encode())
    for section, content in tables().items():
        text = filled(PAGES[section].read_text("utf-8"), {section: content})
        write_atomically(PAGES[section], text.encode())


def main() -> None:
    """Trains, measures and tabulates what the command line names."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--config", default="laptop", choices=CONFIGS)
    parser.add_argument("--folder", type=Path, help="default: runs/CONFIG")
    parser.add_argument("--tasks", nargs="+", help="default: all of the sweep")
    parser.add_argument("--seeds", nargs="+", type=int, help="default: all of the sweep")
    parser.add_argument("--impl", default="auto", help="physics engine")
    parser.add_argument("--table", action="store_true", help="only write the tables")
    given = parser.parse_args()
    file = ROOT / "lab" / f"{given.config}.yaml"
    settings = load_sweep(file)
    folder = given.folder or Path("runs") / given.config
    for seed in [] if given.table else given.seeds or settings.seeds:
        rows = train(file, folder, seed, given.tasks or settings.tasks, given.impl)
        keep(RESULTS / f"{given.config}.csv", rows)
        update()
    update()


if __name__ == "__main__":
    try:
        main()
    except (InputError, OSError) as error:
        raise SystemExit(f"error: {one_line(error)}") from None
