"""A sweep's report beside reference values, such as a paper's, and with performance profiles.

`python -m lab.report FOLDER --reference results/paper/reference.yaml` writes FOLDER/report as `mqe
report` does, with the cells in the reference's order and its values as dashed lines in curves.png.
It adds reference.csv, the final values beside those of the reference, and profiles.png: the
fraction of runs above each score (Agarwal et al. 2021, arXiv 2108.13264).
"""

import argparse
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike

from mqe_jax.core.errors import InputError, one_line
from mqe_jax.core.files import write_atomically
from mqe_jax.core.literal import to_label
from mqe_jax.core.settings import FrozenMapping, build, load_yaml, settings_class
from mqe_jax.study import figures
from mqe_jax.study.estimates import (
    Array,
    Cells,
    Rows,
    estimate,
    final_rows,
    group,
    names,
    score_matrices,
)
from mqe_jax.study.report import write_report
from mqe_jax.study.runs import Cell, read_runs, table

DASHES: Any = (0, (4, 3))


@settings_class
class Reference:
    """Values that a report compares with, such as a paper's, and the titles and order of its
    cells.
    """

    label: str = "reference"
    """What the values are, in the legend of figures."""
    values: Mapping[str, Mapping[str, Mapping[str, float]]] = FrozenMapping()
    """Variant -> task -> algorithm -> average step reward."""
    variants: Mapping[str, str] = FrozenMapping()
    """Titles of variants, in their order; others follow."""
    tasks: Mapping[str, str] = FrozenMapping()
    """Titles of tasks, in their order; others follow."""
    algorithms: tuple[str, ...] = ()
    """Algorithms in their order; others follow."""

    def value(self, variant: str, task: str, algorithm: str) -> float | None:
        """Returns the reference value of a cell, or None."""
        return self.values.get(variant, {}).get(task, {}).get(algorithm)


def load_reference(path: Path) -> Reference:
    """Reads a YAML file with the fields of `Reference`; InputError naming the file, for invalid
    content.
    """
    try:
        return build(Reference, load_yaml(path))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def arrange(cells: Cells, reference: Reference) -> Cells:
    """Returns the cells in the reference's order of variants, tasks and algorithms; others
    follow.
    """
    orders = list(reference.variants), list(reference.tasks), list(reference.algorithms)

    def place(cell: Cell) -> list[tuple[int, str]]:
        named = cell.variant, cell.task, cell.algorithm
        return [(o.index(x) if x in o else len(o), x) for x, o in zip(named, orders, strict=True)]

    return {cell: cells[cell] for cell in sorted(cells, key=place)}


def compared_rows(cells: Cells, reference: Reference) -> Rows:
    """Returns the table of final values with a column for the reference's, NaN where it has
    none.
    """
    rows = final_rows(cells)
    for cell, row in zip(cells, rows, strict=True):
        value = reference.value(cell.variant, cell.task, cell.algorithm)
        row["reference"] = math.nan if value is None else value
    return rows


def draw_curves(cells: Cells, reference: Reference) -> bytes:
    """Returns the training curves with the reference's titles, and its values as dashed lines."""
    figure = figures.plot_curves(cells)
    tasks = names(cells, "task")
    algorithms = names(cells, "algorithm")
    for block, variant in zip(figure.subfigs, names(cells, "variant"), strict=True):
        block.suptitle(to_label(reference.variants.get(variant, variant)), fontsize=11)
        for axes, task in zip(block.axes, tasks, strict=False):
            axes.title.set_text(to_label(reference.tasks.get(task, task)))
            for algorithm, value in reference.values.get(variant, {}).get(task, {}).items():
                if algorithm in algorithms:
                    color = figures.COLORS.get(algorithm, figures.INK)
                    axes.axhline(value, color=color, lw=1.0, ls=DASHES, alpha=0.8)
    line = {"color": figures.INK, "ls": DASHES, "lw": 1.0, "label": to_label(reference.label)}
    dashed = [Line2D([], [], **line)] if reference.values else []
    figures.add_legend(figure, figures.label_colors(cells), *dashed)
    return figures.to_png(figure)


def performance_profile(scores: ArrayLike, thresholds: ArrayLike) -> Array:
    """Returns the fraction of scores above each threshold: (..., runs, tasks), (K,) -> (..., K)."""
    flat = np.asarray(scores, np.float64)
    flat = flat.reshape(*flat.shape[:-2], -1)
    return np.mean(flat[..., None, :] > np.asarray(thresholds, np.float64)[:, None], axis=-1)


def draw_profiles(cells: Cells) -> bytes:
    """Returns performance profiles of each variant: the fraction of runs above each score."""
    scores = {variant: score_matrices(cells, variant) for variant in names(cells, "variant")}
    scored = [variant for variant in scores if scores[variant]]
    algorithms = names(cells, "algorithm")
    thresholds = np.linspace(0.0, 1.0, 101)

    def profile(values: Array) -> Array:
        return performance_profile(values, thresholds)

    figure = figures.make_figure(max(5.0, 4.2 * len(scored)), 3.4)
    panels = figure.subplots(1, len(scored), squeeze=False)[0]
    for axes, variant in zip(panels, scored, strict=True):
        for name, values in scores[variant].items():
            color = figures.color_of(name, algorithms)
            figures.draw_interval(axes, thresholds, estimate(profile, values), color)
        figures.style_axes(axes, variant, "fraction of runs above")
        axes.set_xlabel("score, fraction of each task's range", fontsize=8)
        axes.set(xlim=(0, 1), ylim=(-0.02, 1.02))
    figures.add_legend(figure, figures.label_colors(cells))
    return figures.to_png(figure)


def report(folder: Path, reference: Reference) -> list[Path]:
    """Writes FOLDER/report from the finished runs of a sweep; returns the files.

    InputError without a finished run.
    """
    cells = arrange(group(read_runs(folder)), reference)
    target = folder / "report"
    files = write_report(cells, target)
    contents = {"curves.png": draw_curves(cells, reference)}
    contents["reference.csv"] = table(compared_rows(cells, reference)).encode()
    if any(score_matrices(cells, variant) for variant in names(cells, "variant")):
        contents["profiles.png"] = draw_profiles(cells)
    for name, content in contents.items():
        write_atomically(target / name, content)
    return list(dict.fromkeys([*files, *(target / name for name in contents)]))


def main() -> None:
    """Writes the report that the command line names."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="folder of the sweep")
    parser.add_argument("--reference", type=Path, help="YAML file of reference values")
    given = parser.parse_args()
    reference = Reference() if given.reference is None else load_reference(given.reference)
    for file in report(given.folder, reference):
        print(file)


if __name__ == "__main__":
    try:
        main()
    except (InputError, OSError) as error:
        raise SystemExit(f"error: {one_line(error)}") from None
