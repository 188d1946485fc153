"""The report of a sweep: figures, tables and aggregates with the paper's values, generated from raw data alone.

The output is deterministic: bootstrap intervals use a fixed seed, and figures contain no timestamp.
"""

from __future__ import annotations

import io
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mqe_jax.files import write_atomically
from mqe_jax.study import paper, statistics
from mqe_jax.study.marl_eval import to_marl_eval
from mqe_jax.study.records import Cell, Record, number, read_records, table

Array = NDArray[np.float64]
Cells = Mapping[Cell, Sequence[Record]]

_LAST = 0.02
_INK, _PALE = "#23252b", "#8a8f99"
_COLORS = {"jrpo": "#4f86e0", "mat": "#3fae49", "mappo": "#b5316f"}
_OTHER_COLORS = ("#d98b1f", "#7a5bd0", "#2a9d9d", "#8a5a3b", _INK)
_REWARD = "average_step_reward"


def report(folder: Path) -> list[Path]:
    """Writes FOLDER/report from FOLDER/raw; returns the files.

    Raises:
        InputError: if the raw data are missing or damaged.
    """
    records = read_records(folder)
    cells: dict[Cell, list[Record]] = {}
    for record in records:
        cells.setdefault(record.cell, []).append(record)
    cells = dict(sorted(cells.items(), key=lambda item: _order(item[0])))
    files: dict[str, bytes] = {"curves.png": draw_curves(cells), "curves.csv": curves_table(cells).encode()}
    finals = final_table(cells)
    files["final.csv"] = table(finals).encode()
    text = ["# Results", "", _EXPLANATION, "", markdown(finals), "", "![Learning curves](curves.png)", ""]
    aggregates = aggregate_tables(cells)
    for name, columns in aggregates.items():
        files[f"{name}.csv"] = table(columns).encode()
        text += [f"## {_HEADINGS[name]}", "", markdown(columns), ""]
    if aggregates:
        files["profiles.png"] = draw_profiles(cells)
        text += ["![Performance profiles](profiles.png)", ""]
    gate = cells.get(Cell("go1gate", "mappo"))
    if gate is not None and all(name in record.curve for record in gate for name in paper.GATE_TERMS):
        files["gate_terms.png"], columns = gate_terms(gate)
        files["gate_terms.csv"] = table(columns).encode()
        text += ["## Narrow Gate: two reward terms", "", "![Two reward terms](gate_terms.png)", ""]
    ended = [_flat(record) for record in records if record.evaluation["absolute"] is not None]
    if ended:
        files["marl_eval.json"] = (json.dumps(to_marl_eval(ended), indent=1) + "\n").encode()
    files["report.md"] = "\n".join(text).encode()
    target = folder / "report"
    target.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        write_atomically(target / name, content)
    return [target / name for name in files]


_EXPLANATION = f"""Each value is the interquartile mean over seeds with its 95% stratified bootstrap interval.
`training`: average step reward over the last {_LAST:.0%} of training steps, as in the paper's figure. `absolute`:
average step reward of the best checkpoint over the final evaluation's episodes, actions sampled; `success` likewise.
`paper`: read from the paper's figure after 40 M steps (from scratch: the best algorithm's value)."""
_SETTINGS = {paper.HIERARCHICAL: "walk policy", paper.SCRATCH: "from scratch"}
_HEADINGS = {
    "aggregate": "Over all tasks, as fractions of each task's range of scores",
    "improvement": "Probability of improvement of the first algorithm over the second",
}


def _order(cell: Cell) -> tuple[Any, ...]:
    tasks, algorithms = list(paper.TITLES), list(paper.ALGORITHMS)
    return (
        cell.setting != paper.HIERARCHICAL,
        cell.setting,
        tasks.index(cell.task) if cell.task in tasks else len(tasks),
        cell.task,
        algorithms.index(cell.algorithm) if cell.algorithm in algorithms else len(algorithms),
        cell.algorithm,
    )


def _flat(record: Record) -> dict[str, Any]:
    cell = record.cell
    task = cell.task if cell.setting == paper.HIERARCHICAL else f"{cell.task}+{cell.setting}"
    return {"task": task, "algorithm": cell.algorithm, "seed": record.seed, **record.evaluation}


# -- numbers ---------------------------------------------------------------------------------------------------------


def _estimate(scores: Array) -> tuple[Array, Array, Array]:
    """Returns interquartile mean over runs and its interval, per column: (runs, K) -> (K,) each."""

    def per_column(x: Array) -> Array:
        return statistics.interquartile_mean(np.moveaxis(x, -1, -2)[..., None])

    middle = per_column(scores)
    low, high = statistics.bootstrap_interval(scores, per_column, np.random.default_rng(0))
    return middle, low, high


