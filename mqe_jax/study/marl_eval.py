"""Results as the nested JSON that the package `marl-eval` reads (Gorsane et al. 2022, arXiv 2209.10485)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from mqe_jax.study.runs import PLAIN, Run

ENVIRONMENT = "mqe"
METRICS = ("average_step_reward", "success_rate")


def to_marl_eval(runs: Iterable[Run]) -> dict[str, Any]:
    """Returns environment -> task -> algorithm -> run -> step_k -> {step_count, metric: [value]}, absolute_metrics.

    Runs without evaluations are left out; a variant is a task of its own, TASK+VARIANT. Each list holds one value, the
    mean over the evaluation's episodes under sampled actions; the format allows this instead of one value per episode.
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
    return {ENVIRONMENT: tree}


def _metrics(point: Mapping[str, Any]) -> dict[str, list[float]]:
    return {name: [point["sampled"][name]] for name in METRICS if name in point["sampled"]}
