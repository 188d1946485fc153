"""The report of a sweep: figures, tables and aggregates over seeds, generated from its finished runs alone.

The output is deterministic: bootstrap intervals use a fixed seed, and figures contain no timestamp.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mqe_jax.files import write_atomically
from mqe_jax.study.estimates import LAST, aggregate_tables, curves_table, evaluated, final_table, group
from mqe_jax.study.figures import draw_curves, draw_evaluations, draw_profiles
from mqe_jax.study.marl_eval import to_marl_eval
from mqe_jax.study.reference import Reference
from mqe_jax.study.runs import Run, number, read_runs, table


def report(folder: Path, reference: Reference | None = None) -> list[Path]:
    """Writes FOLDER/report from the finished runs of a sweep; returns the files.

    Raises:
        InputError: if no run is finished, or a file of one is damaged.
    """
    return write_report(read_runs(folder), folder / "report", reference or Reference())


def write_report(runs: Sequence[Run], target: Path, reference: Reference) -> list[Path]:
    """Writes the report of runs into a folder; returns the files."""
    cells = group(runs, reference)
    finals = final_table(cells, reference)
    files: dict[str, bytes] = {
        "curves.csv": curves_table(cells).encode(),
        "final.csv": table(finals).encode(),
        "curves.png": draw_curves(cells, reference),
    }
    text = ["# Results", "", _EXPLANATION, *([f"`reference`: {reference.label}."] if reference.values else []), ""]
    text += [markdown(finals), "", "![Training curves](curves.png)", ""]
    if with_evaluations := evaluated(cells):
        files["evaluations.png"] = draw_evaluations({cell: cells[cell] for cell in with_evaluations}, reference)
        text += ["![Evaluations during training](evaluations.png)", ""]
    aggregates = aggregate_tables(cells)
    for name, columns in aggregates.items():
        files[f"{name}.csv"] = table(columns).encode()
        text += [f"## {_HEADINGS[name]}", "", markdown(columns), ""]
    if aggregates:
        files["profiles.png"] = draw_profiles(cells, reference)
        text += ["![Performance profiles](profiles.png)", ""]
    if any(run.absolute is not None for run in runs):
        files["marl_eval.json"] = (json.dumps(to_marl_eval(runs), indent=1) + "\n").encode()
    files["report.md"] = "\n".join(text).encode()
    target.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        write_atomically(target / name, content)
    return [target / name for name in files]


_EXPLANATION = f"""Each value is the interquartile mean over seeds with its 95% stratified bootstrap interval.
`training`: average step reward over the last {LAST:.0%} of training steps; it includes shaping rewards of the settings.
`absolute`: average step reward of the unmodified task with the best checkpoint over the final evaluation's episodes,
actions sampled; `success` likewise."""
_HEADINGS = {
    "aggregate": "Over all tasks, as fractions of each task's range of scores",
    "improvement": "Probability of improvement of the first algorithm over the second",
}


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
