"""The report of a sweep, generated from its finished runs: the same files from the same runs."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mqe_jax.core.files import check_folder, write_atomically
from mqe_jax.core.literal import to_markdown
from mqe_jax.study.estimates import (
    LAST,
    Cells,
    Rows,
    aggregate_tables,
    curve_rows,
    final_rows,
    group,
    select_evaluated,
)
from mqe_jax.study.figures import draw_curves, draw_evaluations
from mqe_jax.study.runs import read_runs, table
from mqe_jax.train.logs import number


def report(folder: Path) -> list[Path]:
    """Writes FOLDER/report from the finished runs of a sweep; returns the files.

    InputError without a finished run.
    """
    runs = read_runs(folder)
    check_folder(folder / "report", "folder")
    return write_report(group(runs), folder / "report")


def write_report(cells: Cells, target: Path) -> list[Path]:
    """Writes the report of cells, in their order, into a folder; returns the files."""
    finals = final_rows(cells)
    files: dict[str, bytes] = {
        "curves.csv": table(curve_rows(cells)).encode(),
        "final.csv": table(finals).encode(),
        "curves.png": draw_curves(cells),
    }
    text = ["# Results", "", _EXPLANATION, ""]
    text += [markdown(finals), "", "![Training curves](curves.png)", ""]
    if with_evaluations := select_evaluated(cells):
        evaluated = {cell: cells[cell] for cell in with_evaluations}
        files["evaluations.png"] = draw_evaluations(evaluated)
        text += ["![Evaluations during training](evaluations.png)", ""]
    for name, rows in aggregate_tables(cells).items():
        files[f"{name}.csv"] = table(rows).encode()
        text += [f"## {_HEADINGS[name]}", "", markdown(rows), ""]
    files["report.md"] = "\n".join(text).encode()
    for name, content in files.items():
        write_atomically(target / name, content)
    return [target / name for name in files]


_EXPLANATION = f"""Each value is the interquartile mean over seeds with its 95% stratified bootstrap
interval. `training`: average step reward over the last {LAST:.0%} of training steps; it includes
shaping rewards of the settings. `absolute`: average step reward of the unmodified task with the
best checkpoint over the final evaluation's episodes, actions sampled; `success` likewise."""
_HEADINGS = {
    "aggregate": "Over all tasks, as fractions of each task's range of scores",
    "improvement": "Probability of improvement of the first algorithm over the second",
}


def markdown(rows: Rows) -> str:
    """Returns rows as a Markdown table; an interval joins its value."""
    names = [
        name
        for name in rows[0]
        if name not in ("low", "high") and not name.endswith(("_low", "_high"))
    ]
    lines = [
        names,
        ["---"] * len(names),
        *([_format_cell(row, name) for name in names] for row in rows),
    ]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _format_cell(row: Mapping[str, Any], name: str) -> str:
    """Returns an entry of a table with its interval; success as percentages, nothing for NaN."""
    value = row[name]
    if isinstance(value, str):
        return to_markdown(value)
    if not math.isfinite(value):
        return ""
    low, high = (
        ("low", "high") if name in ("iqm", "probability") else (f"{name}_low", f"{name}_high")
    )
    three = [
        f"{x:.1%}" if name == "success" else _short(x)
        for x in (value, row.get(low, 0.0), row.get(high, 0.0))
    ]
    return f"{three[0]} [{three[1]}, {three[2]}]" if low in row else three[0]


def _short(value: float) -> str:
    return number(value) if float(value).is_integer() else f"{value:.3g}"
