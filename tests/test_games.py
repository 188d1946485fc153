"""Empirical games against known answers and recomputations by other methods: ratings, payoffs,
intervals.
"""

import itertools
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import binomtest

from mqe_jax.selfplay.league import games, tournament

Array = NDArray[np.float64]


def results_of(seed: int, count: int, episodes: int = 12) -> NDArray[np.int64]:
    """Random results: pairs of uneven strength, of which one won all, and one has not played."""
    random = np.random.default_rng(seed)
    chances = random.dirichlet([0.5, 0.5, 0.5], size=(count, count))
    results = random.multinomial(episodes, chances)
    results[0, 1] = [episodes, 0, 0]
    results[-1, -2] = 0
    return results


def payoff_of(table: NDArray[Any]) -> Array:
    """Wins minus losses of every pair, on both sides together, pair by pair."""
    count = len(table)
    made = np.zeros((count, count))
    for i, j in itertools.permutations(range(count), 2):
        played = table[i, j].sum() + table[j, i].sum()
        made[i, j] = (table[i, j, 0] - table[i, j, 2] - table[j, i, 0] + table[j, i, 2]) / played
    return made


def test_a_payoff_counts_the_games_of_both_sides() -> None:
    results = np.zeros((2, 2, 3), int)
    results[0, 1] = [5, 2, 1]
    results[1, 0] = [3, 0, 9]
    np.testing.assert_allclose(games.payoffs(results), [[0, 0.5], [-0.5, 0]])
    assert games.payoffs(np.zeros((2, 2, 3))).tolist() == [[0, 0], [0, 0]]


@pytest.mark.parametrize(("win", "draw", "loss"), [(3, 0, 1), (0, 7, 2), (500, 0, 0), (1, 0, 0)])
def test_the_rating_of_two_policies_in_closed_form(win: int, draw: int, loss: int) -> None:
    results = np.zeros((2, 2, 3), int)
    results[0, 1] = [win, draw, loss]
    share = 0.998 * (win + draw / 2) / (win + draw + loss) + 0.001
    found = tournament.rate(results, 1)
    np.testing.assert_allclose(found.value, [400 * np.log10(share / (1 - share)), 0], atol=1e-6)
    more = tournament.rate(16 * results, 1)
    np.testing.assert_allclose(more.value, found.value, atol=1e-6, err_msg="more of the same games")
    assert more.low[0] > found.low[0]


def test_a_star_is_that_of_an_exact_sign_test() -> None:
    for won, lost in itertools.product((0, 1, 4, 7, 12, 60), repeat=2):
        expected = binomtest(won, won + lost).pvalue < 0.05 if won + lost else False
        assert tournament.differ(won, lost) == expected
    assert tournament.differ(2000, 1700) and not tournament.differ(2000, 1950)


@pytest.mark.parametrize("seed", range(4))
def test_ratings_explain_the_points_of_every_policy(seed: int) -> None:
    """Ratings are most likely where all policies are expected to have the points that they have."""
    strength = np.array([0.0, 1.0, 3.0, 7.0, 12.0])[: 2 + seed]
    chance = 1 / (1 + np.exp(-np.subtract.outer(strength, strength)))
    results = np.stack([np.round(900 * chance), 0 * chance, np.round(900 * (1 - chance))], axis=-1)
    ratings = tournament.rate(results, 1).value
    expected = np.zeros(len(ratings))
    points = np.zeros(len(ratings))
    for i, j in itertools.permutations(range(len(ratings)), 2):
        played = results[i, j].sum() + results[j, i].sum()
        points[i] += 0.998 * (results[i, j, 0] + results[j, i, 2]) + 0.001 * played
        expected[i] += played / (1 + 10 ** ((ratings[j] - ratings[i]) / 400))
    np.testing.assert_allclose(expected, points, rtol=0, atol=1e-6)


def check(estimate: games.Estimate, value: Any, samples: Any) -> None:
    """Compares an estimate with a value and the interval of its samples, recomputed by sorting."""
    ordered = np.sort(np.asarray(samples, float), axis=0)
    at = np.array([0.025, 0.975]) * (len(ordered) - 1)
    low, high = (ordered[int(x)] + (x % 1) * (ordered[int(x) + 1] - ordered[int(x)]) for x in at)
    for name, expected in {
        "value": value,
        "low": np.minimum(low, value),
        "high": np.maximum(high, value),
    }.items():
        np.testing.assert_allclose(getattr(estimate, name), expected, atol=1e-6, err_msg=name)


@pytest.mark.parametrize(("seed", "count"), [(0, 2), (1, 3), (2, 5)])
def test_estimates_of_a_match_equal_a_recomputation_with_the_same_draws(
    seed: int, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(games, "_SAMPLES", 60)
    results = results_of(seed, count)
    random = np.random.default_rng(0)
    found = games.analyse(results)

    more = results + 1 / 6
    draws = random.standard_gamma(more, (60, count, count, 3))
    chosen = random.integers(count - 1, size=(60, count, count - 1))
    whole = payoff_of(results)
    samples = [
        payoff_of(x / x.sum(axis=-1, keepdims=True) * more.sum(axis=-1, keepdims=True))
        for x in draws
    ]
    others = [[j % count for j in range(i + 1, i + count)] for i in range(count)]
    drawn = [[[others[i][k] for k in choice[i]] for i in range(count)] for choice in chosen]
    check(found.payoff, whole, samples)

    def mean(table, those):
        return [table[i, those[i]].mean() for i in range(count)]

    check(
        found.mean, mean(whole, others), [mean(*each) for each in zip(samples, drawn, strict=True)]
    )

    def lowest(table):
        return [min(table[i, j] for j in others[i]) for i in range(count)]

    check(found.worst, lowest(whole), [lowest(table) for table in samples])
