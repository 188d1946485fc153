"""Figures of a study as PNG: learning curves, evaluations during training."""

import io
import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from mqe_jax.core.literal import to_label
from mqe_jax.study.estimates import Array, Cells, band, names, select_evaluated
from mqe_jax.study.runs import Cell, Run

INK = "#23252b"
_PALE = "#8a8f99"
COLORS = {"jrpo": "#4f86e0", "mappo": "#b5316f", "mat": "#3fae49"}
_OTHER_COLORS = ("#d98b1f", "#7a5bd0", "#2a9d9d", "#8a5a3b", INK)
_COLORS_OF_VARIANTS = (COLORS["mappo"], COLORS["jrpo"], COLORS["mat"], *_OTHER_COLORS)


def make_figure(width: float, height: float) -> Any:
    """Returns an empty figure, inches."""
    from matplotlib.figure import Figure

    return Figure((width, height), dpi=105, layout="constrained")


def to_png(figure: Any) -> bytes:
    """Returns a figure as PNG."""
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


def color_of(algorithm: str, algorithms: Sequence[str]) -> str:
    """Returns the colour of one of some algorithms."""
    others = [name for name in algorithms if name not in COLORS]
    return COLORS.get(algorithm) or _OTHER_COLORS[others.index(algorithm) % len(_OTHER_COLORS)]


def draw_curves(cells: Cells) -> bytes:
    """Returns the training curves: a block of tasks for each variant."""
    figure = plot_curves(cells)
    add_legend(figure, label_colors(cells))
    return to_png(figure)


def plot_curves(cells: Cells) -> Any:
    """Returns a figure of the training curves, without a legend.

    Its subfigures are the variants, the axes of each are the tasks; both are in the cells' order.
    """
    variants = names(cells, "variant")
    algorithms = names(cells, "algorithm")
    tasks = names(cells, "task")
    figure = make_figure(
        max(5.0, 3.7 * min(2, len(tasks)) * len(variants)), 2.5 * -(-len(tasks) // 2) + 0.9
    )
    blocks = figure.subfigures(1, len(variants), squeeze=False)[0]
    for block, variant in zip(blocks, variants, strict=True):
        for axes, task in _panels(block, tasks):
            for algorithm in algorithms:
                runs = cells.get(Cell(task, algorithm, variant))
                if runs is not None:
                    _draw_band(axes, runs, color_of(algorithm, algorithms), algorithm.upper())
            if not axes.lines:
                axes.text(
                    0.5, 0.6, "not trained", color=_PALE, ha="center", transform=axes.transAxes
                )
                axes.set_xticks([])
            style_axes(axes, task)
        block.suptitle(to_label(variant), color=INK, fontsize=11)
    return figure


def draw_evaluations(cells: Cells) -> bytes:
    """Returns a figure of the evaluations during training, a panel for each task.

    The evaluations are of the unmodified task with sampled actions. Every panel has its own legend.
    """
    tasks = names(cells, "task")
    chosen = select_evaluated(cells)
    figure = make_figure(max(5.0, 3.7 * min(2, len(tasks))), 2.7 * -(-len(tasks) // 2) + 0.6)
    for axes, task in _panels(figure, tasks):
        drawn = [cell for cell in chosen if cell.task == task]
        for cell, color in zip(drawn, itertools.cycle(_COLORS_OF_VARIANTS)):
            _draw_band(axes, chosen[cell], color, f"{cell.algorithm.upper()}, {cell.variant}")
        style_axes(axes, task)
        if drawn:
            bottom, top = axes.get_ylim()
            axes.set_ylim(bottom, top + 0.09 * len(drawn) * (top - bottom))  # room for the legend
            axes.legend(frameon=False, fontsize=6.5, loc="upper left")
    return to_png(figure)


def _draw_band(axes: Any, runs: Sequence[Run], color: str, label: str) -> None:
    steps, *values = band(runs)
    draw_interval(axes, steps / 1e6, values, color, label)


def draw_interval(
    axes: Any, x: Array, values: Sequence[Array], color: str, label: str = ""
) -> None:
    """Draws a line and its interval: `values` are middle, low and high, each of x's shape."""
    axes.fill_between(x, values[1], values[2], color=color, alpha=0.15, lw=0)
    axes.plot(x, values[0], color=color, lw=1.5, label=to_label(label))


def style_axes(axes: Any, title: str, ylabel: str = "average step reward") -> None:
    """Gives the axes of a curve their title, labels and grid."""
    axes.set_title(to_label(title), color=INK, fontsize=10, style="italic")
    axes.set_xlabel("environment steps (millions)", fontsize=8)
    axes.set_ylabel(ylabel, fontsize=8)
    axes.set_xlim(left=0)
    axes.tick_params(labelsize=7)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)


def label_colors(cells: Cells) -> dict[str, str]:
    """Returns the colours of the cells' algorithms by their labels."""
    algorithms = names(cells, "algorithm")
    return {name.upper(): color_of(name, algorithms) for name in algorithms}


def add_legend(figure: Any, colors: Mapping[str, str], *further: Any) -> None:
    """Adds a legend below the figure: colours by label, then further handles."""
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=color, label=to_label(label)) for label, color in colors.items()
    ]
    handles.extend(further)
    figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=min(4, len(handles)),
        frameon=False,
        fontsize=8,
    )
