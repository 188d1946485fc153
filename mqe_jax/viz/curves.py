"""Plots of learning curves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from mqe_jax.files import replacing
from mqe_jax.study.runs import REWARD, read_curve

_INK, _RUN, _SECOND = "#23252b", "#2f7fd6", "#3fae49"


def smooth(values: ArrayLike, fraction: float = 0.02) -> list[float]:
    """Returns the running mean over a window of `fraction` of the rows; non-finite values are skipped."""
    values = np.asarray(values, np.float64)
    width = max(1, round(len(values) * fraction))
    windows = [values[max(0, end - width) : end] for end in range(1, len(values) + 1)]
    windows = [window[np.isfinite(window)] for window in windows]
    return [float(window.mean()) if window.size else math.nan for window in windows]


def draw_curve(runs: Sequence[Path], path: Path, task: str, title: str | None = None) -> None:
    """Plots average step reward (and success) of runs over environment steps, and writes the image atomically."""
    from matplotlib.figure import Figure

    tables = [read_curve(run / "metrics.csv") for run in runs]
    figure = Figure((7.2, 4.2), dpi=150, layout="constrained")
    axes = figure.add_subplot()
    for table in tables:
        steps, reward = table["env_steps"] / 1e6, table[REWARD]
        axes.plot(steps, reward, color=_RUN, lw=0.6, alpha=0.3)
        axes.plot(steps, smooth(reward), color=_RUN, lw=1.8, label="mqe_jax" if table is tables[0] else None)
    last = max(table["env_steps"][-1] for table in tables) / 1e6
    axes.set(xlabel="environment steps (millions)", ylabel="average step reward", xlim=(0, last))
    axes.set_title(title or task, color=_INK, loc="left")
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    if any(math.isfinite(v) for t in tables for v in t.get("success", [])):
        right = axes.twinx()
        for table in tables:
            rate = [100 * v for v in smooth(table["success"])]
            right.plot(table["env_steps"] / 1e6, rate, color=_SECOND, lw=1.4, alpha=0.9)
        right.set(ylim=(0, 100))
        right.set_ylabel("success rate (%)", color=_SECOND)
        right.spines[["top", "left"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8, loc="best")
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        figure.savefig(temporary)
