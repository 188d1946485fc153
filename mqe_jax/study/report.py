"""The report of a sweep: figures, tables and aggregates over seeds, generated from its finished runs alone.

The output is deterministic: bootstrap intervals use a fixed seed, and figures contain no timestamp.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mqe_jax.core.files import check_folder, write_atomically
from mqe_jax.core.literal import to_markdown
from mqe_jax.study.estimates import LAST, Rows, aggregate_tables, curve_rows, evaluated, final_rows, group
from mqe_jax.study.figures import draw_curves, draw_evaluations, draw_profiles
from mqe_jax.study.runs import PLAIN, REWARD, Reference, Run, read_runs, table
from mqe_jax.train.logs import number


def report(folder: Path, reference: Reference | None = None) -> list[Path]:
    """Writes FOLDER/report from the finished runs of a sweep; returns the files.

    Raises:
        InputError: if no run is finished, or a file of one is damaged.
    """
    runs = read_runs(folder)
    check_folder(folder / "report", "folder")
    return write_report(runs, folder / "report", reference or Reference())


def write_report(runs: Sequence[Run], target: Path, reference: Reference) -> list[Path]:
    """Writes the report of runs into a folder; returns the files."""
    cells = group(runs, reference)
    finals = final_rows(cells, reference)
    files: dict[str, bytes] = {
        "curves.csv": table(curve_rows(cells)).encode(),
        "final.csv": table(finals).encode(),
        "curves.png": draw_curves(cells, reference),
    }
    label = [f"`reference`: {to_markdown(reference.label)}."] if reference.values else []
    text = ["# Results", "", _EXPLANATION, *label, ""]
    text += [markdown(finals), "", "![Training curves](curves.png)", ""]
    if with_evaluations := evaluated(cells):
        files["evaluations.png"] = draw_evaluations({cell: cells[cell] for cell in with_evaluations}, reference)
        text += ["![Evaluations during training](evaluations.png)", ""]
    aggregates = aggregate_tables(cells)
    for name, rows in aggregates.items():
        files[f"{name}.csv"] = table(rows).encode()
        text += [f"## {_HEADINGS[name]}", "", markdown(rows), ""]
    if aggregates:
        files["profiles.png"] = draw_profiles(cells, reference)
        text += ["![Performance profiles](profiles.png)", ""]
    if any(run.absolute is not None for run in runs):
        files["marl_eval.json"] = (json.dumps(to_marl_eval(runs), indent=1) + "\n").encode()
    files["report.md"] = "\n".join(text).encode()
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


def markdown(rows: Rows, names: Mapping[str, str] | None = None) -> str:
    """Returns rows as a Markdown table of the columns `names`, with these headings; of all columns by default.

    NAME, NAME_low and NAME_high (or low and high) share one column.
    """
    ends = [name for name in rows[0] if name in ("low", "high") or name.endswith(("_low", "_high"))]
    names = names or {name: name for name in rows[0] if name not in ends}
    lines = [list(names.values()), ["---"] * len(names), *([_shown(row, name) for name in names] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _shown(row: Mapping[str, Any], name: str) -> str:
    """Returns an entry of a table with its interval; success as percentages, nothing for NaN."""
    value = row[name]
    if isinstance(value, str):
        return to_markdown(value)
    if not math.isfinite(value):
        return ""
    low, high = ("low", "high") if name in ("iqm", "probability") else (f"{name}_low", f"{name}_high")
    three = [f"{x:.1%}" if name == "success" else _short(x) for x in (value, row.get(low, 0.0), row.get(high, 0.0))]
    return f"{three[0]} [{three[1]}, {three[2]}]" if low in row else three[0]


def _short(value: float) -> str:
    return number(value) if float(value).is_integer() else f"{value:.3g}"


def to_marl_eval(runs: Iterable[Run]) -> dict[str, Any]:
    """Returns the nested mapping that the package `marl-eval` reads (Gorsane et al. 2022, arXiv 2209.10485).

    Environment -> task -> algorithm -> run -> step_k -> {step_count, metric: [value]}, absolute_metrics. Runs without
    evaluations are left out; a variant is a task of its own, TASK+VARIANT. Each list holds one value, the mean over the
    evaluation's episodes under sampled actions; the format allows this instead of one value per episode.
    """
    tree: dict[str, Any] = {}
    for run in runs:
        if run.absolute is None:
            continue
        steps: dict[str, Any] = {
            f"step_{i}": {"step_count": point["env_steps"], **_metrics(point)}
            for i, point in enumerate(run.evaluations, start=1)
        }
        steps["absolute_metrics"] = _metrics(run.absolute)
        task = run.cell.task if run.cell.variant == PLAIN else f"{run.cell.task}+{run.cell.variant}"
        tree.setdefault(task, {}).setdefault(run.cell.algorithm, {})[f"seed_{run.seed}"] = steps
    return {"mqe": tree}


def _metrics(point: Mapping[str, Any]) -> dict[str, list[float]]:
    return {name: [point["sampled"][name]] for name in (REWARD, "success_rate") if name in point["sampled"]}
