"""Reports from made-up runs: same data, same files; figures and tables.

Statistics of few runs.

The statistics are compared with the package `rliable` 1.2.0 on random matrices (`PACKAGE`), which
samples its bootstrap from numpy's global state, seeded before each interval. Names and errors of
others are shown as they are.
"""

import csv
import dataclasses
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mqe_jax.core.errors import InputError, one_line
from mqe_jax.core.literal import to_html, to_markdown
from mqe_jax.study import statistics
from mqe_jax.study.estimates import band, group, score_matrices, select_evaluated
from mqe_jax.study.report import markdown, write_report
from mqe_jax.study.runs import REWARD, Cell, Run
from tests.inputs import refuses


def made_up(cell: Cell, seed: int, *, evaluated: bool = True, scale: float = 1.0) -> Run:
    """A run of 400 updates that learns along a saturating curve, with its own noise."""
    draw = np.random.default_rng([seed, len(cell.algorithm), len(cell.task)])
    steps = np.arange(1, 401) * 100_000.0
    reached = scale * (1 - np.exp(-steps / 1e7)) * (0.8 + 0.1 * draw.normal()) + 0.03 * draw.normal(
        size=400
    )
    curve = {"env_steps": steps, REWARD: reached, "reward/success": 0.9 * reached}
    point = {
        "episodes": 32,
        "sampled": {REWARD: reached[-1], "success_rate": 0.5},
        "deterministic": {REWARD: 0.1},
    }
    points = [{"env_steps": at, **point} for at in (20_000_000, 40_000_000)]
    return (
        Run(cell, seed, curve, points, points[1]) if evaluated else Run(cell, seed, curve, [], None)
    )