def band(records: Sequence[Record], column: str = _REWARD) -> tuple[Array, Array, Array, Array]:
    """Returns steps (K,), interquartile mean and interval bounds (K,) of a column over a cell's seeds.

    Curves are interpolated to the first seed's steps, up to the last step that all seeds have reached.
    """
    steps = records[0].curve["env_steps"]
    steps = steps[steps <= min(record.curve["env_steps"][-1] for record in records)]
    scores = np.stack([np.interp(steps, record.curve["env_steps"], record.curve[column]) for record in records])
    return (steps, *_estimate(scores))


def final_reward(record: Record) -> float:
    """Returns the average step reward at the end of a training run: the mean over the last rows of its curve."""
    values = record.curve[_REWARD]
    return float(values[-max(1, round(_LAST * len(values))) :].mean())


def _absolute(record: Record, name: str) -> float:
    absolute = record.evaluation["absolute"]
    value = None if absolute is None else absolute["sampled"].get(name)
    return math.nan if value is None else float(value)


def _one(values: Sequence[float]) -> tuple[float, float, float]:
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
            ("absolute", [_absolute(record, _REWARD) for record in records]),
            ("success", [_absolute(record, "success_rate") for record in records]),
        ):
            row |= dict(zip((name, f"{name}_low", f"{name}_high"), _one(values), strict=True))
        reported = paper.value(cell.setting, cell.task, cell.algorithm)
        rows.append({**row, "paper": math.nan if reported is None else reported})
    return {name: [row[name] for row in rows] for name in rows[0]}


def score_matrices(cells: Cells, setting: str) -> dict[str, Array]:
    """Returns each algorithm's scores (runs, tasks) of a setting as fractions of each task's range.

    Only tasks and seeds common to all algorithms are used; the score is the absolute metric if all runs have it,
    otherwise the final training reward. Empty for fewer than two algorithms.
    """
    chosen = {cell: records for cell, records in cells.items() if cell.setting == setting}
    algorithms = list(dict.fromkeys(cell.algorithm for cell in chosen))
    tasks = [
        task
        for task in dict.fromkeys(cell.task for cell in chosen)
        if all(Cell(task, algorithm, setting) in chosen for algorithm in algorithms)
    ]
    if len(algorithms) < 2 or not tasks:
        return {}
    used = {(a, t): chosen[Cell(t, a, setting)] for a in algorithms for t in tasks}
    seeds = set.intersection(*({record.seed for record in records} for records in used.values()))
    if not seeds:
        return {}
    ended = all(math.isfinite(_absolute(record, _REWARD)) for records in used.values() for record in records)

    def score(record: Record) -> float:
        return _absolute(record, _REWARD) if ended else final_reward(record)

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


def markdown(columns: Mapping[str, Sequence[Any]]) -> str:
    """Returns columns as a Markdown table; NAME, NAME_low and NAME_high (or low and high) share one column."""
    hidden = {name for name in columns if name in ("low", "high") or name.endswith(("_low", "_high"))}
    shown = [name for name in columns if name not in hidden]
    lines = ["| " + " | ".join(shown) + " |", "|" + "---|" * len(shown)]
    for i in range(len(next(iter(columns.values())))):
        cells = []
        for name in shown:
            item = columns[name][i]
            text = item if isinstance(item, str) else _short(item)
            ends = ("low", "high") if name in ("iqm", "probability") else (f"{name}_low", f"{name}_high")
            if ends[0] in columns and text:
                text += f" [{_short(columns[ends[0]][i])}, {_short(columns[ends[1]][i])}]"
            cells.append(text)
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _short(value: float) -> str:
    if not math.isfinite(value):
        return ""
    return number(value) if float(value).is_integer() else f"{value:.3g}"


# -- figures ---------------------------------------------------------------------------------------------------------


