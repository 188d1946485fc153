"""Equilibria, cycles and means over mixed teams against known answers and recomputations by other
methods.
"""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize

from lab import games
from mqe_jax.selfplay.league import games as league
from mqe_jax.selfplay.league.crossplay import CrossPlay
from mqe_jax.selfplay.league.tournament import Standings, rate
from tests.inputs import refuses
from tests.test_games import check, payoff_of, results_of

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


@pytest.mark.parametrize(("seed", "count"), [(0, 2), (1, 3), (2, 5)])
def test_equilibria_of_a_match_equal_a_recomputation_with_the_same_draws(
    seed: int, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(league, "_SAMPLES", 60)
    results = results_of(seed, count)
    found = games.solve(results)
    more = results + 1 / 6
    draws = np.random.default_rng(0).standard_gamma(more, (60, count, count, 3))
    whole = payoff_of(results)
    samples = [
        payoff_of(x / x.sum(axis=-1, keepdims=True) * more.sum(axis=-1, keepdims=True))
        for x in draws
    ]

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


def test_the_table_of_a_match_gives_equilibrium_and_cycles(tmp_path: Path) -> None:
    """Rock, paper and scissors, with a policy that loses to all."""
    results = np.zeros((4, 4, 3), int)
    for i, j in ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)):
        results[i, j] = [100, 0, 0]
    names = ("runs/rock", "runs/paper", "runs/scissors", "idle")
    Standings("go1tug", names, results, rate(results, 3), "walk").save(tmp_path)
    lines = games.describe(tmp_path / "tournament.csv").splitlines()
    assert lines[1].split()[1] == "runs/rock" and " 33 (" in lines[1]
    assert lines[4].split()[1:3] == ["idle", "-100"] and lines[4].endswith("0 (0 to 0)")
    assert lines[-1].startswith("cycles: 25 (")


def test_the_table_of_mixed_teams_gives_means(tmp_path: Path) -> None:
    success = np.array([[1.0, 0.25, 0.5], [0.75, 0.5, 0.0], [0.25, 0.25, 0.0]])
    CrossPlay("go1gate", ("a", "b"), ("idle",), 64, success, "walk").save(tmp_path)
    text = games.describe(tmp_path / "tournament.csv")
    assert [line.split()[:2] for line in text.splitlines()[1:]] == [
        ["same", "75.0"],
        ["cross", "50.0"],
        ["gap", "25.0"],
        ["idle", "25.0"],
    ]


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"agent0,others\na,b\n",
        b"\xff",
        b"team0,team1,wins,draws,losses\na\n",
        b"team0,team1,wins,draws,losses\na,a,nan,0,0\n",
        b"agent0,others,success,episodes\n",
    ],
)
def test_a_damaged_table_is_named(content: bytes, tmp_path: Path) -> None:
    file = tmp_path / "tournament.csv"
    file.write_bytes(content)
    refuses(r"tournament\.csv: damaged, or not ", games.describe, file)
