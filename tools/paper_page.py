"""Draws the figures and fills the tables of docs/results/paper.md from published runs; called by tools/publish.py.

The text between `<!-- begin NAME -->` and `<!-- end NAME -->` is replaced; NAME is one of `SECTIONS`.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mqe_jax.errors import InputError
from mqe_jax.files import write_atomically
from mqe_jax.study.estimates import Cells, aggregate_tables, evaluated, final_reward, final_table, group
from mqe_jax.study.figures import draw_curves, draw_evaluations, draw_profiles, draw_terms
from mqe_jax.study.reference import Reference, load_reference
from mqe_jax.study.report import markdown
from mqe_jax.study.runs import Cell, Run

PAPER, SCRATCH, TUNED = "hierarchical", "scratch", "tuned"
"""Variants: the paper's settings with the walk policy, the same from scratch, and those of configs/tuned."""
GATE_TERMS = {"reward/approach": "Distance to Target Reward", "reward/success": "Success Reward"}
"""Terms of the paper's appendix figure of Narrow Gate (MAPPO), by column; it ends at `GATE_STEPS`."""
GATE_STEPS = 20_000_000
SHAPED = (TUNED, "no-curriculum", "plain-network", "plain-curriculum", "shaped", "shaped-tuned", "unshaped")
"""The tuned settings and changes of them; their training rewards may include shaping."""
MIN_SEEDS = 3
"""Seeds that a verdict requires: the interval of a single seed is a point."""

Rows = list[dict[str, Any]]


class Study:
    """Published runs with the paper's values: cells, and a row of numbers for each."""

    reference: Reference
    """The paper's values."""
    measurements: Mapping[str, Any]
    """Measurements beside the runs, by name."""
    cells: Cells
    """All runs by cell, in the paper's order."""
    drawn: Cells
    """Cells of the paper's variants, drawn by their training curves."""
    others: Cells
    """The other cells, drawn by their evaluations."""
    rows: Rows
    """Columns of `final_table` and `paper`, `ours` (see `verdict`) for each cell."""

    def __init__(self, runs: Sequence[Run], folder: Path) -> None:
        self.reference = load_reference(folder / "reference.yaml")
        self.measurements = json.loads((folder.parent / "measurements.json").read_text(encoding="utf-8"))
        self.cells = group(runs, self.reference)
        self.drawn = {cell: own for cell, own in self.cells.items() if cell.variant in self.reference.values}
        self.others = {cell: own for cell, own in self.cells.items() if cell not in self.drawn}
        columns = final_table(self.cells, self.reference)
        self.rows = [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]
        for row in self.rows:
            row["paper"] = self.value(row)
            row["ours"] = verdict(row, "training" if row["variant"] in self.reference.values else "absolute")

    def best(self, task: str) -> float:
        """Returns the paper's best value of a task with the walk policy."""
        return max(self.reference.values[PAPER][task].values())

    def value(self, row: Mapping[str, Any]) -> float:
        """Returns the paper's value of a cell; of its variants from scratch that from scratch, of others the best."""
        variant = SCRATCH if from_scratch(row["variant"]) else row["variant"]
        value = self.reference.value(variant, row["task"], row["algorithm"])
        return self.best(row["task"]) if value is None else value


def from_scratch(variant: str) -> bool:
    """Returns whether a variant trains without the walk policy."""
    return variant.partition("-")[0] == SCRATCH


def verdict(row: Mapping[str, Any], column: str) -> str:
    """Returns where a column's estimate and interval lie relative to the paper's value; empty for too few seeds."""
    middle, low, high, value = row[column], row[f"{column}_low"], row[f"{column}_high"], row["paper"]
    if row["seeds"] < MIN_SEEDS or not math.isfinite(middle):
        return ""
    if middle > value:
        return "above" if low > value else "above, within the interval"
    return "below" if high < value else "below, within the interval"


def update(runs: Sequence[Run], folder: Path, page: Path) -> None:
    """Writes the page's figures, and fills its tables.

    Raises:
        InputError: if the page lacks a section.
    """
    study = Study(runs, folder)
    for name, content in figures(study).items():
        if not (path := page.parent / name).is_file() or path.read_bytes() != content:
            write_atomically(path, content)
    write_atomically(page, filled(page.read_text(encoding="utf-8"), study).encode())


def figures(study: Study) -> dict[str, bytes]:
    """Returns the page's figures as PNG, by file name."""
    walking = {cell: runs for cell, runs in study.others.items() if not from_scratch(cell.variant)}
    plain = {cell: runs for cell, runs in study.drawn.items() if cell.variant == PAPER and cell.algorithm == "mappo"}
    gate = study.cells[Cell("go1gate", "mappo", PAPER)]
    return {
        "curves.png": draw_curves(study.drawn, study.reference),
        "evaluations.png": draw_evaluations(
            {cell: walking[cell] for cell in evaluated(walking)},
            study.reference,
            background=plain,
            background_label="MAPPO, paper's settings",
            best={task: study.best(task) for task in study.reference.tasks},
            best_label="paper's best, after 40 M steps",
        ),
        "profiles.png": draw_profiles(study.drawn, study.reference),
        "gate_terms.png": draw_terms(gate, GATE_TERMS, "Narrow Gate, MAPPO", GATE_STEPS),
    }


