"""Draws the figure and fills the table of docs/results/paper.md from published runs; called by
`python -m lab.publish`.

The text between `<!-- begin NAME -->` and `<!-- end NAME -->` is replaced; NAME is one of those in
`sections`.
"""

import io
import math
import re
from collections.abc import Container, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from lab.report import Reference, arrange, compared_rows, draw_curves, load_reference
from mqe_jax.core.errors import InputError
from mqe_jax.core.files import write_atomically
from mqe_jax.study.estimates import Cells, Rows, aggregate_tables, estimate, group
from mqe_jax.study.runs import Run, table
from mqe_jax.study.statistics import interquartile_mean

PAPER = "hierarchical"
"""Variant: the paper's settings with the walk policy."""
MIN_SEEDS = 3
"""Seeds that a verdict requires: the interval of a single seed is a point."""


def update(runs: Sequence[Run], folder: Path, page: Path) -> None:
    """Writes the page's figure and tables, and every estimate into CSV files of FOLDER.

    FOLDER/reference.yaml has the paper's values.
    """
    reference = load_reference(folder / "reference.yaml")
    cells = arrange(group(runs), reference)
    drawn = of(cells, reference.values)
    figure = reduced(draw_curves(drawn, reference))
    if not (path := page.parent / "curves.png").is_file() or path.read_bytes() != figure:
        write_atomically(path, figure)
    estimates = estimated(cells, reference)
    for name, rows in {"estimates": estimates, **aggregate_tables(drawn)}.items():
        write_atomically(folder / f"{name}.csv", table(rows).encode())
    write_atomically(page, filled(page.read_text(encoding="utf-8"), sections(estimates)).encode())


def of(cells: Cells, variants: Container[str]) -> Cells:
    """Returns the cells of some variants."""
    return {cell: runs for cell, runs in cells.items() if cell.variant in variants}


def reduced(png: bytes) -> bytes:
    """Returns a PNG with a palette, a quarter of the size."""
    small = io.BytesIO()
    Image.open(io.BytesIO(png)).convert("RGB").quantize(256, dither=Image.Dither.NONE).save(
        small, "png", optimize=True
    )
    return small.getvalue()


def filled(text: str, contents: Mapping[str, str]) -> str:
    """Returns the text of a page with its sections filled; InputError if the page lacks a
    section.
    """
    for name, body in contents.items():
        pattern = re.compile(rf"(<!-- begin {name} -->\n).*?(<!-- end {name} -->)", re.DOTALL)
        text, count = pattern.subn(
            lambda match, body=body: f"{match[1]}\n{body}\n\n{match[2]}", text
        )
        if count != 1:
            raise InputError(f"page: has {count} sections {name!r}; it must have one")
    return text


def estimated(cells: Cells, reference: Reference) -> Rows:
    """Returns final values of all cells: those of `compared_rows`, success with mean actions, and
    the verdict.
    """
    rows = compared_rows(cells, reference)
    for row, runs in zip(rows, cells.values(), strict=True):
        values = [
            (run.absolute or {"deterministic": {}})["deterministic"].get("success_rate")
            for run in runs
        ]
        known = np.array(values, np.float64)[:, None]
        three = estimate(interquartile_mean, known) if np.isfinite(known).all() else (math.nan,) * 3
        row |= dict(zip(("mean", "mean_low", "mean_high"), map(float, three), strict=True))
        row["ours"] = verdict(row)
    return rows


def sections(estimates: Rows) -> dict[str, str]:
    """Returns the generated section of the page by name: a Markdown table of rewards, a line per
    task.

    Two columns per algorithm: ours with its interval, bold if it lies above the paper's value, and
    the paper's.
    """
    rows = [row for row in estimates if row["variant"] == PAPER]
    names = [name.upper() for name in dict.fromkeys(row["algorithm"] for row in rows)]
    heads = ["task", *(head for name in names for head in (name, f"{name}, paper"))]
    lines = [heads, ["---"] * len(heads)]
    for task in dict.fromkeys(row["task"] for row in rows):
        cells = [(ours(row), f"{row['reference']:.3g}") for row in rows if row["task"] == task]
        lines.append([task, *(text for pair in cells for text in pair)])
    return {PAPER: "\n".join("| " + " | ".join(line) + " |" for line in lines)}


def ours(row: Mapping[str, Any]) -> str:
    """Returns a reward with its interval, bold if that lies above the paper's value."""
    text = "{training:.3g} ({training_low:.3g} to {training_high:.3g})".format(**row)
    return f"**{text}**" if row["ours"] == "above" else text


def verdict(row: Mapping[str, Any]) -> str:
    """Returns where the reward and its interval lie relative to the paper's value; empty for too
    few seeds.
    """
    middle = row["training"]
    low = row["training_low"]
    high = row["training_high"]
    value = row["reference"]
    if row["seeds"] < MIN_SEEDS or not math.isfinite(value):
        return ""
    if middle > value:
        return "above" if low > value else "above, within the interval"
    return "below" if high < value else "below, within the interval"