def _figure(width: float, height: float) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure((width, height), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _png(figure: Any) -> bytes:
    content = io.BytesIO()
    figure.savefig(content, format="png", metadata={"Software": None})
    return content.getvalue()


def _color(algorithm: str, algorithms: Sequence[str]) -> str:
    others = [name for name in algorithms if name not in _COLORS]
    return _COLORS.get(algorithm) or _OTHER_COLORS[others.index(algorithm) % len(_OTHER_COLORS)]


def _label(algorithm: str) -> str:
    return paper.ALGORITHMS.get(algorithm, algorithm.upper())


def draw_curves(cells: Cells) -> bytes:
    """Returns the paper's figure as PNG: for each setting a block of tasks, two per row, with bands over seeds.

    Dashed lines are the paper's final values, in the algorithm's colour (dark: its best algorithm from scratch).
    """
    settings = list(dict.fromkeys(cell.setting for cell in cells))
    algorithms = list(dict.fromkeys(cell.algorithm for cell in cells))
    tasks = list(dict.fromkeys(cell.task for cell in cells))
    across = min(2, len(tasks))
    rows, columns = -(-len(tasks) // across), across * len(settings)
    figure = _figure(max(5.0, 3.7 * columns), 2.5 * rows + 0.9)
    blocks = figure.subfigures(1, len(settings), squeeze=False)[0]
    for block, setting in zip(blocks, settings, strict=True):
        grid = block.subplots(rows, across, squeeze=False).ravel()
        for axes, task in itertools.zip_longest(grid, tasks):
            if task is None:
                axes.set_axis_off()
                continue
            for algorithm in algorithms:
                records = cells.get(Cell(task, algorithm, setting))
                if records is not None:
                    _draw_band(axes, records, _REWARD, _color(algorithm, algorithms), _label(algorithm))
            for name, value in paper.VALUES.get(setting, {}).get(task, {}).items():
                if name in algorithms or name == "best":
                    color = _INK if name == "best" else _color(name, algorithms)
                    axes.axhline(value, color=color, lw=1.0, ls=(0, (4, 3)), alpha=0.8)
            _style_axes(axes, paper.TITLES.get(task, task))
        block.suptitle(_SETTINGS.get(setting, setting), color=_INK, fontsize=11)
    _legend(figure, algorithms, paper_line=True)
    return _png(figure)


def _draw_band(axes: Any, records: Sequence[Record], column: str, color: str, label: str) -> None:
    steps, middle, low, high = band(records, column)
    axes.fill_between(steps / 1e6, low, high, color=color, alpha=0.15, lw=0)
    axes.plot(steps / 1e6, middle, color=color, lw=1.5, label=label)


def _style_axes(axes: Any, title: str, ylabel: str = "average step reward") -> None:
    axes.set_title(title, color=_INK, fontsize=10, style="italic")
    axes.set_xlabel("environment steps (millions)", fontsize=8)
    axes.set_ylabel(ylabel, fontsize=8)
    axes.set_xlim(left=0)
    axes.tick_params(labelsize=7)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)


def _legend(figure: Any, algorithms: Sequence[str], paper_line: bool) -> None:
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], color=_color(name, algorithms), label=_label(name)) for name in algorithms]
    if paper_line:
        handles.append(Line2D([], [], color=_PALE, ls=(0, (4, 3)), lw=1.0, label="paper, after 40 M steps"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False, fontsize=8)


def draw_profiles(cells: Cells) -> bytes:
    """Returns performance profiles of each setting as PNG: the fraction of runs above each score."""
    settings = [s for s in dict.fromkeys(cell.setting for cell in cells) if score_matrices(cells, s)]
    algorithms = list(dict.fromkeys(cell.algorithm for cell in cells))
    thresholds = np.linspace(0.0, 1.0, 101)

    def profile(scores: Array) -> Array:
        return statistics.performance_profile(scores, thresholds)

    figure = _figure(max(5.0, 4.2 * len(settings)), 3.4)
    for axes, setting in zip(figure.subplots(1, len(settings), squeeze=False)[0], settings, strict=True):
        for name, scores in score_matrices(cells, setting).items():
            low, high = statistics.bootstrap_interval(scores, profile, np.random.default_rng(0))
            color = _color(name, algorithms)
            axes.fill_between(thresholds, low, high, color=color, alpha=0.15, lw=0)
            axes.plot(thresholds, profile(scores), color=color, lw=1.5)
        _style_axes(axes, _SETTINGS.get(setting, setting), "fraction of runs above")
        axes.set_xlabel("score, fraction of each task's range", fontsize=8)
        axes.set(xlim=(0, 1), ylim=(-0.02, 1.02))
    _legend(figure, algorithms, paper_line=False)
    return _png(figure)


def gate_terms(records: Sequence[Record]) -> tuple[bytes, dict[str, list[Any]]]:
    """Returns the paper's appendix figure of go1gate as PNG, and its data: two reward terms, first 20 M steps."""
    figure = _figure(5.2, 3.2)
    axes = figure.add_subplot()
    columns: dict[str, list[Any]] = {name: [] for name in "term env_steps iqm low high".split()}
    for (column, label), color in zip(paper.GATE_TERMS.items(), (_COLORS["jrpo"], _COLORS["mappo"]), strict=True):
        steps, *estimate = band(records, column)
        kept = steps <= paper.GATE_STEPS
        steps, (middle, low, high) = steps[kept], (x[kept] for x in estimate)
        axes.fill_between(steps / 1e6, low, high, color=color, alpha=0.15, lw=0)
        axes.plot(steps / 1e6, middle, color=color, lw=1.5, label=label)
        for name, items in zip(columns, ([column] * len(steps), steps, middle, low, high), strict=True):
            columns[name].extend(items)
    _style_axes(axes, "Narrow Gate, MAPPO", "reward per step")
    axes.legend(frameon=False, fontsize=8)
    return _png(figure), columns
