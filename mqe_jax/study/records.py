"""Raw data of a sweep: per run, a CSV file with its curve and a JSON file with its evaluations.

FOLDER/raw/TASK/ALGORITHM[+SETTING]/seed0.csv    at most 100 rows, 10 columns, 6 digits
FOLDER/raw/TASK/ALGORITHM[+SETTING]/seed0.json   identity, evaluations during training, absolute metric
"""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mqe_jax.errors import InputError
from mqe_jax.files import write_atomically
from mqe_jax.study.paper import HIERARCHICAL

MAX_ROWS, MAX_COLUMNS, DIGITS = 100, 10, 6
COLUMNS = ("env_steps", "seconds", "average_step_reward", "success", "episode_length")
"""Columns that every curve keeps; reward terms fill the rest, largest mean magnitude first."""

Curve = dict[str, NDArray[np.float64]]


@dataclass(frozen=True)
class Cell:
    """One task, algorithm and variant (`setting`) of a sweep; runs of different seeds belong to the same cell."""

    task: str
    algorithm: str
    setting: str = HIERARCHICAL

    @property
    def path(self) -> Path:
        """The cell's folder below `raw/` and `runs/`."""
        suffix = "" if self.setting == HIERARCHICAL else f"+{self.setting}"
        return Path(self.task) / f"{self.algorithm}{suffix}"


@dataclass(frozen=True)
class Record:
    """One run: its cell and seed, its thinned curve by column, and its evaluation results.

    `evaluation` holds `evaluations`, a list of {env_steps, episodes, sampled, deterministic}, and `absolute`, one such
    entry or None; `sampled` and `deterministic` map names such as average_step_reward and success_rate to numbers.
    """

    cell: Cell
    seed: int
    curve: Curve
    evaluation: Mapping[str, Any]


def thin(curve: Curve) -> Curve:
    """Returns a curve of at most `MAX_ROWS` rows: means over groups of consecutive rows of about equal size.

    `env_steps` and `seconds` are those at the end of a group; means ignore NaN.
    """
    steps = len(curve["env_steps"])
    ends = np.unique(np.linspace(0, steps, min(steps, MAX_ROWS) + 1).round().astype(int))
    terms = sorted(
        (name for name in curve if name.startswith("reward/")),
        key=lambda name: (-float(np.nanmean(np.abs(curve[name]))) if np.isfinite(curve[name]).any() else 0.0, name),
    )
    names = [*(name for name in COLUMNS if name in curve), *terms][:MAX_COLUMNS]
    thinned: Curve = {}
    for name in names:
        parts = [curve[name][a:b] for a, b in itertools.pairwise(ends)]
        at_end = name in ("env_steps", "seconds")
        thinned[name] = np.array([part[-1] if at_end else _mean(part) for part in parts])
    return thinned


def _mean(values: NDArray[np.float64]) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else math.nan


def read_curve(path: Path) -> Curve:
    """Reads the columns of a metrics.csv or of a thinned curve.

    Raises:
        InputError: naming the file, if it is missing or malformed.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            reader = csv.DictReader(file)
            rows = list(reader)
            curve = {name: np.array([float(row[name]) for row in rows]) for name in reader.fieldnames or []}
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, TypeError, ValueError):
        raise InputError(f"{path}: is not a metrics.csv or a thinned curve") from None
    if not {"env_steps", "average_step_reward"} <= set(curve) or not rows:
        raise InputError(f"{path}: has no rows with columns env_steps and average_step_reward")
    return curve


def number(value: float) -> str:
    """Returns a number with `DIGITS` significant digits; integers, such as steps, in full."""
    value = float(value)
    whole = math.isfinite(value) and value.is_integer() and abs(value) < 1e15
    return str(int(value)) if whole else f"{value:.{DIGITS}g}"


def table(columns: Mapping[str, Any]) -> str:
    """Returns columns of equal length as CSV text; numbers as `number` writes them."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in zip(*columns.values(), strict=True):
        writer.writerow([item if isinstance(item, str) else number(item) for item in row])
    return text.getvalue()


def write_record(folder: Path, record: Record) -> None:
    """Writes a run's CSV and, last, its JSON below FOLDER/raw; a run is complete once its JSON exists."""
    cell = record.cell
    path = folder / "raw" / cell.path / f"seed{record.seed}"
    path.parent.mkdir(parents=True, exist_ok=True)
    identity = {"task": cell.task, "algorithm": cell.algorithm, "setting": cell.setting, "seed": record.seed}
    write_atomically(path.with_suffix(".csv"), table(thin(record.curve)).encode())
    text = json.dumps(_rounded({**identity, **record.evaluation}), separators=(",", ":")) + "\n"
    write_atomically(path.with_suffix(".json"), text.encode())


def read_records(folder: Path) -> list[Record]:
    """Reads every run below FOLDER/raw, ordered by path and seed.

    Raises:
        InputError: if there is none, or a run's file is missing or damaged.
    """
    paths = sorted((folder / "raw").glob("*/*/seed*.json"))
    if not paths:
        raise InputError(f"{folder}: holds no raw/TASK/ALGORITHM/seed*.json; it must be a sweep folder")
    records = []
    for path in paths:
        try:
            values = json.loads(path.read_text(encoding="utf-8"))
            cell = Cell(values["task"], values["algorithm"], values["setting"])
            evaluation = {"evaluations": values.get("evaluations", []), "absolute": values.get("absolute")}
            records.append(Record(cell, int(values["seed"]), read_curve(path.with_suffix(".csv")), evaluation))
        except (OSError, UnicodeDecodeError, KeyError, TypeError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"{path}: is not the record of a run ({error!r})") from None
    return sorted(records, key=lambda record: (record.cell.path.as_posix(), record.seed))


def _rounded(value: Any) -> Any:
    """Returns JSON values with floats of at most `DIGITS` significant digits; non-finite ones become null."""
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _rounded(item) for key, item in value.items()}
    return [_rounded(item) for item in value] if isinstance(value, list | tuple) else value
