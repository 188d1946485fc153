"""Writes tests/data/rliable.json: results of the `rliable` package on random matrices.

The package is a dependency of neither the project nor its tests. Generated once with

    python -m venv VENV && VENV/bin/pip install rliable==1.2.0 'pandas<3'
    VENV/bin/python tools/rliable_fixture.py

The package samples its bootstrap from numpy's global state, which is seeded before each interval.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from rliable import library, metrics  # pyright: ignore[reportMissingImports]

SEED, SAMPLES = 7, 500
THRESHOLDS = [-1.0, -0.25, 0.0, 0.5, 1.5]


def interval(scores, statistic) -> list:
    """Returns the bounds of the package's 95% interval."""
    np.random.seed(SEED)  # noqa: NPY002
    _, ends = library.get_interval_estimates({"x": scores}, lambda *s: np.atleast_1d(statistic(*s)), reps=SAMPLES)
    return np.asarray(ends["x"]).T.squeeze().tolist()


def main() -> None:
    """Writes the fixture."""
    draw = np.random.default_rng(0)
    cases = []
    for runs, other_runs, tasks in ((5, 5, 6), (3, 4, 1), (10, 7, 2), (1, 2, 3)):
        x = np.round(draw.normal(size=(runs, tasks)), 2)
        y = np.round(draw.normal(0.3, 1.0, size=(other_runs, tasks)), 2)
        y[0] = x[0]  # ties
        cases.append(
            {
                "x": x.tolist(),
                "y": y.tolist(),
                "iqm": float(metrics.aggregate_iqm(x)),
                "mean": float(metrics.aggregate_mean(x)),
                "probability_of_improvement": float(metrics.probability_of_improvement(x, y)),
                "profile": library.score_distributions(x, THRESHOLDS).tolist(),
                "iqm_interval": interval(x, metrics.aggregate_iqm),
                "improvement_interval": interval([x, y], metrics.probability_of_improvement),
                "profile_interval": interval(x, lambda s: library.score_distributions(s, THRESHOLDS)),
            }
        )
    fixture = {"rliable": "1.2.0", "seed": SEED, "samples": SAMPLES, "thresholds": THRESHOLDS, "cases": cases}
    path = Path(__file__).parents[1] / "tests" / "data" / "rliable.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(fixture, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
