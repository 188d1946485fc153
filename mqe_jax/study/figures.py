"""Figures of a study as PNG: learning curves in the paper's layout, evaluations, profiles, two reward terms."""

from __future__ import annotations

import io
import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mqe_jax.study import paper, statistics
from mqe_jax.study.estimates import REWARD, TUNED, Array, Cells, band, evaluated, score_matrices
from mqe_jax.study.records import Cell, Record

_INK, _PALE = "#23252b", "#8a8f99"
_COLORS = {"jrpo": "#4f86e0", "mat": "#3fae49", "mappo": "#b5316f"}
_OTHER_COLORS = ("#d98b1f", "#7a5bd0", "#2a9d9d", "#8a5a3b", _INK)
_DASHES = (0, (4, 3))
_COLORS_OF_SETTINGS = (_COLORS["mappo"], _COLORS["jrpo"], _COLORS["mat"], *_OTHER_COLORS)
_LINES = (*_COLORS_OF_SETTINGS, _PALE, "#ffffff")
"""Colours that a PNG has exactly."""
_SHADES = 64
"""Maximum number of further colours of a PNG: with these it has a quarter of its size."""
_NEAR = 8
"""Difference to an exact colour, of 255, up to which Pillow could take a further one in its place."""


def _figure(width: float, height: float) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure((width, height), dpi=105, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _png(figure: Any) -> bytes:
    from PIL import Image, ImageColor

    content, small = io.BytesIO(), io.BytesIO()
    figure.savefig(content, format="png")
    image = Image.open(content).convert("RGB")
    lines = np.array([ImageColor.getrgb(color) for color in _LINES])
    shades = np.array(image.quantize(_SHADES, dither=Image.Dither.NONE).getpalette())[: 3 * _SHADES].reshape(-1, 3)
    distances = np.abs(shades[:, None] - lines).max(axis=-1).min(axis=-1)
    palette = Image.new("P", (1, 1))
    palette.putpalette([*lines.ravel(), *shades[distances > _NEAR].ravel()])
    image.quantize(palette=palette, dither=Image.Dither.NONE).save(small, format="png", optimize=True)
    return small.getvalue()


def _color(algorithm: str, algorithms: Sequence[str]) -> str:
    others = [name for name in algorithms if name not in _COLORS]
    return _COLORS.get(algorithm) or _OTHER_COLORS[others.index(algorithm) % len(_OTHER_COLORS)]


def _label(algorithm: str) -> str:
    return paper.ALGORITHMS.get(algorithm, algorithm.upper())


def draw_curves(cells: Cells) -> bytes:
    """Returns the paper's figure as PNG: for each setting a block of tasks, two per row, with bands over seeds.

    Dashed lines are the paper's final values, in the algorithm's colour.
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
                    _draw_band(axes, records, REWARD, _color(algorithm, algorithms), _label(algorithm))
            if not axes.lines:
                axes.text(0.5, 0.6, "not trained", color=_PALE, ha="center", transform=axes.transAxes)
                axes.set_xticks([])
            values = paper.VALUES.get(setting, {}).get(task, {})
            _draw_values(axes, {name: x for name, x in values.items() if name in algorithms})
            _style_axes(axes, paper.TITLES.get(task, task))
        block.suptitle(paper.SETTINGS.get(setting, setting), color=_INK, fontsize=11)
    _legend(figure, algorithms, paper_line=True)
    return _png(figure)


def _draw_values(axes: Any, values: Mapping[str, float]) -> None:
    """Draws dashed lines at the paper's values by algorithm or `best`; where several coincide, dashes alternate."""
    for name, value in values.items():
        same = [other for other in values if values[other] == value]
        dashes = (_DASHES[1][0], _DASHES[1][1] + (len(same) - 1) * sum(_DASHES[1]))
        offset = -same.index(name) * sum(_DASHES[1])
        axes.axhline(value, color=_COLORS.get(name, _INK), lw=1.0, ls=(offset, dashes), alpha=0.8)


def draw_evaluations(cells: Cells, others: Cells) -> bytes:
    """Returns the evaluations during training as PNG: cells of `others`, a panel for each of their tasks.

    Evaluations are of the unmodified task, actions sampled. Every panel has a legend of its own. Pale lines are
    MAPPO's of `cells` with the paper's settings; dashed lines are the paper's best value of the task.
    """
    tasks = list(dict.fromkeys(cell.task for cell in cells if any(other.task == cell.task for other in others)))
    across = min(2, len(tasks))
    rows = -(-len(tasks) // across)
    figure = _figure(max(5.0, 3.7 * across), 2.7 * rows + 0.6)
    plain = evaluated({cell: runs for cell, runs in cells.items() if cell.setting == paper.HIERARCHICAL})
    chosen, reference = evaluated(others), False
    for axes, task in itertools.zip_longest(figure.subplots(rows, across, squeeze=False).ravel(), tasks):
        if task is None:
            axes.set_axis_off()
            continue
        runs = plain.get(Cell(task, "mappo"))
        if runs is not None:
            _draw_band(axes, runs, REWARD, _PALE, "")
            reference = True
        drawn = sorted((cell for cell in chosen if cell.task == task), key=lambda cell: cell.setting != TUNED)
        for cell, color in zip(drawn, itertools.cycle(_COLORS_OF_SETTINGS)):
            _draw_band(axes, chosen[cell], REWARD, color, f"{_label(cell.algorithm)}, {cell.setting}")
        value = paper.best(task)
        if value is not None:
            _draw_values(axes, {"best": value})
        _style_axes(axes, paper.TITLES.get(task, task))
        if drawn:
            bottom, top = axes.get_ylim()
            axes.set_ylim(bottom, top + 0.09 * len(drawn) * (top - bottom))  # room for the legend
            axes.legend(frameon=False, fontsize=6.5, loc="upper left")
    _key(figure, {"MAPPO, paper's settings": _PALE} if reference else {}, "paper's best, after 40 M steps")
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
    colors = {_label(name): _color(name, algorithms) for name in algorithms}
    _key(figure, colors, "paper, after 40 M steps" if paper_line else None)


def _key(figure: Any, colors: Mapping[str, str], dashed: str | None) -> None:
    """Adds a legend below the figure: colours by label, and the label of dashed lines."""
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], color=color, label=label) for label, color in colors.items()]
    if dashed is not None:
        handles.append(Line2D([], [], color=_INK, ls=_DASHES, lw=1.0, label=dashed))
    figure.legend(handles=handles, loc="outside lower center", ncols=min(4, len(handles)), frameon=False, fontsize=8)


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
        _style_axes(axes, paper.SETTINGS.get(setting, setting), "fraction of runs above")
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
