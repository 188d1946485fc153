"""Cells of a study and their estimates over seeds: bands, final values, scores and aggregates."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mqe_jax.study import statistics
from mqe_jax.study.runs import REWARD, Cell, Run

Array = NDArray[np.float64]
Cells = Mapping[Cell, Sequence[Run]]
Rows = list[dict[str, Any]]
"""A table, with the same columns in all rows."""

LAST = 0.02
"""Fraction of a training run over which its final reward is averaged."""


def group(runs: Sequence[Run]) -> dict[Cell, list[Run]]:
    """Returns the runs of each cell, cells sorted by variant, task and algorithm."""
    cells = sorted({run.cell for run in runs}, key=lambda x: (x.variant, x.task, x.algorithm))
    return {cell: [run for run in runs if run.cell == cell] for cell in cells}


def names(cells: Cells, field: str) -> list[str]:
    """Returns the tasks, algorithms or variants of cells, in their order.

    `field` is that of `Cell`.
    """
    return list(dict.fromkeys(getattr(cell, field) for cell in cells))


def estimate(statistic: Callable[..., Array], *scores: Array) -> tuple[Array, Array, Array]:
    """Returns a statistic of scores (runs, tasks) each, and the bounds of its interval."""
    return (
        statistic(*scores),
        *statistics.bootstrap_interval(scores, statistic, np.random.default_rng(0)),
    )


def _per_column(scores: Array) -> Array:
    """Returns the interquartile mean over runs: (..., runs, K) -> (..., K)."""
    return statistics.interquartile_mean(np.moveaxis(scores, -1, -2)[..., None])


def band(runs: Sequence[Run], column: str = REWARD) -> tuple[Array, Array, Array, Array]:
    """Returns steps, interquartile mean and interval bounds of a column over a cell's seeds.

    Each is (K,). Curves are interpolated to the first seed's steps, as far as all seeds have come.
    A missing reward term is zero.
    """
    steps = runs[0].curve["env_steps"]
    steps = steps[steps <= min(run.curve["env_steps"][-1] for run in runs)]
    curves = [
        np.zeros_like(run.curve["env_steps"])
        if column.startswith("reward/") and column not in run.curve
        else run.curve[column]
        for run in runs
    ]
    scores = np.stack(
        [np.interp(steps, r.curve["env_steps"], y) for r, y in zip(runs, curves, strict=True)]
    )
    return (steps, *estimate(_per_column, scores))


def final_reward(run: Run) -> float:
    """Returns the average step reward at the end of a training run.

    It is the mean over the last rows of the run's curve.
    """
    values = run.curve[REWARD]
    return float(values[-max(1, round(LAST * len(values))) :].mean())


def absolute(run: Run, name: str) -> float:
    """Returns a number of the absolute metric under sampled actions, NaN if missing."""
    value = (run.absolute or {"sampled": {}})["sampled"].get(name)
    return math.nan if value is None else float(value)


def select_evaluated(cells: Cells) -> Cells:
    """Returns the cells whose runs all have evaluations, with these as curves.

    The evaluations are of the unmodified task.
    """
    chosen: dict[Cell, list[Run]] = {}
    for cell, runs in cells.items():
        curves = [
            {
                "env_steps": [point["env_steps"] for point in run.evaluations],
                REWARD: [point["sampled"].get(REWARD) for point in run.evaluations],
            }
            for run in runs
        ]
        if all(curve[REWARD] and None not in curve[REWARD] for curve in curves):
            arrays = [
                {name: np.array(x, np.float64) for name, x in curve.items()} for curve in curves
            ]
            chosen[cell] = [
                dataclasses.replace(run, curve=x) for run, x in zip(runs, arrays, strict=True)
            ]
    return chosen


def curve_rows(cells: Cells) -> Rows:
    """Returns the table of the curves' bands."""
    columns = ("env_steps", "iqm", "low", "high")
    return [
        {**dataclasses.asdict(cell), **dict(zip(columns, values, strict=True))}
        for cell, runs in cells.items()
        for values in zip(*band(runs), strict=True)
    ]


def final_rows(cells: Cells) -> Rows:
    """Returns the table of final values, a row for each cell.

    An estimate is NaN if a seed has no value.
    """
    rows = []
    for cell, runs in cells.items():
        row: dict[str, Any] = {**dataclasses.asdict(cell), "seeds": len(runs)}
        row["env_steps"] = min(run.curve["env_steps"][-1] for run in runs)
        for name, values in (
            ("training", [final_reward(run) for run in runs]),
            ("absolute", [absolute(run, REWARD) for run in runs]),
            ("success", [absolute(run, "success_rate") for run in runs]),
        ):
            known = np.isfinite(values).all()
            three = (
                estimate(_per_column, np.array(values)[:, None])
                if known
                else np.full((3, 1), math.nan)
            )
            row |= {
                key: float(x[0])
                for key, x in zip((name, f"{name}_low", f"{name}_high"), three, strict=True)
            }
        rows.append(row)
    return rows


def score_matrices(cells: Cells, variant: str) -> dict[str, Array]:
    """Returns each algorithm's scores (runs, tasks) of a variant as fractions of each task's range.

    Only tasks and seeds common to all algorithms are used; the score is the absolute metric if all
    runs have it, otherwise the final training reward. Empty for fewer than two algorithms, or if
    fewer than half of the variant's tasks are common.
    """
    chosen = {cell: runs for cell, runs in cells.items() if cell.variant == variant}
    algorithms = names(chosen, "algorithm")
    every = names(chosen, "task")
    tasks = [
        task
        for task in every
        if all(Cell(task, algorithm, variant) in chosen for algorithm in algorithms)
    ]
    if len(algorithms) < 2 or not tasks or 2 * len(tasks) < len(every):
        return {}
    used = {(a, t): chosen[Cell(t, a, variant)] for a in algorithms for t in tasks}
    seeds = set.intersection(*({run.seed for run in runs} for runs in used.values()))
    if not seeds:
        return {}
    ended = all(math.isfinite(absolute(run, REWARD)) for runs in used.values() for run in runs)

    def score(run: Run) -> float:
        return absolute(run, REWARD) if ended else final_reward(run)

    scores = {
        a: np.array(
            [[score(r) for r in used[a, t] if r.seed in seeds] for t in tasks], np.float64
        ).T
        for a in algorithms
    }
    everything = np.concatenate(list(scores.values()))
    return statistics.normalize(scores, everything.min(axis=0), everything.max(axis=0))


def aggregate_tables(cells: Cells) -> dict[str, Rows]:
    """Returns the tables over all tasks: interquartile means and probabilities of improvement."""
    total: Rows = []
    pairs: Rows = []
    for variant in names(cells, "variant"):
        scores = score_matrices(cells, variant)
        for name, values in scores.items():
            middle, low, high = map(float, estimate(statistics.interquartile_mean, values))
            total.append(
                {
                    "variant": variant,
                    "algorithm": name,
                    "runs": len(values),
                    "tasks": values.shape[1],
                    "iqm": middle,
                    "low": low,
                    "high": high,
                }
            )
        for x, y in itertools.permutations(scores, 2):
            chance, low, high = map(
                float, estimate(statistics.probability_of_improvement, scores[x], scores[y])
            )
            pairs.append(
                {
                    "variant": variant,
                    "first": x,
                    "second": y,
                    "probability": chance,
                    "low": low,
                    "high": high,
                }
            )
    return {"aggregate": total, "improvement": pairs} if total else {}
