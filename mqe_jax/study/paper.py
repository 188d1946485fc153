"""The paper's results (arXiv 2403.16015): average step reward after 40 M environment steps, read from its figures."""

from __future__ import annotations

from collections.abc import Mapping

TITLES: Mapping[str, str] = {
    "go1gate": "Narrow Gate",
    "go1seesaw": "Climb on Seesaw",
    "go1sheep-easy": "Sheep Dog (Easy)",
    "go1sheep-hard": "Sheep Dog (Hard)",
    "go1pushbox": "Push Box",
    "go1football-defender": "Football (2 vs 1)",
}
"""Tasks of the paper's figure, in its order: rows from top to bottom, two per row."""

ALGORITHMS: Mapping[str, str] = {"jrpo": "JRPO", "mat": "MAT", "mappo": "MAPPO"}
"""Algorithms of the paper's figure by id, in the order of its legend."""

STEPS = 40_000_000
"""Environment steps of each training run in the paper."""

HIERARCHICAL, SCRATCH = "hierarchical", "scratch"
"""The paper's two settings: commands for the walk policy, or joint targets."""

SETTINGS: Mapping[str, str] = {HIERARCHICAL: "hierarchical (walk policy)", SCRATCH: "from scratch (joint targets)"}
"""Titles of the paper's settings, in the order of its figure."""

VALUES: Mapping[str, Mapping[str, Mapping[str, float]]] = {
    HIERARCHICAL: {
        "go1gate": {"mappo": 2.75, "jrpo": 3.1, "mat": 2.1},
        "go1seesaw": {"mappo": 0.73, "jrpo": 0.73, "mat": 0.62},
        "go1sheep-easy": {"mappo": 0.28, "jrpo": 0.40, "mat": 0.58},
        "go1sheep-hard": {"mappo": 1.75, "jrpo": 1.75, "mat": 3.3},
        "go1pushbox": {"mappo": 0.0009, "jrpo": 0.001, "mat": 0.0012},
        "go1football-defender": {"mappo": 0.55, "jrpo": 0.33, "mat": 0.30},
    },
    SCRATCH: {
        "go1gate": {"mappo": 0.0, "jrpo": -0.0005, "mat": -0.004},
        "go1seesaw": {"mappo": 0.15, "jrpo": 0.13, "mat": 0.07},
        "go1sheep-easy": {"mappo": 0.001, "jrpo": 0.001, "mat": 0.0},
        "go1sheep-hard": {"mappo": 1.73, "jrpo": 1.71, "mat": 1.72},
        "go1pushbox": {"mappo": 0.0008, "jrpo": 0.001, "mat": 0.0012},
        "go1football-defender": {"mappo": 0.252, "jrpo": 0.252, "mat": 0.252},
    },
}
"""Setting -> task -> algorithm -> average step reward."""

GATE_TERMS: Mapping[str, str] = {"reward/approach": "Distance to Target Reward", "reward/success": "Success Reward"}
"""Reward terms of go1gate in the appendix figure (MAPPO, first 20 M steps, mean of 5 seeds), by column name."""

GATE_STEPS = 20_000_000
"""Environment steps of the appendix figure."""


def from_scratch(setting: str) -> bool:
    """Returns whether a setting trains without the walk policy: `scratch`, or a name that starts with `scratch-`."""
    return setting == SCRATCH or setting.startswith(f"{SCRATCH}-")


def value(setting: str, task: str, algorithm: str) -> float | None:
    """Returns the paper's value to compare a cell with, or None.

    That is the value of the same cell; for a setting that the paper does not have, `best` of the task, or the cell's
    value from scratch if it trains without the walk policy.
    """
    if from_scratch(setting):
        setting = SCRATCH
    if setting not in SETTINGS:
        return best(task)
    return VALUES[setting].get(task, {}).get(algorithm)


def best(task: str) -> float | None:
    """Returns the paper's best value of a task over all algorithms, with the walk policy, or None."""
    return max(VALUES[HIERARCHICAL].get(task, {}).values(), default=None)
