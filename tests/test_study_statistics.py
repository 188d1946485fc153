"""Statistics of few runs, compared with the package `rliable` 1.2.0 on random matrices (data/rliable.json).

The package samples its bootstrap from numpy's global state, which was seeded before each interval.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mqe_jax.errors import InputError
from mqe_jax.study import statistics
from mqe_jax.study.report import to_marl_eval
from mqe_jax.study.runs import Cell, Run

FIXTURE = json.loads((Path(__file__).parent / "data" / "rliable.json").read_text(encoding="utf-8"))
CASES = pytest.mark.parametrize("case", FIXTURE["cases"], ids=lambda case: str(np.shape(case["x"])))


class PackageRandom:
    """The package's samples: numpy's older generator, one index per run and task, the matrices in turn."""

    def __init__(self, *shapes: tuple[int, ...]) -> None:
        state = np.random.RandomState(FIXTURE["seed"])
        draws = [[state.randint(0, shape[0], shape) for shape in shapes] for _ in range(FIXTURE["samples"])]
        self.drawn = [np.stack(matrix) for matrix in zip(*draws, strict=True)]

    def integers(self, low: int, high: int, size: tuple[int, ...]) -> np.ndarray:
        drawn = self.drawn.pop(0)
        assert drawn.shape == size
        return drawn


@CASES
def test_point_estimates_equal_the_package(case: dict[str, Any]) -> None:
    x, y = np.array(case["x"]), np.array(case["y"])
    np.testing.assert_allclose(statistics.interquartile_mean(x), case["iqm"], rtol=1e-12)
    improvement = statistics.probability_of_improvement(x, y)
    np.testing.assert_allclose(improvement, case["probability_of_improvement"], rtol=1e-12)
    profile = statistics.performance_profile(x, FIXTURE["thresholds"])
    np.testing.assert_allclose(profile, case["profile"], rtol=1e-12)


@CASES
def test_intervals_equal_the_package_on_its_own_draws(case: dict[str, Any]) -> None:
    x, y = np.array(case["x"]), np.array(case["y"])
    samples = FIXTURE["samples"]

    def interval(scores: Any, statistic: Any, random: Any) -> np.ndarray:
        return np.stack(statistics.bootstrap_interval(scores, statistic, random, samples=samples), axis=-1)

    iqm = interval([x], statistics.interquartile_mean, PackageRandom(x.shape))
    np.testing.assert_allclose(iqm, case["iqm_interval"], rtol=1e-9, atol=1e-12)
    improvement = interval([x, y], statistics.probability_of_improvement, PackageRandom(x.shape, y.shape))
    np.testing.assert_allclose(improvement, case["improvement_interval"], rtol=1e-9, atol=1e-12)

    def profile(scores: np.ndarray) -> np.ndarray:
        return statistics.performance_profile(scores, FIXTURE["thresholds"])

    profiles = interval([x], profile, PackageRandom(x.shape))
    np.testing.assert_allclose(profiles, case["profile_interval"], rtol=1e-9, atol=1e-12)


def test_the_interquartile_mean_leaves_out_the_outer_quarters() -> None:
    assert statistics.interquartile_mean([[-100.0], [1.0], [2.0], [3.0], [1000.0]]) == 2.0
    assert statistics.interquartile_mean([[5.0], [7.0]]) == 6.0


def test_an_interval_holds_its_statistic_and_repeats() -> None:
    x = np.random.default_rng(3).normal(size=(8, 2))
    iqm = statistics.interquartile_mean
    ends = [statistics.bootstrap_interval([x], iqm, np.random.default_rng(0)) for _ in range(2)]
    assert ends[0] == ends[1]
    assert ends[0][0] < iqm(x) < ends[0][1]


@pytest.mark.parametrize("scores", [np.zeros(3), np.zeros((0, 2)), np.array([[np.nan]])])
def test_bad_scores_are_refused(scores: np.ndarray) -> None:
    with pytest.raises(InputError, match="scores"):
        statistics.bootstrap_interval([scores], statistics.interquartile_mean, np.random.default_rng(0))


def test_normalized_scores_are_fractions_of_a_tasks_range() -> None:
    scores = {"a": np.array([[1.0, 5.0]]), "b": np.array([[3.0, 5.0]])}
    result = statistics.normalized(scores, np.array([1.0, 5.0]), np.array([5.0, 5.0]))
    np.testing.assert_allclose(result["b"], [[0.5, 0.0]])


def test_marl_eval_export_has_the_documented_nesting() -> None:
    point = {"env_steps": 10, "sampled": {"average_step_reward": 0.5, "success_rate": 0.25}}
    run = Run(Cell("go1gate", "mappo"), 3, {}, [point, {**point, "env_steps": 20}], {**point, "env_steps": 20})
    variant = Run(Cell("go1gate", "mappo", "tuned"), 3, {}, [], None)
    exported = to_marl_eval([run, variant])
    assert list(exported["mqe"]) == ["go1gate"]
    seed = exported["mqe"]["go1gate"]["mappo"]["seed_3"]
    assert list(seed) == ["step_1", "step_2", "absolute_metrics"]
    assert seed["step_2"] == {"step_count": 20, "average_step_reward": [0.5], "success_rate": [0.25]}
    assert seed["absolute_metrics"] == {"average_step_reward": [0.5], "success_rate": [0.25]}
