"""Raw data of a sweep: per run, a CSV file with its curve and a JSON file with its evaluations.

FOLDER/raw/TASK/ALGORITHM[+SETTING]/seed0.csv    the training curve: at most 50 rows and 9 columns; 5 digits of
                                                 the columns that figures show, 4 of others
FOLDER/raw/TASK/ALGORITHM[+SETTING]/seed0.json   identity, duration, main numbers of the evaluations during training as
                                                 columns, absolute metric

Files of earlier formats (100 rows, 6 digits, a column `seconds`, evaluations as a list with all numbers) are read as
well. The complete data are in the run folders.
"""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mqe_jax.errors import InputError
from mqe_jax.files import write_atomically
from mqe_jax.study.paper import GATE_TERMS, HIERARCHICAL

MAX_ROWS, MAX_COLUMNS, RAW_DIGITS, OTHER_DIGITS, DIGITS = 50, 9, 5, 4, 6
"""Limits of the raw data: rows, columns, significant digits, those of a curve's columns other than `SHOWN`; and
significant digits in the report's tables."""
REWARD = "average_step_reward"
SHOWN = (REWARD, *GATE_TERMS)
"""Columns of curves that figures and tables show."""
COLUMNS = ("env_steps", REWARD, "success", "episode_length")
"""Columns that every curve keeps; nonzero reward terms fill the rest, largest mean magnitude first."""
MODES = ("sampled", "deterministic")
"""Actions of an evaluation: sampled from the policy, or its mean."""
EVALUATED = (REWARD, "success_rate")
"""Numbers that are kept of each evaluation during training, for both modes."""

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

    `evaluation` holds `evaluations`, a list of {env_steps, sampled, deterministic}, and `absolute`, one such entry
    with its number of episodes, or None; `sampled` and `deterministic` map names such as average_step_reward and
    success_rate to numbers or None. `seconds` is the wall-clock duration of the training (s), None if unknown.
    """

    cell: Cell
    seed: int
    curve: Curve
    evaluation: Mapping[str, Any]
    seconds: float | None = None


def thin(curve: Curve) -> Curve:
    """Returns a curve of at most `MAX_ROWS` rows: means over groups of consecutive rows of about equal size.

    `env_steps` are those at the end of a group; means ignore NaN.
    """
    steps = len(curve["env_steps"])
    ends = np.unique(np.linspace(0, steps, min(steps, MAX_ROWS) + 1).round().astype(int))
    size = {name: _magnitude(curve[name]) for name in curve if name.startswith("reward/")}
    terms = sorted((name for name in size if size[name] > 0.0), key=lambda name: (-size[name], name))
    names = [*(name for name in COLUMNS if name in curve), *terms][:MAX_COLUMNS]
    thinned: Curve = {}
    for name in names:
        parts = [curve[name][a:b] for a, b in itertools.pairwise(ends)]
        thinned[name] = np.array([part[-1] if name == "env_steps" else _mean(part) for part in parts])
    return thinned


def _magnitude(values: NDArray[np.float64]) -> float:
    return _mean(np.abs(values)) if np.isfinite(values).any() else 0.0


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
    if not {"env_steps", REWARD} <= set(curve) or not rows:
        raise InputError(f"{path}: has no rows with columns env_steps and average_step_reward")
    return curve


def duration(curve: Curve) -> float | None:
    """Returns the wall-clock time at the end of a curve, s; None without a column `seconds`."""
    return float(curve["seconds"][-1]) if "seconds" in curve else None


def number(value: float, digits: int = DIGITS) -> str:
    """Returns a number with `digits` significant digits; integers, such as steps, in full."""
    value = float(value)
    whole = math.isfinite(value) and value.is_integer() and abs(value) < 1e15
    return str(int(value)) if whole else f"{value:.{digits}g}"


def table(columns: Mapping[str, Any], digits: int = DIGITS) -> str:
    """Returns columns of equal length as CSV text; numbers as `number` writes them."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in zip(*columns.values(), strict=True):
        writer.writerow([item if isinstance(item, str) else number(item, digits) for item in row])
    return text.getvalue()


def write_record(folder: Path, record: Record) -> None:
    """Writes a run's CSV and, last, its JSON below FOLDER/raw; a run is complete once its JSON exists."""
    cell = record.cell
    path = folder / "raw" / cell.path / f"seed{record.seed}"
    path.parent.mkdir(parents=True, exist_ok=True)
    identity = {"task": cell.task, "algorithm": cell.algorithm, "setting": cell.setting, "seed": record.seed}
    time = {} if record.seconds is None else {"seconds": record.seconds}
    columns = {
        name: [number(x, RAW_DIGITS if name in SHOWN else OTHER_DIGITS) for x in values]
        for name, values in thin(record.curve).items()
    }
    write_atomically(path.with_suffix(".csv"), table(columns).encode())
    evaluation = {"evaluations": _columns(record.evaluation["evaluations"]), "absolute": record.evaluation["absolute"]}
    text = json.dumps(_rounded({**identity, **time, **evaluation}), separators=(",", ":")) + "\n"
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
            evaluation = {"evaluations": _points(values.get("evaluations", [])), "absolute": values.get("absolute")}
            curve = read_curve(path.with_suffix(".csv"))
            seconds = values.get("seconds", duration(curve))
            records.append(Record(cell, int(values["seed"]), curve, evaluation, seconds))
        except (OSError, UnicodeDecodeError, KeyError, TypeError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"{path}: is not the record of a run ({error!r})") from None
    return sorted(records, key=lambda record: (record.cell.path.as_posix(), record.seed))


def _columns(points: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Returns the numbers of evaluations that are kept as columns: env_steps and MODE/NAME."""
    columns = {"env_steps": [point["env_steps"] for point in points]}
    for mode, name in itertools.product(MODES, EVALUATED):
        values = [point.get(mode, {}).get(name) for point in points]
        if any(value is not None for value in values):
            columns[f"{mode}/{name}"] = values
    return columns


def _points(evaluations: Any) -> list[dict[str, Any]]:
    """Returns evaluations as a list, from columns or from the earlier format."""
    if isinstance(evaluations, list):
        return evaluations
    points: list[dict[str, Any]] = [
        {"env_steps": steps, **{mode: {} for mode in MODES}} for steps in evaluations["env_steps"]
    ]
    for column, values in evaluations.items():
        mode, slash, name = column.partition("/")
        if slash:
            for point, value in zip(points, values, strict=True):
                point[mode][name] = value
    return points


def _short(value: float) -> float | int:
    value = float(f"{value:.{RAW_DIGITS}g}")
    return int(value) if value.is_integer() else value


def _rounded(value: Any) -> Any:
    """Returns JSON values with floats of at most `RAW_DIGITS` significant digits; non-finite ones become null."""
    if isinstance(value, float):
        return _short(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _rounded(item) for key, item in value.items()}
    return [_rounded(item) for item in value] if isinstance(value, list | tuple) else value
