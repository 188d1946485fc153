"""Empirical games against known answers and recomputations by other methods: ratings, equilibria,
cycles, intervals.
"""

import itertools
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize

from mqe_jax.selfplay.league import games, tournament

Array = NDArray[np.float64]

RPS = np.array([[0.0, -1.0, 1.0], [1.0, 0.0, -1.0], [-1.0, 1.0, 0.0]])
BIASED = np.array([[0.0, -1.0, 2.0], [1.0, 0.0, -1.0], [-2.0, 1.0, 0.0]])  # weights 1, 2, 1
# the loser bounds the weight of the first
BOUND = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 0.5], [1.0, -0.5, 0.0]])


def grown(payoff: Any, row: list[float]) -> Array:
    """A game with one policy more, which has the payoffs `row` against the others."""
    column = -np.array([row]).T
    return np.block([[np.asarray(payoff), column], [np.array([row]), np.zeros((1, 1))]])


@pytest.mark.parametrize(
    ("payoff", "weights"),
    [
        (RPS, [1 / 3] * 3),
        (0.01 * RPS, [1 / 3] * 3),
        (RPS[np.ix_([0, 0, 1, 2], [0, 0, 1, 2])], [1 / 6, 1 / 6, 1 / 3, 1 / 3]),
        (
            RPS[np.ix_([0, 0, 1, 2], [0, 0, 1, 2])] + 1e-13 * grown(-RPS, [1, 2, 3]),
            [1 / 6, 1 / 6, 1 / 3, 1 / 3],
        ),
        (BIASED, [0.25, 0.5, 0.25]),
        (grown(RPS, [-0.1, -0.2, -0.3]), [1 / 3, 1 / 3, 1 / 3, 0]),
        (grown(RPS, [1, 1, 1]), [0, 0, 0, 1]),
        (grown(RPS, [0, 0, 0]), [0.25] * 4),
        (grown(grown([[0.0]], [0.0]), [-0.5, -0.5]), [0.5, 0.5, 0]),
        (np.sign(np.subtract.outer([3, 2, 1, 0], [3, 2, 1, 0])).astype(float), [1, 0, 0, 0]),
        (BOUND, [1 / 3, 2 / 3, 0]),
        (np.zeros((5, 5)), [0.2] * 5),
        (np.zeros((1, 1)), [1.0]),
    ],
)
def test_the_equilibria_of_games_with_known_answers(payoff: Array, weights: list[float]) -> None:
    np.testing.assert_allclose(games.nash(payoff), weights, atol=1e-7)


def by_vertices(payoff: Array) -> Array:
    """The equilibrium of maximum entropy: all vertices of the set of equilibria, mixed by a general
    optimiser.
    """
    count = len(payoff)
    bounds = np.vstack([payoff, -np.eye(count)])
    vertices = []
    for tight in itertools.combinations(range(2 * count), count - 1):
        system = np.vstack([bounds[list(tight)], np.ones(count)])
        if abs(np.linalg.det(system)) > 1e-9:
            corner = np.linalg.solve(system, np.eye(count)[-1])
            if np.max(bounds @ corner) < 1e-9:
                vertices.append(np.maximum(corner, 0.0))
    corners = np.unique(np.round(vertices, 12), axis=0)
    seen = corners[:, corners.max(axis=0) > 0]
    parts = len(corners)

    def log(mix):
        return np.log(np.maximum(mix @ seen, 1e-300))

    sums = {"type": "eq", "fun": lambda mix: mix.sum() - 1, "jac": lambda mix: np.ones(parts)}
    found = minimize(
        lambda mix: (mix @ seen) @ log(mix),
        np.full(parts, 1 / parts),
        jac=lambda mix: seen @ (log(mix) + 1),
        method="SLSQP",
        bounds=[(0, 1)] * parts,
        constraints=[sums],
        options={"ftol": 1e-16, "maxiter": 1000},
    )
    return found.x @ corners


@pytest.mark.parametrize("seed", range(40))
def test_equilibria_of_degenerate_games_equal_those_found_by_vertices(seed: int) -> None:
    random = np.random.default_rng(seed)
    count = random.integers(2, 6)
    high = random.integers(1, 4)
    upper = np.triu(random.integers(-high, high + 1, size=(count, count)).astype(float), 1)
    if seed % 4 == 0:
        upper = np.triu(random.normal(size=(count, count)), 1)
    payoff = upper - upper.T
    np.testing.assert_allclose(games.nash(payoff), by_vertices(payoff), atol=1e-6)
    copies = [0, *range(count), 0]
    shared = games.nash(payoff[np.ix_(copies, copies)])
    np.testing.assert_allclose(shared[[1, -1]], shared[0], atol=1e-6)
    if seed % 4 == 0:  # the equilibrium is unique
        np.testing.assert_allclose(
            shared * [3, 3, *[1] * (count - 1), 3], games.nash(payoff)[copies], atol=1e-6
        )


@pytest.mark.parametrize(
    ("payoff", "share"),
    [
        (RPS, 1.0),
        (-RPS, 1.0),
        (grown(RPS, [-1, -1, -1]), 0.25),
        (grown(RPS, [0, 0, 0]), 0.25),
        (BOUND, 0.0),
        (grown(RPS, [0, -1, 1]), 0.5),
        (np.zeros((4, 4)), 0.0),
        (np.zeros((2, 2)), 0.0),
        (np.zeros((1, 1)), 0.0),
    ],
)
def test_the_share_of_intransitive_triples(payoff: Array, share: float) -> None:
    assert games.cycles(payoff) == pytest.approx(share)