RUNS = [
    made_up(Cell(task, algorithm), seed, scale=scale)
    for task in ("go1gate", "go1sheep-hard")
    for scale, algorithm in enumerate(("mappo", "jrpo", "mat"), start=2)
    for seed in range(3)
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("report")
    write_report(group(RUNS), target)
    return target


def rows_of(file: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(file.open()))


def test_the_same_runs_give_the_same_files(folder: Path, tmp_path: Path) -> None:
    files = {path.name: path.read_bytes() for path in write_report(group(RUNS), tmp_path)}
    assert files == {path.name: path.read_bytes() for path in folder.iterdir()}
    assert {"curves.png", "evaluations.png", "final.csv", "report.md"} <= set(files)


def test_final_values_are_those_of_the_last_updates(folder: Path) -> None:
    rows = rows_of(folder / "final.csv")
    assert [row["task"] for row in rows] == ["go1gate"] * 3 + ["go1sheep-hard"] * 3
    gate = next(row for row in rows if row["task"] == "go1gate" and row["algorithm"] == "mappo")
    ends = [run.curve[REWARD][-8:].mean() for run in RUNS if run.cell == Cell("go1gate", "mappo")]
    assert float(gate["training"]) == pytest.approx(np.mean(ends), rel=1e-4)
    assert float(gate["training_low"]) <= float(gate["training"]) <= float(gate["training_high"])
    assert gate["seeds"] == "3"


def test_the_better_algorithm_wins_the_aggregate(folder: Path) -> None:
    rows = {row["algorithm"]: row for row in rows_of(folder / "aggregate.csv")}
    assert float(rows["mat"]["iqm"]) > float(rows["mappo"]["iqm"])
    chance = {
        (r["first"], r["second"]): float(r["probability"])
        for r in rows_of(folder / "improvement.csv")
    }
    assert chance["mat", "mappo"] == 1.0 and chance["mappo", "mat"] == 0.0


def test_aggregates_need_half_of_the_tasks() -> None:
    tasks = ("go1gate", "go1seesaw", "go1pushbox")
    cells = {
        cell: [made_up(cell, 0), made_up(cell, 1)]
        for cell in (Cell(task, "mappo") for task in tasks)
    }
    for task in tasks[:2]:
        assert score_matrices(cells, "plain") == {}
        cells[Cell(task, "mat")] = [made_up(Cell(task, "mat"), seed) for seed in range(2)]
    assert score_matrices(cells, "plain")["mat"].shape == (2, 2)


def test_a_band_ends_where_the_shortest_seed_does() -> None:
    long = made_up(Cell("go1gate", "mat"), 0)
    short = made_up(Cell("go1gate", "mat"), 1)
    short = dataclasses.replace(short, curve={name: x[:100] for name, x in short.curve.items()})
    steps, middle, low, high = band([long, short])
    assert steps[-1] == 10_000_000 and len(middle) == len(steps) and (low <= high).all()


def test_a_reward_term_that_a_seed_never_gets_is_zero() -> None:
    one = made_up(Cell("go1gate", "mappo"), 0)
    other = made_up(Cell("go1gate", "mappo"), 1)
    one.curve.pop("reward/success")
    _, middle, _, _ = band([one, other], "reward/success")
    np.testing.assert_allclose(middle, other.curve["reward/success"] / 2)


def test_single_seeds_without_evaluation_are_reported(tmp_path: Path) -> None:
    run = made_up(Cell("go1gate", "mappo", "scratch"), 0, evaluated=False)
    names = {path.name for path in write_report(group([run]), tmp_path)}
    assert names == {"curves.png", "curves.csv", "final.csv", "report.md"}
    (row,) = rows_of(tmp_path / "final.csv")
    assert row["absolute"] == "nan" and row["training"] == row["training_low"]


def test_evaluations_take_the_place_of_training_rewards() -> None:
    runs = [
        made_up(Cell("go1gate", "mat", "tuned"), 0),
        made_up(Cell("go1gate", "mat"), 0, evaluated=False),
    ]
    cells = group(runs)
    ((cell, (run,)),) = select_evaluated(cells).items()
    assert cell.variant == "tuned" and list(run.curve["env_steps"]) == [20_000_000, 40_000_000]


# Of rliable 1.2.0: x, y and what it returns for them.
PACKAGE: dict[str, Any] = {
    "seed": 7,
    "samples": 500,
    "thresholds": [-1.0, -0.25, 0.0, 0.5, 1.5],
    "cases": [
        {
            "x": [
                [0.13, -0.13, 0.64, 0.1, -0.54, 0.36],
                [1.3, 0.95, -0.7, -1.27, -0.62, 0.04],
                [-2.33, -0.22, -1.25, -0.73, -0.54, -0.32],
                [0.41, 1.04, -0.13, 1.37, -0.67, 0.35],
                [0.9, 0.09, -0.74, -0.92, -0.46, 0.22],
            ],
            "y": [
                [0.13, -0.13, 0.64, 0.1, -0.54, 0.36],
                [-0.35, 0.17, 1.08, 1.79, -0.96, 1.81],
                [1.65, 1.08, 0.56, -0.01, 1.76, 2.26],
                [2.1, 1.62, 0.66, -0.91, 0.3, 0.96],
                [-0.99, 0.7, 0.73, 1.0, -0.88, -0.36],
            ],
            "iqm": -0.14625000000000002,
            "probability_of_improvement": 0.30333333333333334,
            "profile": [0.9, 0.5666666666666667, 0.4666666666666667, 0.2, 0.0],
            "iqm_interval": [-0.34574999999999995, 0.11914062499999992],
            "improvement_interval": [0.1549166666666667, 0.43],
            "profile_interval": [
                [0.8, 1.0],
                [0.43333333333333335, 0.7],
                [0.3333333333333333, 0.6],
                [0.06666666666666667, 0.3333333333333333],
                [0.0, 0.0],
            ],
        },
        {
            "x": [[-0.44], [-1.17], [1.74]],
            "y": [[-0.44], [0.63], [0.04], [1.88]],
            "iqm": 0.04333333333333337,
            "probability_of_improvement": 0.2916666666666667,
            "profile": [
                0.6666666666666666,
                0.3333333333333333,
                0.3333333333333333,
                0.3333333333333333,
                0.3333333333333333,
            ],
            "iqm_interval": [-1.17, 1.74],
            "improvement_interval": [0.0, 0.75],
            "profile_interval": [[0.0, 1.0], [0.0, 1.0], [0.0, 1.0], [0.0, 1.0], [0.0, 1.0]],
        },
    ],
}
CASES = pytest.mark.parametrize("case", PACKAGE["cases"], ids=lambda case: str(np.shape(case["x"])))


class PackageRandom:
    """The package's samples: numpy's older generator, one index per run and task, the matrices in
    turn.
    """

    def __init__(self, *shapes: tuple[int, ...]) -> None:
        state = np.random.RandomState(PACKAGE["seed"])
        draws = [
            [state.randint(0, shape[0], shape) for shape in shapes]
            for _ in range(PACKAGE["samples"])
        ]
        self.drawn = [np.stack(matrix) for matrix in zip(*draws, strict=True)]

    def integers(self, low: int, high: int, size: tuple[int, ...]) -> np.ndarray:
        drawn = self.drawn.pop(0)
        assert drawn.shape == size
        return drawn


@CASES
def test_point_estimates_equal_the_package(case: dict[str, Any]) -> None:
    x = np.array(case["x"])
    y = np.array(case["y"])
    np.testing.assert_allclose(statistics.interquartile_mean(x), case["iqm"], rtol=1e-12)
    improvement = statistics.probability_of_improvement(x, y)
    np.testing.assert_allclose(improvement, case["probability_of_improvement"], rtol=1e-12)


@CASES
def test_intervals_equal_the_package_on_its_own_draws(case: dict[str, Any]) -> None:
    x = np.array(case["x"])
    y = np.array(case["y"])
    samples = PACKAGE["samples"]

    def interval(scores: Any, statistic: Any, random: Any) -> np.ndarray:
        return np.stack(
            statistics.bootstrap_interval(scores, statistic, random, samples=samples), axis=-1
        )

    iqm = interval([x], statistics.interquartile_mean, PackageRandom(x.shape))
    np.testing.assert_allclose(iqm, case["iqm_interval"], rtol=1e-9, atol=1e-12)
    improvement = interval(
        [x, y], statistics.probability_of_improvement, PackageRandom(x.shape, y.shape)
    )
    np.testing.assert_allclose(improvement, case["improvement_interval"], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("scores", [np.zeros(3), np.zeros((0, 2)), np.array([[np.nan]])])
def test_bad_scores_are_refused(scores: np.ndarray) -> None:
    refuses(
        "scores",
        statistics.bootstrap_interval,
        [scores],
        statistics.interquartile_mean,
        np.random.default_rng(0),
    )


def test_normalized_scores_are_fractions_of_a_tasks_range() -> None:
    scores = {"a": np.array([[1.0, 5.0]]), "b": np.array([[3.0, 5.0]])}
    result = statistics.normalize(scores, np.array([1.0, 5.0]), np.array([5.0, 5.0]))
    np.testing.assert_allclose(result["b"], [[0.5, 0.0]])


EVIL = (
    "<script>x</script> <img src=x onerror=y> ![a](b) [c](d) `e` *f* __g__ ~~h~~ | &lt; "
    "$\\bad$ \\ 'i' \"j\""
)


class Seen(HTMLParser):
    """The elements of a text of HTML, and its text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags = set[str]()
        self.text = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.tags.add(tag)

    def handle_data(self, data: str) -> None:
        self.text += data


def test_nothing_is_markup_in_html_and_markdown() -> None:
    markdown_it = pytest.importorskip("markdown_it")
    read = markdown_it.MarkdownIt("commonmark", {"html": True}).enable(["table", "strikethrough"])
    for page, tags in (
        (to_html(EVIL), set()),
        (f'<b title="{to_html(EVIL)}"></b>{to_html(EVIL)}', {"b"}),
        (read.render(to_markdown(EVIL)), {"p"}),
        (read.render(markdown([{"task": EVIL}])), {"table", "thead", "tbody", "tr", "th", "td"}),
    ):
        seen = Seen(page)
        assert seen.tags == tags and EVIL in seen.text


def test_a_terminal_gets_one_printable_line() -> None:
    said = one_line(InputError("runs/\x1b]0;title\x07\n\u202egnp.\udcff: damaged"))
    assert said == "runs/\\x1b]0;title\\x07 \\u202egnp.\\udcff: damaged"
