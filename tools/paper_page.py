"""Draws the figures and fills the tables of docs/results/paper.md from published runs; called by tools/publish.py.

The text between `<!-- begin NAME -->` and `<!-- end NAME -->` is replaced; NAME is one of those in `sections`.
"""

import io
import json
import math
import re
from collections.abc import Container, Mapping, Sequence
from pathlib import Path
from typing import Any

from PIL import Image

from mqe_jax.core.errors import InputError
from mqe_jax.core.files import write_atomically
from mqe_jax.study.estimates import Cells, aggregate_tables, evaluated, final_rows, group
from mqe_jax.study.figures import draw_curves, draw_evaluations, draw_profiles, draw_terms
from mqe_jax.study.report import markdown
from mqe_jax.study.runs import Cell, Reference, Run, load_reference

PAPER, SCRATCH, TUNED = "hierarchical", "scratch", "tuned"
"""Variants: the paper's settings with the walk policy, the same from scratch, and those of configs/tuned.yaml."""
SHAPED = (TUNED, "no-curriculum", "plain-network", "plain-curriculum", "shaped", "shaped-tuned", "unshaped")
"""The tuned settings and changes of them; their training rewards may include shaping."""
GATE_TERMS = {"reward/approach": "Distance to Target Reward", "reward/success": "Success Reward"}
"""Terms of the paper's appendix figure of Narrow Gate (MAPPO), by column; it ends at `GATE_STEPS`."""
GATE_STEPS = 20_000_000
MIN_SEEDS = 3
"""Seeds that a verdict requires: the interval of a single seed is a point."""


def update(runs: Sequence[Run], folder: Path, page: Path) -> None:
    """Writes the page's figures, and fills its tables, with the paper's values in FOLDER/reference.yaml."""
    reference = load_reference(folder / "reference.yaml")
    cells = group(runs, reference)
    for name, figure in figures(cells, reference).items():
        content = reduced(figure)
        if not (path := page.parent / name).is_file() or path.read_bytes() != content:
            write_atomically(path, content)
    text = filled(page.read_text(encoding="utf-8"), sections(cells, reference, folder))
    write_atomically(page, text.encode())


def of(cells: Cells, variants: Container[str]) -> Cells:
    """Returns the cells of some variants."""
    return {cell: runs for cell, runs in cells.items() if cell.variant in variants}


def figures(cells: Cells, reference: Reference) -> dict[str, bytes]:
    """Returns the page's figures as PNG, by file name: curves of the paper's variants, evaluations of `SHAPED`."""
    drawn, others = of(cells, reference.values), of(cells, SHAPED)
    return {
        "curves.png": draw_curves(drawn, reference),
        "evaluations.png": draw_evaluations(
            {cell: others[cell] for cell in evaluated(others)},
            reference,
            background={c: runs for c, runs in drawn.items() if (c.variant, c.algorithm) == (PAPER, "mappo")},
            background_label="MAPPO, paper's settings",
            best={task: max(values.values()) for task, values in reference.values[PAPER].items()},
            best_label="paper's best, after 40 M steps",
        ),
        "profiles.png": draw_profiles(drawn, reference),
        "gate_terms.png": draw_terms(
            cells[Cell("go1gate", "mappo", PAPER)], GATE_TERMS, "Narrow Gate, MAPPO", GATE_STEPS
        ),
    }


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


def sections(cells: Cells, reference: Reference, folder: Path) -> dict[str, str]:
    """Returns the generated sections of the page by name: Markdown tables."""
    fresh = json.loads((folder.parent / "measurements.json").read_text(encoding="utf-8"))["paper/fresh_episodes"]
    rows = final_rows(of(cells, (*reference.values, *SHAPED)), reference)
    for row in rows:
        task, variant = row["task"], row["variant"]
        best = max(reference.values[PAPER][task].values())
        row["paper"] = best if variant in SHAPED else reference.value(variant, task, row["algorithm"])
        row["ours"] = verdict(row, "training" if variant in reference.values else "absolute")
        seeds = sorted(fresh["tasks"][task].items()) if variant == TUNED else []
        row["fresh"] = ", ".join(f"{100 * seed['success_rate']:.1f}" for _, seed in seeds) + "%" * bool(seeds)
    cell = {"task": "task", "algorithm": "algorithm", "seeds": "seeds"}
    reward = {"training": "average step reward", "paper": "paper"}
    absolute = {"ours": "ours is", "absolute": "best checkpoint", "success": "success rate"}
    made = {
        **{v: markdown([r for r in rows if r["variant"] == v], cell | reward | absolute) for v in (PAPER, SCRATCH)},
        "aggregates": "\n\n".join(markdown(table) for table in aggregate_tables(of(cells, reference.values)).values()),
        TUNED: markdown(
            [row for row in rows if row["variant"] in SHAPED],
            cell
            | {"variant": "settings", "absolute": "best checkpoint", "paper": "paper's best", "ours": "ours is"}
            | {"success": "success rate", "fresh": "success rate, 512 fresh episodes"},
        ),
    }
    return {name: text.replace("| below", "| **below**") for name, text in made.items()}


def verdict(row: Mapping[str, Any], column: str) -> str:
    """Returns where a column's estimate and interval lie relative to the paper's value; empty for too few seeds."""
    middle, low, high, value = row[column], row[f"{column}_low"], row[f"{column}_high"], row["paper"]
    if row["seeds"] < MIN_SEEDS or not math.isfinite(middle):
        return ""
    if middle > value:
        return "above" if low > value else "above, within the interval"
    return "below" if high < value else "below, within the interval"
