"""Draws the figure and fills the tables of docs/results/paper.md from published runs; called by tools/publish.py.

The text between `<!-- begin NAME -->` and `<!-- end NAME -->` is replaced; NAME is one of those in `sections`.
"""

import io
import math
import re
from collections.abc import Container, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from mqe_jax.core.errors import InputError
from mqe_jax.core.files import write_atomically
from mqe_jax.study.estimates import Cells, Rows, aggregate_tables, estimate, final_rows, group
from mqe_jax.study.figures import draw_curves
from mqe_jax.study.report import markdown
from mqe_jax.study.runs import Reference, Run, load_reference, table
from mqe_jax.study.statistics import interquartile_mean

PAPER, SCRATCH = "hierarchical", "scratch"
"""Variants: the paper's settings with the walk policy, and the same from scratch."""
MIN_SEEDS = 3
"""Seeds that a verdict requires: the interval of a single seed is a point."""


def update(runs: Sequence[Run], folder: Path, page: Path) -> None:
    """Writes the page's figure and tables, and every estimate into CSV files of FOLDER.

    FOLDER/reference.yaml has the paper's values.
    """
    reference = load_reference(folder / "reference.yaml")
    cells = group(runs, reference)
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
    Image.open(io.BytesIO(png)).convert("RGB").quantize(256, dither=Image.Dither.NONE).save(small, "png", optimize=True)
    return small.getvalue()


def filled(text: str, contents: Mapping[str, str]) -> str:
    """Returns the text of a page with its sections filled; InputError if the page lacks a section."""
    for name, body in contents.items():
        pattern = re.compile(rf"(<!-- begin {name} -->\n).*?(<!-- end {name} -->)", re.DOTALL)
        text, count = pattern.subn(lambda match, body=body: f"{match[1]}\n{body}\n\n{match[2]}", text)
        if count != 1:
            raise InputError(f"page: has {count} sections {name!r}; it must have one")
    return text


def estimated(cells: Cells, reference: Reference) -> Rows:
    """Returns final values of all cells: those of `final_rows`, success with mean actions, and the verdict."""
    rows = final_rows(cells, reference)
    for row, runs in zip(rows, cells.values(), strict=True):
        values = [(run.absolute or {"deterministic": {}})["deterministic"].get("success_rate") for run in runs]
        known = np.array(values, np.float64)[:, None]
        three = estimate(interquartile_mean, known) if np.isfinite(known).all() else (math.nan,) * 3
        row |= dict(zip(("mean", "mean_low", "mean_high"), map(float, three), strict=True))
        row["ours"] = verdict(row)
    return rows


def sections(estimates: Rows) -> dict[str, str]:
    """Returns the generated sections of the page by name: Markdown tables."""
    rewards, scratch = ([row for row in estimates if row["variant"] == name] for name in (PAPER, SCRATCH))
    solved = {row["task"] for row in rewards if row["mean_high"] > 0}
    names = {"task": "task", "algorithm": "algorithm", "training": "average step reward", "reference": "paper"}
    return {
        PAPER: pivot(rewards, {"training": "{}", "reference": "{}, paper"}),
        SCRATCH: markdown(scratch, names | {"ours": "ours is"}),
        "success": pivot([row for row in rewards if row["task"] in solved], {"success": "{}", "mean": "{}, mean"}),
    }


def pivot(rows: Rows, columns: Mapping[str, str]) -> str:
    """Returns a Markdown table with a line per task and `columns` of each algorithm: their headings, by its name."""
    heads = [
        head.format(name.upper())
        for name in dict.fromkeys(row["algorithm"] for row in rows)
        for head in columns.values()
    ]
    lines = [["task", *heads], ["---"] * (1 + len(heads))]
    for task in dict.fromkeys(row["task"] for row in rows):
        lines.append([task, *(cell(row, name) for row in rows if row["task"] == task for name in columns)])
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def cell(row: Mapping[str, Any], name: str) -> str:
    """Returns a value with its interval, success in %; bold is a reward whose interval is above the paper's value."""
    form = "{:.3g}" if name in ("training", "reference") else "{:.1%}"
    values = [form.format(row[key]).rstrip("%") for key in (name, f"{name}_low", f"{name}_high") if key in row]
    text = values[0] if len(values) == 1 else "{} [{}, {}]".format(*values)
    return f"**{text}**" if name == "training" and row["ours"] == "above" else text


def verdict(row: Mapping[str, Any]) -> str:
    """Returns where the reward and its interval lie relative to the paper's value; empty for too few seeds."""
    middle, low, high, value = row["training"], row["training_low"], row["training_high"], row["reference"]
    if row["seeds"] < MIN_SEEDS or not math.isfinite(value):
        return ""
    if middle > value:
        return "above" if low > value else "above, within the interval"
    return "below" if high < value else "below, within the interval"