def filled(text: str, study: Study) -> str:
    """Returns the text of a page with all its sections filled.

    Raises:
        InputError: if the page lacks a section.
    """
    for name, content in SECTIONS.items():
        pattern = re.compile(rf"(<!-- begin {name} -->\n).*?(<!-- end {name} -->)", re.DOTALL)
        body = content(study)
        text, count = pattern.subn(lambda match, body=body: f"{match[1]}\n{body}\n\n{match[2]}", text)
        if count != 1:
            raise InputError(f"page: has {count} sections {name!r}; it must have one")
    return text


def _table(rows: Rows, names: Mapping[str, str]) -> str:
    """Returns rows as a Markdown table of the columns `names`, with these headings."""
    lines = [list(names.values()), ["---"] * len(names), *([_shown(row, name) for name in names] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _shown(row: Mapping[str, Any], name: str) -> str:
    """Returns an entry of a table: numbers with their intervals, success rates as percentages, `below` in bold."""
    value = row[name]
    if name == "task":
        return f"`{value}`"
    if name == "algorithm":
        return value.upper()
    if isinstance(value, str):
        return f"**{value}**" if name == "ours" and value.startswith("below") else value
    if not math.isfinite(value):
        return ""
    if f"{name}_low" not in row:
        return f"{value:.3g}"
    ends = row[f"{name}_low"], row[f"{name}_high"]
    if name == "success":
        return f"{value:.1%} [{ends[0]:.1%}, {ends[1]:.1%}]"
    return f"{value:.3g} [{ends[0]:.3g}, {ends[1]:.3g}]"


_CELL = {"task": "task", "algorithm": "algorithm"}
_BEST = {"absolute": "best checkpoint", "success": "success rate"}


def _of(variant: str) -> Callable[[Study], str]:
    names = {**_CELL, "seeds": "seeds", "training": "average step reward", "paper": "paper", "ours": "ours is", **_BEST}
    return lambda study: _table([row for row in study.rows if row["variant"] == variant], names)


def _below(study: Study) -> str:
    """Returns the table of the cells below the paper's values, with the ablations of the paper's settings in each.

    From scratch the rows are those of MAPPO, with which all tasks were trained; other algorithms count as ablations.
    """
    shown: Rows = []
    for row in study.rows:
        variant, algorithm = row["variant"], row["algorithm"]
        if not row["ours"].startswith("below") or variant not in study.reference.values:
            continue
        if variant == SCRATCH and algorithm != "mappo":
            continue
        changes = []
        for other in study.rows:
            if other["task"] != row["task"] or other["variant"] in SHAPED:
                continue
            if other["algorithm"] != algorithm:
                if other["variant"] == variant == SCRATCH:
                    changes.append(f"{other['algorithm'].upper()} {_shown(other, 'training')}")
            elif other["variant"] not in study.reference.values:
                if from_scratch(other["variant"]) == from_scratch(variant):
                    changes.append(f"{other['variant']} {_shown(other, 'training')}")
        runs = study.cells[Cell(row["task"], algorithm, variant)]
        mean = float(np.mean([final_reward(run) for run in runs]))
        shown.append({**row, "mean": mean, "changes": "; ".join(changes)})
    names = {**_CELL, "variant": "variant", "training": "average step reward", "mean": "mean", "paper": "paper"}
    return _table(shown, {**names, "changes": "with a change"})


def _aggregates(study: Study) -> str:
    return "\n\n".join(markdown(table) for table in aggregate_tables(study.drawn).values())


_TUNED = {"task": "task", "variant": "variant", "algorithm": "algorithm", "seeds": "seeds"}
_TUNED |= {"absolute": "best checkpoint", "paper": "paper's best", "exceeds": "lower end above"}
_TUNED |= {"success": "success rate", "fresh": "success rate, 512 fresh episodes"}


def _tuned(study: Study) -> str:
    """Returns the table of the tuned settings and of changes of them; with success rates over fresh episodes."""
    fresh = study.measurements["paper/fresh_episodes"]["tasks"]
    rows = [{**row, "fresh": ""} for row in study.rows if row["variant"] in SHAPED]
    for row in rows:
        row["exceeds"] = "yes" if row["ours"] == "above" else "no" if row["ours"] else ""
        if row["variant"] == TUNED:
            seeds = [f"{100 * seed['success_rate']:.1f}" for _, seed in sorted(fresh[row["task"]].items())]
            row["fresh"] = ", ".join(seeds) + "%"
    return _table(rows, _TUNED)


SECTIONS: Mapping[str, Callable[[Study], str]] = {
    PAPER: _of(PAPER),
    "below": _below,
    "aggregates": _aggregates,
    SCRATCH: _of(SCRATCH),
    TUNED: _tuned,
}
"""Generated sections of the page by name."""
