"""Cells of a study and their estimates over seeds: bands, final values, scores and aggregates."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mqe_jax.study import statistics
from mqe_jax.study.reference import Reference
from mqe_jax.study.runs import REWARD, Cell, Run, table

Array = NDArray[np.float64]
Cells = Mapping[Cell, Sequence[Run]]

LAST = 0.02
"""Fraction of a training run over which its final reward is averaged."""


def group(runs: Sequence[Run], reference: Reference) -> dict[Cell, list[Run]]:
    """Returns the runs of each cell, cells in the reference's order: by variant, task and algorithm."""
    cells: dict[Cell, list[Run]] = {}
    for run in runs:
        cells.setdefault(run.cell, []).append(run)
    orders = list(reference.variants), list(reference.tasks), list(reference.algorithms)

    def key(cell: Cell) -> list[tuple[int, str]]:
        names = cell.variant, cell.task, cell.algorithm
        return [(o.index(x) if x in o else len(o), x) for x, o in zip(names, orders, strict=True)]

    return {cell: cells[cell] for cell in sorted(cells, key=key)}


def _estimate(scores: Array) -> tuple[Array, Array, Array]:
    """Returns interquartile mean over runs and its interval, per column: (runs, K) -> (K,) each."""

    def per_column(x: Array) -> Array:
        return statistics.interquartile_mean(np.moveaxis(x, -1, -2)[..., None])

    middle = per_column(scores)
    low, high = statistics.bootstrap_interval(scores, per_column, np.random.default_rng(0))
    return middle, low, high


def band(runs: Sequence[Run], column: str = REWARD) -> tuple[Array, Array, Array, Array]:
    """Returns steps (K,), interquartile mean and interval bounds (K,) of a column over a cell's seeds.

    Curves are interpolated to the first seed's steps, up to the last step that all seeds have reached. A reward term
    that a curve lacks is zero.
    """
    steps = runs[0].curve["env_steps"]
    steps = steps[steps <= min(run.curve["env_steps"][-1] for run in runs)]
    curves = [
        np.zeros_like(run.curve["env_steps"])
        if column.startswith("reward/") and column not in run.curve
        else run.curve[column]
        for run in runs
    ]
    scores = np.stack([np.interp(steps, r.curve["env_steps"], y) for r, y in zip(runs, curves, strict=True)])
    return (steps, *_estimate(scores))


def final_reward(run: Run) -> float:
    """Returns the average step reward at the end of a training run: the mean over the last rows of its curve."""
    values = run.curve[REWARD]
    return float(values[-max(1, round(LAST * len(values))) :].mean())


def absolute(run: Run, name: str) -> float:
    """Returns a number of the absolute metric under sampled actions, NaN if there is none."""
    metric = run.absolute
    value = None if metric is None else metric["sampled"].get(name)
    return math.nan if value is None else float(value)


def evaluation_curve(run: Run) -> Run | None:
    """Returns a run whose curve is that of its evaluations: env_steps, and REWARD under sampled actions.

    Training curves include shaping rewards and assistance; evaluations are always of the unmodified task. None if the
    run has no evaluations.
    """
    points = run.evaluations
    values = [point["sampled"].get(REWARD) for point in points]
    if not points or any(value is None for value in values):
        return None
    curve = {"env_steps": [point["env_steps"] for point in points], REWARD: values}
    return dataclasses.replace(run, curve={name: np.array(x, np.float64) for name, x in curve.items()})


def evaluated(cells: Cells) -> Cells:
    """Returns the cells whose runs all have evaluations, with these as curves."""
    curves = {cell: [evaluation_curve(run) for run in runs] for cell, runs in cells.items()}
    return {cell: [run for run in runs if run] for cell, runs in curves.items() if all(runs)}


def over_seeds(values: Sequence[float]) -> tuple[float, float, float]:
    """Returns estimate and interval of one number over seeds, NaN if a seed has no value."""
    scores = np.array(values)[:, None]
    if not np.isfinite(scores).all():
        return math.nan, math.nan, math.nan
    return tuple(float(x[0]) for x in _estimate(scores))  # type: ignore[return-value]


