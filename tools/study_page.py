"""Fills the tables and copies the figures of the page about the paper's result, from committed raw data alone.

The text between `<!-- begin NAME -->` and `<!-- end NAME -->` of docs/results/paper.md is replaced; NAME is one of
`SECTIONS`. Called by tools/publish_sweep.py.
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
from mqe_jax.study import paper
from mqe_jax.study.estimates import (
    ABOUT_BELOW,
    ABOVE,
    BELOW,
    TUNED,
    Cells,
    aggregate_tables,
    comparison,
    final_reward,
    final_table,
    group,
)
from mqe_jax.study.records import Cell, read_records
from mqe_jax.study.report import markdown, report, split
from mqe_jax.study.sweep import load_sweep, select

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "results" / "paper"
FRESH = "fresh_episodes.json"
"""File of a results folder: task -> seed -> success rate and reward of the tuned policies over 512 fresh episodes."""
PAGE = ROOT / "docs" / "results" / "paper.md"

Columns = Mapping[str, Sequence[Any]]


def update(results: Path, page: Path) -> None:
    """Writes the report of a folder, and its figures and tables to a page.

    Raises:
        InputError: if raw data are missing or damaged, or the page lacks a section.
    """
    for file in report(results):
        if file.suffix == ".png":
            write_atomically(page.parent / file.name, file.read_bytes())
    text = page.read_text(encoding="utf-8")
    write_atomically(page, filled(text, results).encode())


def filled(text: str, results: Path) -> str:
    """Returns the text of a page with all its sections filled.

    Raises:
        InputError: if raw data are missing or damaged, or the page lacks a section.
    """
    cells = group(read_records(results))
    finals = final_table(cells)
    columns = {**finals, **comparison(finals)}
    for name, content in SECTIONS.items():
        pattern = re.compile(rf"(<!-- begin {name} -->\n).*?(<!-- end {name} -->)", re.DOTALL)
        body = content(columns, cells, results)
        text, count = pattern.subn(lambda match, body=body: f"{match[1]}\n{body}\n\n{match[2]}", text)
        if count != 1:
            raise InputError(f"page: has {count} sections {name!r}; it must have one")
    return text


def planned(results: Path) -> dict[Cell, set[int]]:
    """Returns the seeds of each cell that the sweep files of a folder train."""
    cells: dict[Cell, set[int]] = {}
    for path in sorted(results.glob("*.yaml")):
        sweep = load_sweep(path)
        for cell in select(sweep):
            cells.setdefault(cell, set()).update(sweep.seeds)
    return cells


def _rows(columns: Columns, wanted: Callable[[dict[str, Any]], bool]) -> list[dict[str, Any]]:
    rows = [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]
    return [row for row in rows if wanted(row)]


def _table(rows: Sequence[dict[str, Any]], names: Mapping[str, str]) -> str:
    """Returns rows as a Markdown table of the columns `names`, with these headings."""
    if not rows:
        return "No runs yet."
    lines = [list(names.values()), ["---"] * len(names), *([_shown(row, name) for name in names] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _shown(row: Mapping[str, Any], name: str) -> str:
    """Returns an entry of a table: numbers with their intervals, success rates as percentages, `below` in bold."""
    value = row[name]
    if name == "task":
        return f"`{value}`"
    if name == "algorithm":
        return paper.ALGORITHMS.get(value, value)
    if name == "ours" and value in (BELOW, ABOUT_BELOW):
        return f"**{value}**"
    if isinstance(value, str):
        return value
    if not math.isfinite(value):
        return ""
    if f"{name}_low" not in row:
        return f"{value:.3g}"
    ends = row[f"{name}_low"], row[f"{name}_high"]
    if name == "success":
        return f"{value:.1%} [{ends[0]:.1%}, {ends[1]:.1%}]"
    return f"{value:.3g} [{ends[0]:.3g}, {ends[1]:.3g}]"


_PAPERS = {
    "task": "task",
    "algorithm": "algorithm",
    "seeds": "seeds",
    "training": "average step reward",
    "paper": "paper",
    "ours": "ours is",
    "absolute": "best checkpoint",
    "success": "success rate",
}
_BEHIND = {
    "task": "task",
    "algorithm": "algorithm",
    "setting": "setting",
    "training": "average step reward",
    "mean": "mean",
    "paper": "paper",
}
_OTHERS = {
    "task": "task",
    "setting": "setting",
    "algorithm": "algorithm",
    "seeds": "seeds",
    "absolute": "best checkpoint",
    "paper": "paper's best",
    "exceeds": "lower end above",
    "success": "success rate",
}


def _state(columns: Columns, cells: Cells, results: Path) -> str:
    """Returns the numbers of finished runs, and the list of those still to be trained."""
    plan = planned(results)
    done = {cell: {record.seed for record in records} for cell, records in cells.items()}
    left = {cell: sorted(seeds - done.get(cell, set())) for cell, seeds in plan.items()}
    left = {cell: seeds for cell, seeds in left.items() if seeds}
    total = sum(map(len, plan.values()))
    text = f"{total - sum(map(len, left.values()))} of {total} planned runs are finished."
    if not left:
        return text
    lines = []
    for setting in dict.fromkeys(cell.setting for cell in left):
        names = []
        for cell, seeds in left.items():
            if cell.setting == setting:
                part = "" if len(seeds) == len(plan[cell]) else f" (seeds {', '.join(map(str, seeds))})"
                names.append(f"`{cell.task}` {paper.ALGORITHMS.get(cell.algorithm, cell.algorithm)}{part}")
        lines.append(f"- {setting}: {', '.join(names)}")
    return "\n".join([f"{text} Still to be trained:", "", *lines])


def _behind(columns: Columns, cells: Cells, results: Path) -> str:
    """Returns the table of the cells below the paper's values, with the ablations of the paper's settings in each.

    An ablation's sweep file has no `config`: its training rewards are those of the unmodified task. From scratch the
    rows are those of MAPPO, with which all tasks were trained, and other algorithms count as ablations.
    """
    sweeps = [load_sweep(path) for path in sorted(results.glob("*.yaml"))]
    plain = {cell for sweep in sweeps if sweep.config is None for cell in select(sweep)}
    rows = _rows(columns, lambda row: _cell(row) in plain)
    shown: list[dict[str, Any]] = []
    for row in rows:
        if row["ours"] not in (BELOW, ABOUT_BELOW) or row["setting"] not in paper.SETTINGS:
            continue
        if row["setting"] == paper.SCRATCH and row["algorithm"] != "mappo":
            continue
        values = [f"{_name(other, row)} {_shown(other, 'training')}" for other in rows if _is_ablation(other, row)]
        mean = np.mean([final_reward(record) for record in cells[_cell(row)]])
        shown.append({**row, "mean": float(mean), "ablations": "; ".join(values)})
    if not shown:
        return "No finished cell is below the paper's value."
    return _table(shown, {**_BEHIND, "ablations": "with a change"})


def _cell(row: Mapping[str, Any]) -> Cell:
    return Cell(row["task"], row["algorithm"], row["setting"])


def _is_ablation(other: Mapping[str, Any], row: Mapping[str, Any]) -> bool:
    """Whether a row is a cell with a change of another row's settings, or of its algorithm from scratch."""
    if other["task"] != row["task"]:
        return False
    if other["algorithm"] != row["algorithm"]:
        return other["setting"] == row["setting"] == paper.SCRATCH
    changed = other["setting"] not in paper.SETTINGS
    return changed and paper.from_scratch(other["setting"]) == paper.from_scratch(row["setting"])


