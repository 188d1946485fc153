"""The report of a sweep: figures, tables and aggregates with the paper's values, generated from raw data alone.

The output is deterministic: bootstrap intervals use a fixed seed, and figures contain no timestamp.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mqe_jax.files import write_atomically
from mqe_jax.study import paper
from mqe_jax.study.estimates import (
    LAST,
    Cells,
    aggregate_tables,
    comparison,
    curves_table,
    evaluated,
    final_table,
    group,
)
from mqe_jax.study.figures import draw_curves, draw_evaluations, draw_profiles, gate_terms
from mqe_jax.study.marl_eval import to_marl_eval
from mqe_jax.study.records import Cell, Record, number, read_records, table


def report(folder: Path) -> list[Path]:
    """Writes FOLDER/report from FOLDER/raw; returns the files.

    Raises:
        InputError: if the raw data are missing or damaged.
    """
    records = read_records(folder)
    cells = group(records)
    finals = final_table(cells)
    drawn, others = split(cells)
    files: dict[str, bytes] = {"curves.csv": curves_table(cells).encode(), "final.csv": table(finals).encode()}
    text = ["# Results", "", _EXPLANATION, *([_OTHER_SETTINGS] if others else []), "", markdown(finals), ""]
    if drawn:
        files["curves.png"] = draw_curves(drawn)
        text += ["![Learning curves](curves.png)", ""]
    if others:
        walking = {cell: runs for cell, runs in others.items() if not paper.from_scratch(cell.setting)}
        if walking:
            files["evaluations.png"] = draw_evaluations(cells, walking)
            text += ["![Evaluations during training](evaluations.png)", ""]
        versus = {name: finals[name] for name in ("task", "algorithm", "setting", "paper")} | comparison(finals)
        files["comparison.csv"] = table(versus).encode()
        text += ["## Against the paper", "", markdown(versus), ""]
    aggregates = aggregate_tables(drawn or cells)
    for name, columns in aggregates.items():
        files[f"{name}.csv"] = table(columns).encode()
        text += [f"## {_HEADINGS[name]}", "", markdown(columns), ""]
    if aggregates:
        files["profiles.png"] = draw_profiles(drawn or cells)
        text += ["![Performance profiles](profiles.png)", ""]
    gate = cells.get(Cell("go1gate", "mappo"))
    if gate is not None and all(any(name in run.curve for run in gate) for name in paper.GATE_TERMS):
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


def split(cells: Cells) -> tuple[Cells, Cells]:
    """Returns the cells drawn by their training curves, and those drawn by their evaluations.

    The latter have a setting that the paper does not have, such as tuned, whose training may include shaping.
    """
    others = {cell: records for cell, records in cells.items() if cell.setting not in paper.SETTINGS}
    others = {cell: others[cell] for cell in evaluated(others)}
    return {cell: records for cell, records in cells.items() if cell not in others}, others


_EXPLANATION = f"""Each value is the interquartile mean over seeds with its 95% stratified bootstrap interval.
`training`: average step reward over the last {LAST:.0%} of training steps, as in the paper's figure. `absolute`:
average step reward of the best checkpoint over the final evaluation's episodes, actions sampled; `success` likewise.
`paper`: read from the paper's figure after 40 M steps."""
_OTHER_SETTINGS = """In other settings `paper` is the best value of the task (`scratch-...`: from scratch). Their
training rewards may include shaping, so that figure and comparison use evaluations of the unmodified task."""
_HEADINGS = {
    "aggregate": "Over all tasks, as fractions of each task's range of scores",
    "improvement": "Probability of improvement of the first algorithm over the second",
}


def _flat(record: Record) -> dict[str, Any]:
    cell = record.cell
    task = cell.task if cell.setting == paper.HIERARCHICAL else f"{cell.task}+{cell.setting}"
    return {"task": task, "algorithm": cell.algorithm, "seed": record.seed, **record.evaluation}


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
