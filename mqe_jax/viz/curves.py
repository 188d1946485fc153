"""Plots of learning curves."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

from mqe_jax.errors import InputError
from mqe_jax.files import replacing

_INK, _RUN, _SECOND = "#23252b", "#2f7fd6", "#3fae49"


def read_metrics(path: Path) -> dict[str, list[float]]:
    """Returns the columns of a metrics.csv; InputError if it is missing or not one."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            reader = csv.DictReader(file)
            columns: dict[str, list[float]] = {name: [] for name in reader.fieldnames or []}
            for row in reader:
                for name in columns:
                    columns[name].append(float(row[name]))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; a run folder has one after its first update") from None
    except (TypeError, ValueError, UnicodeDecodeError):
        raise InputError(f"{path}: is not a metrics.csv") from None
    if "env_steps" not in columns:
        raise InputError(f"{path}: has no column env_steps")
    return columns


def smooth(values: Sequence[float], fraction: float = 0.02) -> list[float]:
    """Returns the running mean over a window of `fraction` of the rows; non-finite values are skipped."""
    width = max(1, round(len(values) * fraction))
    means = []
    for end in range(1, len(values) + 1):
        window = [v for v in values[max(0, end - width) : end] if math.isfinite(v)]
        means.append(sum(window) / len(window) if window else math.nan)
    return means


def draw_curve(runs: Sequence[Path], path: Path, task: str, title: str | None = None) -> None:
    """Plots average step reward (and success) of runs over environment steps, and writes the image atomically."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    tables = [read_metrics(run / "metrics.csv") for run in runs]
    figure = Figure((7.2, 4.2), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for table in tables:
        steps = [s / 1e6 for s in table["env_steps"]]
        reward = table.get("average_step_reward", [math.nan] * len(steps))
        axes.plot(steps, reward, color=_RUN, lw=0.6, alpha=0.3)
        axes.plot(steps, smooth(reward), color=_RUN, lw=1.8, label="mqe_jax" if table is tables[0] else None)
    last = max((t["env_steps"][-1] for t in tables if t["env_steps"]), default=0.0) / 1e6
    axes.set(xlabel="environment steps (millions)", ylabel="average step reward", xlim=(0, max(last, 1e-6)))
    axes.set_title(title or task, color=_INK, loc="left")
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    if any(math.isfinite(v) for t in tables for v in t.get("success", [])):
        right = axes.twinx()
        for table in tables:
            rate = [100 * v for v in smooth(table["success"])]
            right.plot([s / 1e6 for s in table["env_steps"]], rate, color=_SECOND, lw=1.4, alpha=0.9)
        right.set(ylim=(0, 100))
        right.set_ylabel("success rate (%)", color=_SECOND)
        right.spines[["top", "left"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8, loc="best")
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        figure.savefig(temporary)
