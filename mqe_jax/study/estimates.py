"""Cells of a study and their estimates over seeds: bands, final values, scores and aggregates."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mqe_jax.study import paper, statistics
from mqe_jax.study.records import REWARD, Cell, Record, table

Array = NDArray[np.float64]
Cells = Mapping[Cell, Sequence[Record]]

TUNED = "tuned"
"""Setting of cells trained with `configs/tuned`."""
LAST = 0.02
"""Fraction of a training run over which its final reward is averaged."""


def group(records: Sequence[Record]) -> dict[Cell, list[Record]]:
    """Returns the records of each cell, cells in the paper's order, other settings, tasks and algorithms last."""
    cells: dict[Cell, list[Record]] = {}
    for record in records:
        cells.setdefault(record.cell, []).append(record)
    return dict(sorted(cells.items(), key=lambda item: order(item[0])))


def order(cell: Cell) -> tuple[Any, ...]:
    """Returns the key by which cells are sorted."""
    settings, tasks, algorithms = [*paper.SETTINGS, TUNED], list(paper.TITLES), list(paper.ALGORITHMS)
    return (
        settings.index(cell.setting) if cell.setting in settings else len(settings),
        cell.setting,
        tasks.index(cell.task) if cell.task in tasks else len(tasks),
        cell.task,
        algorithms.index(cell.algorithm) if cell.algorithm in algorithms else len(algorithms),
        cell.algorithm,
    )


def _estimate(scores: Array) -> tuple[Array, Array, Array]:
    """Returns interquartile mean over runs and its interval, per column: (runs, K) -> (K,) each."""

    def per_column(x: Array) -> Array:
        return statistics.interquartile_mean(np.moveaxis(x, -1, -2)[..., None])

    middle = per_column(scores)
    low, high = statistics.bootstrap_interval(scores, per_column, np.random.default_rng(0))
    return middle, low, high


def band(records: Sequence[Record], column: str = REWARD) -> tuple[Array, Array, Array, Array]:
    """Returns steps (K,), interquartile mean and interval bounds (K,) of a column over a cell's seeds.

    Curves are interpolated to the first seed's steps, up to the last step that all seeds have reached. A reward term
    that a curve lacks is zero.
    """
    steps = records[0].curve["env_steps"]
    steps = steps[steps <= min(record.curve["env_steps"][-1] for record in records)]
    curves = [
        np.zeros_like(record.curve["env_steps"])
        if column.startswith("reward/") and column not in record.curve
        else record.curve[column]
        for record in records
    ]
    scores = np.stack([np.interp(steps, r.curve["env_steps"], y) for r, y in zip(records, curves, strict=True)])
    return (steps, *_estimate(scores))


def final_reward(record: Record) -> float:
    """Returns the average step reward at the end of a training run: the mean over the last rows of its curve."""
    values = record.curve[REWARD]
    return float(values[-max(1, round(LAST * len(values))) :].mean())


def absolute(record: Record, name: str) -> float:
    """Returns a number of the absolute metric under sampled actions, NaN if there is none."""
    metric = record.evaluation["absolute"]
    value = None if metric is None else metric["sampled"].get(name)
    return math.nan if value is None else float(value)


def evaluation_curve(record: Record) -> Record | None:
    """Returns a run whose curve is that of its evaluations: env_steps, and REWARD under sampled actions.

    Training curves include shaping rewards and assistance; evaluations are always of the unmodified task. None if the
    run has no evaluations.
    """
    points = record.evaluation["evaluations"]
    values = [point["sampled"].get(REWARD) for point in points]
    if not points or any(value is None for value in values):
        return None
    curve = {"env_steps": [point["env_steps"] for point in points], REWARD: values}
    return dataclasses.replace(record, curve={name: np.array(x, np.float64) for name, x in curve.items()})


def evaluated(cells: Cells) -> Cells:
    """Returns the cells whose runs all have evaluations, with these as curves."""
    curves = {cell: [evaluation_curve(record) for record in records] for cell, records in cells.items()}
    return {cell: [run for run in runs if run] for cell, runs in curves.items() if all(runs)}


def over_seeds(values: Sequence[float]) -> tuple[float, float, float]:
    """Returns estimate and interval of one number over seeds, NaN if a seed has no value."""
    scores = np.array(values)[:, None]
    if not np.isfinite(scores).all():
        return math.nan, math.nan, math.nan
    return tuple(float(x[0]) for x in _estimate(scores))  # type: ignore[return-value]


def curves_table(cells: Cells) -> str:
    """Returns the curves' bands as CSV text."""
    columns: dict[str, list[Any]] = {name: [] for name in "task algorithm setting env_steps iqm low high".split()}
    for cell, records in cells.items():
        for row in zip(*band(records), strict=True):
            for name, item in zip(columns, (cell.task, cell.algorithm, cell.setting, *row), strict=True):
                columns[name].append(item)
    return table(columns)


