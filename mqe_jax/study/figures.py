"""Figures of a study as PNG: learning curves, evaluations during training, profiles."""

import io
import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from mqe_jax.core.literal import to_label
from mqe_jax.study.estimates import (
    Array,
    Cells,
    band,
    estimate,
    names,
    score_matrices,
    select_evaluated,
)
from mqe_jax.study.runs import Cell, Reference, Run
from mqe_jax.study.statistics import performance_profile

_INK = "#23252b"
_PALE = "#8a8f99"
_COLORS = {"jrpo": "#4f86e0", "mappo": "#b5316f", "mat": "#3fae49"}
_OTHER_COLORS = ("#d98b1f", "#7a5bd0", "#2a9d9d", "#8a5a3b", _INK)
_DASHES = (0, (4, 3))
_COLORS_OF_VARIANTS = (_COLORS["mappo"], _COLORS["jrpo"], _COLORS["mat"], *_OTHER_COLORS)


def _figure(width: float, height: float) -> Any:
    from matplotlib.figure import Figure

    return Figure((width, height), dpi=105, layout="constrained")


def _png(figure: Any) -> bytes:
    content = io.BytesIO()
    figure.savefig(content, format="png")
    return content.getvalue()


def _panels(parent: Any, tasks: Sequence[str]) -> Iterator[tuple[Any, str]]:
    """Yields the axes of each task, two per row; the rest is hidden."""
    across = min(2, len(tasks))
    for axes, task in itertools.zip_longest(
        parent.subplots(-(-len(tasks) // 2), across, squeeze=False).ravel(), tasks
    ):
        if task is None:
            axes.set_axis_off()
        else:
            yield axes, task


def _color(algorithm: str, algorithms: Sequence[str]) -> str:
    others = [name for name in algorithms if name not in _COLORS]
    return _COLORS.get(algorithm) or _OTHER_COLORS[others.index(algorithm) % len(_OTHER_COLORS)]


def draw_curves(cells: Cells, reference: Reference) -> bytes:
    """Returns the training curves, a block of tasks for each variant; dashed lines are the
    reference's values.
    """
    variants = names(cells, "variant")
    algorithms = names(cells, "algorithm")
    tasks = names(cells, "task")
    figure = _figure(
        max(5.0, 3.7 * min(2, len(tasks)) * len(variants)), 2.5 * -(-len(tasks) // 2) + 0.9
    )
    blocks = figure.subfigures(1, len(variants), squeeze=False)[0]
    for block, variant in zip(blocks, variants, strict=True):
        for axes, task in _panels(block, tasks):
            for algorithm in algorithms:
                runs = cells.get(Cell(task, algorithm, variant))
                if runs is not None:
                    _draw_band(axes, runs, _color(algorithm, algorithms), algorithm.upper())
            if not axes.lines:
                axes.text(
                    0.5, 0.6, "not trained", color=_PALE, ha="center", transform=axes.transAxes
                )
                axes.set_xticks([])
            values = reference.values.get(variant, {}).get(task, {})
            _draw_values(axes, {name: x for name, x in values.items() if name in algorithms})
            _style_axes(axes, reference.tasks.get(task, task))
        block.suptitle(to_label(reference.variants.get(variant, variant)), color=_INK, fontsize=11)
    colors = {name.upper(): _color(name, algorithms) for name in algorithms}
    _key(figure, colors, reference.label if reference.values else None)
    return _png(figure)


def _draw_values(axes: Any, values: Mapping[str, float]) -> None:
    for name, value in values.items():
        axes.axhline(value, color=_COLORS.get(name, _INK), lw=1.0, ls=_DASHES, alpha=0.8)


def draw_evaluations(cells: Cells, reference: Reference) -> bytes:
    """Returns the evaluations during training, of the unmodified task with sampled actions: a panel
    for each task.

    Every panel has its own legend.
    """
    tasks = names(cells, "task")
    chosen = select_evaluated(cells)
    figure = _figure(max(5.0, 3.7 * min(2, len(tasks))), 2.7 * -(-len(tasks) // 2) + 0.6)
    for axes, task in _panels(figure, tasks):
        drawn = [cell for cell in chosen if cell.task == task]
        for cell, color in zip(drawn, itertools.cycle(_COLORS_OF_VARIANTS)):
            _draw_band(axes, chosen[cell], color, f"{cell.algorithm.upper()}, {cell.variant}")
        _style_axes(axes, reference.tasks.get(task, task))
        if drawn:
            bottom, top = axes.get_ylim()
            axes.set_ylim(bottom, top + 0.09 * len(drawn) * (top - bottom))  # room for the legend
            axes.legend(frameon=False, fontsize=6.5, loc="upper left")
    return _png(figure)


def _draw_band(axes: Any, runs: Sequence[Run], color: str, label: str) -> None:
    steps, *values = band(runs)
    _draw_interval(axes, steps / 1e6, values, color, label)


def _draw_interval(
    axes: Any, x: Array, values: Sequence[Array], color: str, label: str = ""
) -> None:
    """Draws a line and its interval: `values` are middle, low and high, each of x's shape."""
    axes.fill_between(x, values[1], values[2], color=color, alpha=0.15, lw=0)
    axes.plot(x, values[0], color=color, lw=1.5, label=to_label(label))


def _style_axes(axes: Any, title: str, ylabel: str = "average step reward") -> None:
    axes.set_title(to_label(title), color=_INK, fontsize=10, style="italic")
    axes.set_xlabel("environment steps (millions)", fontsize=8)
    axes.set_ylabel(ylabel, fontsize=8)
    axes.set_xlim(left=0)
    axes.tick_params(labelsize=7)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)


def _key(figure: Any, colors: Mapping[str, str], dashed: str | None) -> None:
    """Adds a legend below the figure: colours by label, and the label of dashed lines."""
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=color, label=to_label(label)) for label, color in colors.items()
    ]
    if dashed is not None:
        handles.append(Line2D([], [], color=_INK, ls=_DASHES, lw=1.0, label=to_label(dashed)))
    figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=min(4, len(handles)),
        frameon=False,
        fontsize=8,
    )


def draw_profiles(cells: Cells, reference: Reference) -> bytes:
    """Returns performance profiles of each variant: the fraction of runs above each score."""
    variants = [variant for variant in names(cells, "variant") if score_matrices(cells, variant)]
    algorithms = names(cells, "algorithm")
    thresholds = np.linspace(0.0, 1.0, 101)

    figure = _figure(max(5.0, 4.2 * len(variants)), 3.4)
    for axes, variant in zip(
        figure.subplots(1, len(variants), squeeze=False)[0], variants, strict=True
    ):
        for name, scores in score_matrices(cells, variant).items():
            values = estimate(lambda x: performance_profile(x, thresholds), scores)
            _draw_interval(axes, thresholds, values, _color(name, algorithms))
        _style_axes(axes, reference.variants.get(variant, variant), "fraction of runs above")
        axes.set_xlabel("score, fraction of each task's range", fontsize=8)
        axes.set(xlim=(0, 1), ylim=(-0.02, 1.02))
    _key(figure, {name.upper(): _color(name, algorithms) for name in algorithms}, None)
    return _png(figure)
