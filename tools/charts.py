"""Charts of docs/drawings, drawn from results/ by tools/drawings.py."""

import csv
import itertools
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mqe_jax.viz.curves import plot_curves

RESULTS = Path(__file__).parents[1] / "results"
WIDTH = 640  # px, of every drawing; a phone shows it at half the size
INK = "#23252b"
FAINT = "#5f6672"
LINE = "#8a93a3"
BLUE = "#2f7fd6"
ORANGE = "#d9731a"
GREEN = "#2e8b57"
VIOLET = "#7a55c7"
GREY = "#6b7280"
TITLES = {
    "go1gate": "Narrow Gate",
    "go1seesaw": "Seesaw",
    "go1sheep-easy": "Sheep Dog (Easy)",
    "go1sheep-hard": "Sheep Dog (Hard)",
    "go1pushbox": "Push Box",
    "go1football-defender": "Football (2 vs 1)",
}


def read_rows(name: str) -> list[dict[str, str]]:
    """Returns the rows of a table of results/."""
    return list(csv.DictReader((RESULTS / name).read_text("utf-8").splitlines()))


def read_measurements() -> dict[str, Any]:
    """Returns the entries of results/measurements.json by name."""
    return json.loads((RESULTS / "measurements.json").read_text("utf-8"))


def curves() -> Figure:
    """Success in evaluations during trainings with the default settings: results/curves.csv."""
    return _curves(read_rows("curves.csv"), ["go1gate", "go1seesaw", "go1pushbox"], 2.8, (0, 102))


def demo() -> Figure:
    """The curve of `mqe train go1gate --config demo`: results/demo.csv."""
    rows = read_rows("demo.csv")
    columns = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
    figure = plot_curves([columns], "")
    figure.set_size_inches(WIDTH / 100, 2.8)
    return figure


def students() -> Figure:
    """Success of training episodes while teams with sensors imitate the shipped ones.

    Source: results/students.csv.
    """
    return _curves(read_rows("students.csv"), [*TITLES], 4.6, (70, 101))


def _curves(
    rows: Sequence[dict[str, str]], tasks: Sequence[str], height: float, limits: tuple[float, float]
) -> Figure:
    """Draws the success of each task over its environment steps: each seed and their mean."""
    figure = Figure((WIDTH / 100, height), layout="constrained")
    columns = min(3, len(tasks))
    lines = math.ceil(len(tasks) / columns)
    panels = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False)
    for axes, task in zip(panels.flat, tasks, strict=True):
        own = [row for row in rows if row["task"] == task]
        table: dict[float, list[float]] = {}
        for seed in sorted({row["seed"] for row in own}):
            curve = [row for row in own if row["seed"] == seed]
            steps = [float(row["env_steps"]) / 1e6 for row in curve]
            rates = [100 * float(row["success"]) for row in curve]
            axes.plot(steps, rates, color=BLUE, alpha=0.35, lw=1.2)
            for step, rate in zip(steps, rates, strict=True):
                table.setdefault(step, []).append(rate)
        axes.plot([*table], [np.mean(values) for values in table.values()], color=BLUE, lw=2.4)
        axes.set_title(TITLES[task], fontsize=12, color=INK, loc="left", weight="bold")
        axes.set(xlim=(0, None), ylim=limits)
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    figure.supxlabel("environment steps, millions", fontsize=10.5)
    figure.supylabel("success, % of the episodes", fontsize=10.5)
    panels.flat[-1].plot([], [], color=BLUE, alpha=0.35, lw=1.2, label="one seed")
    panels.flat[-1].plot([], [], color=BLUE, lw=2.4, label="mean of three")
    figure.legend(loc="outside upper right", ncols=2, frameon=False, fontsize=10)
    return figure