def results_of(seed: int, count: int, episodes: int = 12) -> NDArray[np.int64]:
    """Random results: pairs of uneven strength, of which one won all, and one has not played."""
    random = np.random.default_rng(seed)
    chances = random.dirichlet([0.5, 0.5, 0.5], size=(count, count))
    results = random.multinomial(episodes, chances)
    results[0, 1] = [episodes, 0, 0]
    results[-1, -2] = 0
    return results


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
    odds = (win + draw / 2 + 0.5) / (loss + draw / 2 + 0.5)
    np.testing.assert_allclose(
        tournament.rate(results, 1).value, [400 * np.log10(odds), 0], atol=1e-6
    )


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
        won = results[i, j, 0] + results[j, i, 2] + 0.5
        points[i] += won
        expected[i] += (results[i, j].sum() + results[j, i].sum() + 1) / (
            1 + 10 ** ((ratings[j] - ratings[i]) / 400)
        )
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

    def matrix(table: NDArray[Any]) -> Array:
        made = np.zeros((count, count))
        for i, j in itertools.permutations(range(count), 2):
            played = table[i, j].sum() + table[j, i].sum()
            made[i, j] = (
                table[i, j, 0] - table[i, j, 2] - table[j, i, 0] + table[j, i, 2]
            ) / played
        return made

    more = results + np.array([0, 0.5, 0])
    draws = random.standard_gamma(more, (60, count, count, 3))
    chosen = random.integers(count - 1, size=(60, count, count - 1))
    whole = matrix(results)
    samples = [
        matrix(x / x.sum(axis=-1, keepdims=True) * more.sum(axis=-1, keepdims=True)) for x in draws
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

    def turning(table: Array) -> float:
        signs = [
            (table[i, j], table[j, k], table[k, i])
            for i, j, k in itertools.combinations(range(count), 3)
        ]
        return float(np.mean([min(each) > 0 or max(each) < 0 for each in signs])) if signs else 0.0

    check(found.cycles, turning(whole), [turning(table) for table in samples])
    weights = [by_vertices(table) for table in (whole, *samples)]
    check(found.weight, weights[0], weights[1:])
    averages = [table @ weight for table, weight in zip((whole, *samples), weights, strict=True)]
    check(found.average, averages[0], averages[1:])


@pytest.mark.parametrize("count", [1, 2, 4])
def test_estimates_of_teams_equal_a_recomputation_with_the_same_draws(count: int) -> None:
    random = np.random.default_rng(0)
    rates = np.random.default_rng(3).uniform(size=(count, count))
    found = games.mates(rates, 16)
    ended = random.standard_gamma(
        np.stack([16 * rates + 0.5, 16 * (1 - rates) + 0.5], axis=-1), (500, count, count, 2)
    )
    times = random.multinomial(count, [1 / count] * count, 500)
    same = []
    cross = []
    for draw, often in zip(ended, times, strict=True):
        drawn = [i for i in range(count) for _ in range(often[i])]

        def rate(i, j, draw=draw):
            return draw[i, j, 0] / draw[i, j].sum()

        pairs = [rate(i, j) for i, j in itertools.product(drawn, repeat=2) if i != j]
        same.append(np.mean([rate(i, i) for i in drawn]))
        cross.append(np.mean(pairs) if pairs else np.nan)
    check(found["same"], np.diag(rates).mean(), same)
    assert found.keys() == ({"same"} if count == 1 else {"same", "cross", "gap"})
    if count > 1:
        other = rates[~np.eye(count, dtype=bool)].mean()
        met = ~np.isnan(cross)
        check(found["cross"], other, np.array(cross)[met])
        check(found["gap"], np.diag(rates).mean() - other, (np.array(same) - cross)[met])


def test_an_estimate_of_partners_equals_a_recomputation_with_the_same_draws() -> None:
    random = np.random.default_rng(0)
    rates = np.random.default_rng(3).uniform(size=(4, 2))
    ended = random.standard_gamma(
        np.stack([16 * rates + 0.5, 16 * (1 - rates) + 0.5], axis=-1), (500, 4, 2, 2)
    )
    times = random.multinomial(4, [0.25] * 4, 500)
    means = [
        np.mean([each[i, :, 0] / each[i].sum(axis=-1) for i in range(4) for _ in range(often[i])])
        for each, often in zip(ended, times, strict=True)
    ]
    check(games.partners(rates, 16), rates.mean(), np.array(means))


def test_intervals_contain_the_truth_about_as_often_as_they_say() -> None:
    """Mean success of five of many seeds with mates of other seeds, whose abilities add up; 60
    studies.
    """
    random = np.random.default_rng(0)
    hits = 0
    for _ in range(60):
        ability = random.uniform(0.1, 0.45, size=8)
        chance = ability[:, None] + ability
        found = games.mates(random.binomial(64, chance) / 64, 64)["cross"]
        hits += bool(found.low <= 0.55 <= found.high)
    assert 48 <= hits <= 60