def curves_table(cells: Cells) -> str:
    """Returns the curves' bands as CSV text."""
    columns: dict[str, list[Any]] = {name: [] for name in "task algorithm variant env_steps iqm low high".split()}
    for cell, runs in cells.items():
        for row in zip(*band(runs), strict=True):
            for name, item in zip(columns, (cell.task, cell.algorithm, cell.variant, *row), strict=True):
                columns[name].append(item)
    return table(columns)


def final_table(cells: Cells, reference: Reference) -> dict[str, list[Any]]:
    """Returns the columns of the table of final values, a row for each cell; `reference` only where it has values."""
    rows = []
    for cell, runs in cells.items():
        row: dict[str, Any] = {"task": cell.task, "algorithm": cell.algorithm, "variant": cell.variant}
        row |= {"seeds": len(runs), "env_steps": min(run.curve["env_steps"][-1] for run in runs)}
        for name, values in (
            ("training", [final_reward(run) for run in runs]),
            ("absolute", [absolute(run, REWARD) for run in runs]),
            ("success", [absolute(run, "success_rate") for run in runs]),
        ):
            row |= dict(zip((name, f"{name}_low", f"{name}_high"), over_seeds(values), strict=True))
        if reference.values:
            value = reference.value(cell.variant, cell.task, cell.algorithm)
            row["reference"] = math.nan if value is None else value
        rows.append(row)
    return {name: [row[name] for row in rows] for name in rows[0]}


def score_matrices(cells: Cells, variant: str) -> dict[str, Array]:
    """Returns each algorithm's scores (runs, tasks) of a variant as fractions of each task's range.

    Only tasks and seeds common to all algorithms are used; the score is the absolute metric if all runs have it,
    otherwise the final training reward. Empty for fewer than two algorithms, or if fewer than half of the variant's
    tasks are common.
    """
    chosen = {cell: runs for cell, runs in cells.items() if cell.variant == variant}
    algorithms = list(dict.fromkeys(cell.algorithm for cell in chosen))
    every = list(dict.fromkeys(cell.task for cell in chosen))
    tasks = [task for task in every if all(Cell(task, algorithm, variant) in chosen for algorithm in algorithms)]
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
        a: np.array([[score(r) for r in used[a, t] if r.seed in seeds] for t in tasks], np.float64).T
        for a in algorithms
    }
    everything = np.concatenate(list(scores.values()))
    return statistics.normalized(scores, everything.min(axis=0), everything.max(axis=0))


def aggregate_tables(cells: Cells) -> dict[str, dict[str, list[Any]]]:
    """Returns the columns of the tables over all tasks: interquartile means and probabilities of improvement."""
    total: list[tuple[Any, ...]] = []
    pairs: list[tuple[Any, ...]] = []
    for variant in dict.fromkeys(cell.variant for cell in cells):
        scores = score_matrices(cells, variant)
        for name, values in scores.items():
            middle = float(statistics.interquartile_mean(values))
            low, high = statistics.bootstrap_interval(values, statistics.interquartile_mean, np.random.default_rng(0))
            total.append((variant, name, *values.shape, middle, float(low), float(high)))
        for x, y in itertools.permutations(scores, 2):
            chance = float(statistics.probability_of_improvement(scores[x], scores[y]))
            low, high = statistics.bootstrap_interval(
                [scores[x], scores[y]], statistics.probability_of_improvement, np.random.default_rng(0)
            )
            pairs.append((variant, x, y, chance, float(low), float(high)))
    if not total:
        return {}
    total_names = "variant algorithm runs tasks iqm low high".split()
    pair_names = "variant first second probability low high".split()
    return {
        "aggregate": dict(zip(total_names, map(list, zip(*total, strict=True)), strict=True)),
        "improvement": dict(zip(pair_names, map(list, zip(*pairs, strict=True)), strict=True)),
    }
