"""Logs of robots, as `mqe_jax.export.runner` writes them: what was asked of a robot, and sent."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mqe_jax.core.files import parsing, read_rows
from mqe_jax.export.runner import COLUMNS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_UNITS = {"vx": "m/s", "vy": "m/s", "yaw_rate": "rad/s"}

Log = dict[str, np.ndarray]


def load_log(file: Path) -> Log:
    """Returns the columns (T,) of a log by name; InputError for another file."""
    with parsing(file, "the log of a robot"):
        names, *rows = read_rows(file)
        columns = np.array(rows, float).T
        if tuple(names) != COLUMNS or len(rows) < 2 or not np.isfinite(columns).all():
            raise ValueError(f"expected two or more rows of numbers: {', '.join(COLUMNS)}")
        return dict(zip(COLUMNS, columns, strict=True))


def summarize(log: Log) -> dict[str, Any]:
    """Returns length, rate, the share of time in which the robot stood, and the largest speeds.

    Readings are late if they arrived more than two periods before.
    """
    seconds = float(np.ptp(log["time"]))
    period = seconds / (len(log["time"]) - 1)
    moving = log["moving"] > 0.5
    found: dict[str, Any] = {
        "seconds": seconds,
        "rate_hz": 1.0 / max(period, 1e-9),
        "longest_period_s": float(np.diff(log["time"]).max()),
        "stood_share": float(1.0 - moving.mean()),
        "stops": int(np.count_nonzero(np.diff(moving.astype(int)) < 0)),
        "late_readings_share": float(np.mean(log["age"] > 2.0 * period)),
    }
    return found | {f"largest_{name}": float(np.abs(log[name]).max()) for name in _UNITS}


def plot(log: Log) -> "Figure":
    """Returns a figure of the velocities asked and sent over time; the robot stands where grey."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 5.4), layout="constrained")
    axes = figure.subplots(len(_UNITS), sharex=True)
    for one, (name, unit) in zip(axes, _UNITS.items(), strict=True):
        one.plot(log["time"], log[f"asked_{name}"], color="#bbbbbb", label="asked")
        one.plot(log["time"], log[name], color="#4477aa", label="sent")
        stands = log["moving"] < 0.5
        one.fill_between(
            log["time"], 0, 1, stands, transform=one.get_xaxis_transform(), color="#0001", lw=0
        )
        one.set_ylabel(f"{name.replace('_', ' ')}, {unit}")
    axes[0].legend(loc="upper right")
    axes[-1].set_xlabel("time, s")
    return figure