def final_table(cells: Cells) -> dict[str, list[Any]]:
    """Returns the columns of the table of final values, a row for each cell."""
    rows = []
    for cell, records in cells.items():
        row: dict[str, Any] = {"task": cell.task, "algorithm": cell.algorithm, "setting": cell.setting}
        row |= {"seeds": len(records), "env_steps": min(record.curve["env_steps"][-1] for record in records)}
        for name, values in (
            ("training", [final_reward(record) for record in records]),
            ("absolute", [absolute(record, REWARD) for record in records]),
            ("success", [absolute(record, "success_rate") for record in records]),
        ):
            row |= dict(zip((name, f"{name}_low", f"{name}_high"), over_seeds(values), strict=True))
        reported = paper.value(cell.setting, cell.task, cell.algorithm)
        rows.append({**row, "paper": math.nan if reported is None else reported})
    return {name: [row[name] for row in rows] for name in rows[0]}


ABOVE, ABOUT_ABOVE, ABOUT_BELOW, BELOW = "above", "above, within the interval", "below, within the interval", "below"
"""Verdicts of `comparison`: where the estimate and its 95% interval lie relative to the paper's value."""


MIN_SEEDS = 3
"""Seeds that a verdict requires: the interval of a single seed is a point."""


def comparison(finals: Mapping[str, Sequence[Any]]) -> dict[str, list[Any]]:
    """Returns the columns `compared` and `ours` to be added to those of `final_table`.

    `compared` is the column compared with the paper's value: `training` in the paper's settings, as in its figure, and
    `absolute` in others, whose training rewards may include shaping. `ours` is a verdict, empty without both values or
    with fewer than `MIN_SEEDS` seeds.
    """
    compared = ["training" if setting in paper.SETTINGS else "absolute" for setting in finals["setting"]]
    ours = []
    for i, name in enumerate(compared):
        middle, low, high, value = (finals[column][i] for column in (name, f"{name}_low", f"{name}_high", "paper"))
        if finals["seeds"][i] < MIN_SEEDS or not math.isfinite(middle) or not math.isfinite(value):
            ours.append("")
        elif middle > value:
            ours.append(ABOVE if low > value else ABOUT_ABOVE)
        else:
            ours.append(BELOW if high < value else ABOUT_BELOW)
    return {"compared": compared, "ours": ours}


def score_matrices(cells: Cells, setting: str) -> dict[str, Array]:
    """Returns each algorithm's scores (runs, tasks) of a setting as fractions of each task's range.

    Only tasks and seeds common to all algorithms are used; the score is the absolute metric if all runs have it,
    otherwise the final training reward. Empty for fewer than two algorithms, or if fewer than half of the setting's
    tasks are common.
    """
    chosen = {cell: records for cell, records in cells.items() if cell.setting == setting}
    algorithms = list(dict.fromkeys(cell.algorithm for cell in chosen))
    every = list(dict.fromkeys(cell.task for cell in chosen))
    tasks = [task for task in every if all(Cell(task, algorithm, setting) in chosen for algorithm in algorithms)]
    if len(algorithms) < 2 or not tasks or 2 * len(tasks) < len(every):
        return {}
    used = {(a, t): chosen[Cell(t, a, setting)] for a in algorithms for t in tasks}
    seeds = set.intersection(*({record.seed for record in records} for records in used.values()))
    if not seeds:
        return {}
    ended = all(math.isfinite(absolute(record, REWARD)) for records in used.values() for record in records)

    def score(record: Record) -> float:
        return absolute(record, REWARD) if ended else final_reward(record)

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
    for setting in dict.fromkeys(cell.setting for cell in cells):
        scores = score_matrices(cells, setting)
        for name, values in scores.items():
            middle = float(statistics.interquartile_mean(values))
            low, high = statistics.bootstrap_interval(values, statistics.interquartile_mean, np.random.default_rng(0))
            total.append((setting, name, *values.shape, middle, float(low), float(high)))
        for x, y in itertools.permutations(scores, 2):
            chance = float(statistics.probability_of_improvement(scores[x], scores[y]))
            low, high = statistics.bootstrap_interval(
                [scores[x], scores[y]], statistics.probability_of_improvement, np.random.default_rng(0)
            )
            pairs.append((setting, x, y, chance, float(low), float(high)))
    if not total:
        return {}
    total_names = "setting algorithm runs tasks iqm low high".split()
    pair_names = "setting first second probability low high".split()
    return {
        "aggregate": dict(zip(total_names, map(list, zip(*total, strict=True)), strict=True)),
        "improvement": dict(zip(pair_names, map(list, zip(*pairs, strict=True)), strict=True)),
    }