def sizes() -> Figure:
    """Robot steps/s: by engine over the number of robots, on Warp over that of environments."""
    entries = read_measurements()
    rates: dict[tuple[str, int, int], list[float]] = {}  # by engine and task, robots, environments
    tables = [entries[f"sizes/{name}"]["rows"] for name in ("c", "mjx", "warp")]
    for row in itertools.chain(*tables):
        kind = f"{row['impl']} {row['task']}"
        robots = row["num_agents"]
        rate = robots * row["env_steps_per_s"]
        sparse = row.get("sparse_solver", False)
        if sparse == (row["impl"] == "warp" and robots > 4):  # the default
            rates.setdefault((kind, robots, row["num_envs"]), []).append(rate)
        if row.get("sparse_solver") is False:
            rates.setdefault((f"{kind} false", robots, row["num_envs"]), []).append(rate)
    football = "go1football-1vs1"
    engines = {
        (f"warp {football}", 2048): ("Warp, football", VIOLET),
        ("warp go1gate", 2048): ("Warp, gate", GREEN),
        (f"c {football}", 64): ("C, football", BLUE),
        (f"jax {football}", 4): ("MJX, football", ORANGE),
    }
    sized = {
        (f"warp {football}", 2): ("2 robots", GREY),
        (f"warp {football}", 16): ("16 robots", VIOLET),
        (f"warp {football}", 64): ("64 robots", INK),
    }
    figure = Figure((WIDTH / 100, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    for axes, varied, title, lines in (
        (left, 1, "robots", engines),
        (right, 2, "environments on Warp", sized),
    ):
        for (kind, fixed), (label, color) in lines.items():
            for case, style in ((f"{kind} false", "o--"), (kind, "o-")):
                own = {}
                for key, values in sorted(rates.items()):
                    if (key[0], key[3 - varied]) == (case, fixed):
                        own[key[varied]] = np.median(values)
                look = {"color": color, "ms": 4, "label": label if case == kind else None}
                axes.plot([*own.keys()], [*own.values()], style, **look)
        axes.set(xscale="log", yscale="log")
        axes.set_xlabel(title, fontsize=10.5)
        shown = [key for key in rates if varied == 1 or key[:2] == (f"warp {football}", 2)]
        ticks = sorted({key[varied] for key in shown})
        axes.set_xticks(ticks, [str(tick) for tick in ticks], fontsize=9)
        axes.minorticks_off()
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    right.plot([], [], "--", color=FAINT, label="sparse_solver=false")
    left.legend(loc=(0.03, 0.42), frameon=False, fontsize=10)
    right.legend(loc="lower right", frameon=False, fontsize=10)
    left.set_ylabel("robot steps/s", fontsize=10.5)
    return figure


def performance() -> Figure:
    """Environment steps/s of Narrow Gate by hardware and engine, with slowest and fastest calls."""
    entries = read_measurements()
    walk = [row for row in entries["bench_h200"]["rows"] if row["num_envs"] > 16]
    names = ("num_envs", "env_steps_per_s", "slowest", "fastest")
    warp = sorted(tuple(row[name] for name in names) for row in walk)
    rows = [row for row in entries["bench_h100"] if row["impl"] == "jax"]
    mjx = sorted((int(row["num_envs"]), *[float(row["env_steps_per_s"])] * 3) for row in rows)
    cores = [(environments, *[rate] * 3) for environments, rate, _ in entries["bench_c16"]["sizes"]]
    two = entries["skills/speed"]["c, 2 CPU cores, 8 interleaved timings"]["walk"]
    lines = (  # label, colour, values, offset of the label from the last point, its alignment
        ("Warp, NVIDIA H200", VIOLET, warp, (4, 14), "right"),
        ("MJX, NVIDIA H100", ORANGE, mjx, (4, 14), "right"),
        ("C, 16 CPU cores", BLUE, cores, (10, 0), "left"),
        ("C, 2 CPU cores", GREEN, [(256, np.median(two), min(two), max(two))], (-6, -20), "left"),
        ("Isaac Gym, RTX 3090 (paper)", INK, [(500, 18300, 18300, 18300)], (10, 0), "left"),
    )
    figure = Figure((WIDTH / 100, 4.2), layout="constrained")
    axes = figure.subplots()
    for label, color, points, shift, side in lines:
        environments, rates, slowest, fastest = zip(*points, strict=True)
        axes.vlines(environments, slowest, fastest, color=color, lw=5, alpha=0.35)
        axes.plot(environments, rates, "o-", color=color, lw=2.2, ms=7)
        at = (environments[-1], rates[-1])
        look = {"ha": side, "va": "center", "weight": "bold", "fontsize": 14, "color": color}
        axes.annotate(label, at, shift, textcoords="offset points", **look)
    axes.set(xscale="log", yscale="log", xlim=(215, 5000), ylim=(9e3, 2e6))
    ticks = [256, 512, 1024, 2048, 4096]
    axes.set_xticks(ticks, [str(tick) for tick in ticks], fontsize=14)
    ticks = [10_000, 100_000, 1_000_000]
    axes.set_yticks(ticks, [f"{tick:,}" for tick in ticks], fontsize=14)
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlabel("environments", fontsize=14)
    axes.set_ylabel("environment steps/s", fontsize=14)
    return figure