def _name(other: Mapping[str, Any], row: Mapping[str, Any]) -> str:
    """Returns how an ablation differs from a row: in its setting, or in its algorithm."""
    return other["setting"] if other["setting"] != row["setting"] else paper.ALGORITHMS[other["algorithm"]]


def _of(setting: str) -> Callable[[Columns, Cells, Path], str]:
    return lambda columns, cells, results: _table(_rows(columns, lambda row: row["setting"] == setting), _PAPERS)


def _versus_best(columns: Columns, wanted: Callable[[str], bool], names: Mapping[str, str] = _OTHERS) -> str:
    rows = _rows(columns, lambda row: wanted(row["setting"]))
    return _table(
        [{**row, "exceeds": "yes" if row["ours"] == ABOVE else "no" if row["ours"] else ""} for row in rows], names
    )


def _tuned(columns: Columns, cells: Cells, results: Path) -> str:
    """Returns the table of the tuned settings, with the success rates of each seed over fresh episodes."""
    fresh = json.loads((results / FRESH).read_text(encoding="utf-8"))["tasks"]
    shown = [
        ", ".join(f"{100 * seed['success_rate']:.1f}" for _, seed in sorted(fresh[task].items())) + "%"
        if setting == TUNED
        else ""
        for task, setting in zip(columns["task"], columns["setting"], strict=True)
    ]
    names = {**_OTHERS, "fresh": "success rate, 512 fresh episodes"}
    return _versus_best({**columns, "fresh": shown}, lambda setting: setting == TUNED, names)


def _ablations(columns: Columns, cells: Cells, results: Path) -> str:
    return _versus_best(columns, lambda setting: setting != TUNED and setting not in paper.SETTINGS)


def _commands(columns: Columns, cells: Cells, results: Path) -> str:
    """Returns the command that trains each cell, by sweep file."""
    lines = ["```bash"]
    for path in sorted(results.glob("*.yaml")):
        file = f"results/paper/{path.name}"
        lines += [f"mqe sweep {file} --cells {cell.path.as_posix()}" for cell in select(load_sweep(path))]
    return "\n".join([*lines, "```"])


def _aggregates(columns: Columns, cells: Cells, results: Path) -> str:
    tables = [markdown(table) for table in aggregate_tables(split(cells)[0]).values()]
    return "\n\n".join(tables) or "No two algorithms have finished the same task yet."


SECTIONS: Mapping[str, Callable[[Columns, Cells, Path], str]] = {
    "state": _state,
    paper.HIERARCHICAL: _of(paper.HIERARCHICAL),
    "below": _behind,
    "aggregates": _aggregates,
    paper.SCRATCH: _of(paper.SCRATCH),
    TUNED: _tuned,
    "ablations": _ablations,
    "commands": _commands,
}
"""Generated sections of the page by name."""
