"""Publishes sweeps: curves and evaluations as two compressed tables, and the page with their
figure.

`python -m lab.publish SWEEP ...` adds the finished runs below each SWEEP to curves.csv.gz and
evaluations.csv.gz in results/paper, thinned. It then regenerates the figure and the table of
docs/results/paper.md, and the estimates in results/paper, from results/ alone; without a SWEEP only
this.

`python -m lab.publish --measurement NAME FILE` puts a JSON or CSV file into
results/measurements.json under NAME.
"""

import argparse
import csv
import dataclasses
import gzip
import io
import itertools
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lab import paper_page
from mqe_jax.core.errors import InputError, one_line
from mqe_jax.core.files import parsing, read_json, read_rows, write_atomically
from mqe_jax.study.estimates import absolute
from mqe_jax.study.runs import REWARD, Cell, Curve, Run, read_runs, table
from mqe_jax.train.logs import number

ROOT = Path(__file__).parents[1]
MEASUREMENTS = ROOT / "results" / "measurements.json"
CURVES = "curves.csv.gz"
EVALUATIONS = "evaluations.csv.gz"
IDENTITY = ("task", "algorithm", "variant", "seed")
ROWS = 50
DIGITS = 5
"""Rows of a published curve, and significant digits."""
COLUMNS = ("env_steps", REWARD, "success", "episode_length")
"""Columns of a published curve, beside the terms of the reward that are not zero."""
MODES = ("sampled", "deterministic")
EVALUATED = (REWARD, "success_rate")
"""Published numbers of evaluations during training; of the absolute metric all are."""

Key = tuple[Cell, int]


def thin(curve: Curve) -> Curve:
    """Returns a curve of at most `ROWS` rows: means over groups of consecutive rows of about equal
    size.

    `env_steps` are those at the end of a group; means ignore NaN.
    """
    count = len(curve["env_steps"])
    ends = np.unique(np.linspace(0, count, min(count, ROWS) + 1).round().astype(int))
    terms = sorted(
        name for name in curve if name.startswith("reward/") and np.nan_to_num(curve[name]).any()
    )
    thinned: Curve = {}
    for name in [*(name for name in COLUMNS if name in curve), *terms]:
        parts = [curve[name][a:b] for a, b in itertools.pairwise(ends)]
        finite = [part[np.isfinite(part)] for part in parts]
        thinned[name] = np.array([part.mean() if part.size else math.nan for part in finite])
    return {**thinned, "env_steps": curve["env_steps"][ends[1:] - 1]}


def read_tables(folder: Path) -> list[Run]:
    """Reads the published runs of a folder, by path and seed; InputError for a missing or damaged
    table.
    """
    with parsing(folder, "tables of runs"):
        return _read_tables(folder)


def _read_tables(folder: Path) -> list[Run]:
    evaluations: dict[Key, dict[str, list[dict[str, Any]]]] = {}
    for key, row in _read(folder / EVALUATIONS):
        point: dict[str, Any] = {
            name: int(row[name]) for name in ("env_steps", "episodes") if row[name]
        }
        for mode in MODES:
            columns = {
                name.removeprefix(f"{mode}/"): x for name, x in row.items() if name.startswith(mode)
            }
            point[mode] = {name: float(x) for name, x in columns.items() if x}
        evaluations.setdefault(key, {"training": [], "absolute": []})[row["kind"]].append(point)
    curves: dict[Key, list[dict[str, str]]] = {}
    for key, row in _read(folder / CURVES):
        curves.setdefault(key, []).append(row)
    runs = []
    for key, rows in curves.items():
        curve = {
            name: np.array([float(row[name]) for row in rows]) for name, x in rows[0].items() if x
        }
        own = evaluations.get(key, {"training": [], "absolute": []})
        runs.append(Run(*key, curve, own["training"], next(iter(own["absolute"]), None)))
    return sorted(runs, key=_order)


def _read(path: Path) -> Iterable[tuple[Key, dict[str, str]]]:
    with parsing(path, "a table of runs"):
        rows = csv.DictReader(io.StringIO(gzip.decompress(path.read_bytes()).decode()))
        if rows.fieldnames is None:
            raise ValueError("empty")
        for row in rows:
            task, algorithm, variant, seed = (row.pop(name) for name in IDENTITY)
            yield (Cell(task, algorithm, variant), int(seed)), row


