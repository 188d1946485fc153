"""Finished runs of a sweep, from FOLDER/runs/TASK/ALGORITHM[+VARIANT]/seed*; tables as CSV."""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mqe_jax.core.errors import InputError
from mqe_jax.core.literal import line
from mqe_jax.train.checkpoint import read_file
from mqe_jax.train.folder import CONFIG_FILE, CSV_FILE, load_run_config
from mqe_jax.train.logs import number, read_metrics
from mqe_jax.train.monitor import read_evaluations
from mqe_jax.train.policy import POLICY_FILE

REWARD = "average_step_reward"
PLAIN = "plain"
"""Name of the variant of a sweep without variants."""
DIGITS = 6
"""Significant digits in tables."""

Curve = dict[str, NDArray[np.float64]]


@dataclass(frozen=True)
class Cell:
    """One task, algorithm and variant of a sweep.

    Runs of different seeds belong to the same cell.
    """

    task: str
    algorithm: str
    variant: str = PLAIN

    @property
    def path(self) -> Path:
        """The cell's folder below `runs/`."""
        suffix = "" if self.variant == PLAIN else f"+{self.variant}"
        return Path(self.task) / f"{self.algorithm}{suffix}"

    @classmethod
    def at(cls, path: Path) -> "Cell":
        """Returns the cell of a folder, given its last two parts at least."""
        algorithm, _, variant = path.name.partition("+")
        return cls(path.parent.name, algorithm, variant or PLAIN)


@dataclass(frozen=True)
class Run:
    """One finished run: its cell and seed, its training curve by column, and its evaluations."""

    cell: Cell
    seed: int
    curve: Curve  # columns of metrics.csv, (updates,) each
    evaluations: list[dict[str, Any]]
    """Evaluations during training: {env_steps, sampled, deterministic}; `sampled` and
    `deterministic` map names such as average_step_reward and success_rate to numbers or None."""
    absolute: dict[str, Any] | None
    """The absolute metric, an evaluation of the best checkpoint; None without evaluations."""


def is_finished(run_dir: Path) -> bool:
    """Returns whether a run has its last policy and, if it is evaluated, its absolute metric."""
    if not (run_dir / CONFIG_FILE).is_file() or not (run_dir / POLICY_FILE).is_file():
        return False
    config = load_run_config(run_dir)
    total = config.num_updates * config.steps_per_update
    if read_file(run_dir / POLICY_FILE, kind="policy").metadata.get("env_steps") != total:
        return False
    if config.evaluation.every is None:
        return True
    evaluations = read_evaluations(run_dir)
    return evaluations["absolute"] is not None and evaluations.get("ended_at") == total


def read_runs(folder: Path) -> list[Run]:
    """Reads the finished runs of a sweep's folder, ordered by path and seed.

    InputError if there are none.
    """
    runs = []
    for path in sorted(folder.glob(f"runs/*/*/seed*/{CONFIG_FILE}")):
        if path.parent.name.removeprefix("seed").isdecimal() and is_finished(path.parent):
            seed = int(path.parent.name.removeprefix("seed"))
            evaluations = read_evaluations(path.parent)
            curve = read_curve(path.parent / CSV_FILE)
            config = load_run_config(path.parent)
            if curve["env_steps"][-1] != (total := config.num_updates * config.steps_per_update):
                ends = number(float(curve["env_steps"][-1]))
                raise InputError(
                    f"{path.parent / CSV_FILE}: ends after {ends} steps; the finished run has "
                    f"{total}"
                )
            cell = Cell.at(path.parent.parent)
            runs.append(Run(cell, seed, curve, evaluations["evaluations"], evaluations["absolute"]))
    if not runs:
        raise InputError(
            f"{folder}: has no finished run runs/TASK/ALGORITHM/seed*; it must be a sweep's folder"
        )
    return sorted(runs, key=lambda run: (run.cell.path.as_posix(), run.seed))


def read_curve(path: str | Path) -> Curve:
    """Reads the columns of a metrics.csv.

    InputError, naming the file, if it is missing, malformed or has no row.
    """
    curve = read_metrics(path)
    if not {"env_steps", REWARD} <= set(curve) or not len(curve["env_steps"]):
        raise InputError(f"{path}: has no rows with columns env_steps and {REWARD}")
    if not np.all(np.diff(curve["env_steps"], prepend=0.0) > 0):
        raise InputError(f"{path}: its env_steps must be positive and increase from row to row")
    return curve


def table(
    rows: Sequence[Mapping[str, Any]], names: Sequence[str] = (), digits: int = DIGITS
) -> str:
    """Returns rows as CSV text.

    The columns are `names`, or those of the first row. Numbers are as `number` writes them.
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, list(names or rows[0]), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow(
            {name: line(x) if isinstance(x, str) else number(x, digits) for name, x in row.items()}
        )
    return text.getvalue()