def write_tables(folder: Path, runs: Sequence[Run]) -> None:
    """Writes both tables of a folder where their content changes; the same runs give the same
    bytes.
    """
    curves = []
    evaluations = []
    for run in runs:
        identity = {**dataclasses.asdict(run.cell), "seed": run.seed}
        curve = thin(run.curve)
        curves += [
            {**identity, **dict(zip(curve, row, strict=True))}
            for row in zip(*curve.values(), strict=True)
        ]
        for point in run.evaluations:
            evaluations.append({**identity, "kind": "training", **_numbers(point, EVALUATED)})
        if run.absolute is not None:
            evaluations.append({**identity, "kind": "absolute", **_numbers(run.absolute)})
    folder.mkdir(parents=True, exist_ok=True)
    for name, rows, first in (
        (CURVES, curves, COLUMNS),
        (EVALUATIONS, evaluations, ("kind", "env_steps", "episodes")),
    ):
        others = sorted({column for row in rows for column in row} - {*IDENTITY, *first})
        content = table(rows, [*IDENTITY, *first, *others], DIGITS).encode()
        path = folder / name
        if not path.is_file() or gzip.decompress(path.read_bytes()) != content:
            write_atomically(path, gzip.compress(content, mtime=0))


def _numbers(point: Mapping[str, Any], names: Sequence[str] | None = None) -> dict[str, Any]:
    """Returns the numbers of an evaluation as columns: env_steps, episodes, and MODE/NAME for
    `names` or all.
    """
    columns = {name: point[name] for name in ("env_steps", "episodes") if name in point}
    for mode in MODES:
        values = point.get(mode, {})
        columns |= {
            f"{mode}/{k}": x
            for k, x in values.items()
            if x is not None and (names is None or k in names)
        }
    return columns


def publish(sweeps: Sequence[Path], target: Path) -> None:
    """Adds finished runs to the tables below `target`; InputError for other results of a run that
    is published.
    """
    runs = (
        {(run.cell, run.seed): run for run in read_tables(target)}
        if (target / CURVES).is_file()
        else {}
    )
    for sweep in sweeps:
        for run in read_runs(sweep):
            key = run.cell, run.seed
            other = runs.setdefault(key, run)
            if number(absolute(other, REWARD), DIGITS) != number(absolute(run, REWARD), DIGITS):
                raise InputError(
                    f"{sweep}: {_name(run)} differs from the one that is published; remove one of "
                    "them"
                )
    if sweeps:
        write_tables(target, sorted(runs.values(), key=_order))


def _name(run: Run) -> str:
    return f"{run.cell.path.as_posix()}/seed{run.seed}"


def _order(run: Run) -> tuple[str, int]:
    return run.cell.path.as_posix(), run.seed


def add_measurement(name: str, file: Path, target: Path = MEASUREMENTS) -> None:
    """Puts the content of a JSON file, or the rows of a CSV file, into a JSON file under a name."""
    entries = read_json(target) if target.is_file() else {}
    with parsing(file, "a JSON list or mapping, or a CSV file"):
        if file.suffix == ".csv":
            head, *rows = read_rows(file)
            content: Any = [dict(zip(head, row, strict=True)) for row in rows if row]
        else:
            content = read_json(file)
        written = _entries({**entries, name: content})
    write_atomically(target, written.encode())


def _entries(entries: Mapping[str, Any]) -> str:
    parts = []
    for name, entry in sorted(entries.items()):
        lines = [json.dumps(item) for item in entry]
        if isinstance(entry, dict):
            lines = [f"{json.dumps(key)}: {json.dumps(item)}" for key, item in entry.items()]
        opening, closing = "{}" if isinstance(entry, dict) else "[]"
        parts.append(f" {json.dumps(name)}: {opening}\n  " + ",\n  ".join(lines) + f"\n {closing}")
    return "{\n" + ",\n".join(parts) + "\n}\n"


def main() -> int:
    """Publishes sweeps and regenerates the page; returns the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sweeps", nargs="*", type=Path, metavar="SWEEP")
    parser.add_argument("--target", type=Path, default=ROOT / "results" / "paper")
    parser.add_argument("--page", type=Path, default=ROOT / "docs" / "results" / "paper.md")
    parser.add_argument("--measurement", nargs=2, metavar=("NAME", "FILE"))
    arguments = parser.parse_args()
    try:
        if arguments.measurement:
            add_measurement(arguments.measurement[0], Path(arguments.measurement[1]))
            return 0
        publish(arguments.sweeps, arguments.target)
        paper_page.update(read_tables(arguments.target), arguments.target, arguments.page)
    except (InputError, OSError) as error:
        parser.exit(2, f"error: {one_line(error)}\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
