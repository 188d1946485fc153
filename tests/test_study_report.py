"""Reports from made-up raw data: same data, same files; figures, tables and the paper's values."""

from __future__ import annotations

import csv
import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest

from mqe_jax.errors import InputError
from mqe_jax.study import paper
from mqe_jax.study.estimates import band, comparison, evaluated, group, score_matrices
from mqe_jax.study.records import MAX_COLUMNS, MAX_ROWS, Cell, Record, read_records, thin, write_record
from mqe_jax.study.report import report


def made_up(cell: Cell, seed: int, *, ended: bool = True, scale: float = 1.0) -> Record:
    """A run of 400 updates that learns along a saturating curve, with noise of its own."""
    draw = np.random.default_rng([seed, len(cell.algorithm), len(cell.task)])
    steps = np.arange(1, 401) * 100_000.0
    reached = scale * (1 - np.exp(-steps / 1e7)) * (0.8 + 0.1 * draw.normal()) + 0.03 * draw.normal(size=400)
    curve = {
        "env_steps": steps,
        "updates": steps / 100_000,
        "seconds": steps / 5e4,
        _REWARD: reached,
        "success": np.where(np.arange(400) % 7, reached, math.nan),
        "reward/approach": 0.1 * np.exp(-steps / 1e7),
        "reward/success": 0.9 * reached,
        **{f"reward/small{i}": np.full(400, 1e-6 * i) for i in range(8)},
    }
    point = {"episodes": 32, "sampled": {_REWARD: reached[-1], "success_rate": 0.5}, "deterministic": {_REWARD: 0.1}}
    evaluations = [{"env_steps": 20_000_000, **point}, {"env_steps": 40_000_000, **point}]
    absolute = {"env_steps": 40_000_000, **point, "episodes": 320} if ended else None
    return Record(cell, seed, curve, {"evaluations": evaluations, "absolute": absolute})


_REWARD = "average_step_reward"


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study of two tasks, three algorithms and three seeds, reported once."""
    folder = tmp_path_factory.mktemp("study")
    for task in ("go1gate", "go1sheep-hard"):
        for scale, algorithm in enumerate(("mappo", "jrpo", "mat"), start=2):
            for seed in range(3):
                write_record(folder, made_up(Cell(task, algorithm), seed, scale=scale))
    report(folder)
    return folder


def test_raw_data_are_small_and_keep_the_largest_terms(study: Path) -> None:
    path = study / "raw" / "go1gate" / "mappo" / "seed0.csv"
    rows = list(csv.reader(path.open()))
    assert len(rows) == MAX_ROWS + 1 and len(rows[0]) <= MAX_COLUMNS
    assert {"reward/approach", "reward/success"} <= set(rows[0]) and "updates" not in rows[0]
    assert (
        max(len(item.lstrip("-").replace(".", "").split("e")[0].lstrip("0")) for row in rows[1:] for item in row[2:])
        <= 5
    )


def test_thinning_keeps_ends_and_means() -> None:
    curve = thin({"env_steps": np.arange(1.0, 201.0), _REWARD: np.arange(200.0), "success": np.full(200, math.nan)})
    assert curve["env_steps"][0] == 4 and curve["env_steps"][-1] == 200
    assert curve[_REWARD][0] == 1.5 and np.isnan(curve["success"]).all()
    short = thin({"env_steps": np.array([5.0, 9.0]), _REWARD: np.array([1.0, 2.0])})
    np.testing.assert_array_equal(short[_REWARD], [1.0, 2.0])


def test_the_same_data_give_the_same_files(study: Path) -> None:
    before = {path.name: path.read_bytes() for path in (study / "report").iterdir()}
    report(study)
    after = {path.name: path.read_bytes() for path in (study / "report").iterdir()}
    assert after == before
    assert {"curves.png", "final.csv", "report.md", "gate_terms.png", "profiles.png", "marl_eval.json"} <= set(after)


def test_final_values_stand_beside_the_papers(study: Path) -> None:
    rows = list(csv.DictReader((study / "report" / "final.csv").open()))
    assert len(rows) == 6
    gate = next(row for row in rows if row["task"] == "go1gate" and row["algorithm"] == "mappo")
    records = [record for record in read_records(study) if record.cell == Cell("go1gate", "mappo")]
    ends = sorted(record.curve[_REWARD][-1] for record in records)
    assert float(gate["training"]) == pytest.approx(np.mean(ends), rel=1e-4)
    assert float(gate["training_low"]) <= float(gate["training"]) <= float(gate["training_high"])
    assert float(gate["paper"]) == 2.75 and gate["seeds"] == "3"
    assert "2.75" in (study / "report" / "report.md").read_text()


def test_the_better_algorithm_wins_the_aggregate(study: Path) -> None:
    rows = {row["algorithm"]: row for row in csv.DictReader((study / "report" / "aggregate.csv").open())}
    assert float(rows["mat"]["iqm"]) > float(rows["mappo"]["iqm"])
    pairs = list(csv.DictReader((study / "report" / "improvement.csv").open()))
    chance = {(row["first"], row["second"]): float(row["probability"]) for row in pairs}
    assert chance["mat", "mappo"] == 1.0 and chance["mappo", "mat"] == 0.0


def test_aggregates_need_half_of_the_tasks() -> None:
    tasks = ("go1gate", "go1seesaw", "go1pushbox")
    cells = {cell: [made_up(cell, 0), made_up(cell, 1)] for cell in (Cell(task, "mappo") for task in tasks)}
    for task in tasks[:2]:
        assert score_matrices(cells, "hierarchical") == {}
        cells[Cell(task, "mat")] = [made_up(Cell(task, "mat"), seed) for seed in range(2)]
    assert score_matrices(cells, "hierarchical")["mat"].shape == (2, 2)


def test_the_appendix_figure_ends_at_20_million_steps(study: Path) -> None:
    rows = list(csv.DictReader((study / "report" / "gate_terms.csv").open()))
    assert {row["term"] for row in rows} == set(paper.GATE_TERMS)
    assert max(float(row["env_steps"]) for row in rows) == paper.GATE_STEPS


def test_a_band_ends_where_the_shortest_seed_does(tmp_path: Path) -> None:
    long, short = made_up(Cell("go1gate", "mat"), 0), made_up(Cell("go1gate", "mat"), 1)
    short = Record(short.cell, 1, {name: x[:100] for name, x in short.curve.items()}, short.evaluation)
    steps, middle, low, high = band([long, short])
    assert steps[-1] == 10_000_000 and len(middle) == len(steps) and (low <= high).all()


def test_runs_without_evaluation_and_single_seeds_are_reported(tmp_path: Path) -> None:
    write_record(tmp_path, made_up(Cell("go1gate", "mappo", "scratch"), 0, ended=False))
    files = {path.name for path in report(tmp_path)}
    assert "marl_eval.json" not in files and "profiles.png" not in files
    row = next(csv.DictReader((tmp_path / "report" / "final.csv").open()))
    assert row["absolute"] == "nan" and row["paper"] == "0" and row["training"] == row["training_low"]


def test_bad_raw_data_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no raw/TASK"):
        report(tmp_path)
    write_record(tmp_path, made_up(Cell("go1gate", "mappo"), 0))
    path = tmp_path / "raw" / "go1gate" / "mappo" / "seed0"
    path.with_suffix(".csv").write_text("env_steps\nhello\n")
    with pytest.raises(InputError, match=r"seed0\.csv: is not a metrics"):
        report(tmp_path)
    path.with_suffix(".json").write_text(json.dumps({"task": "go1gate"}))
    with pytest.raises(InputError, match=r"seed0\.json: is not the record"):
        report(tmp_path)


def test_every_task_of_the_figure_has_the_papers_values() -> None:
    for setting in (paper.HIERARCHICAL, paper.SCRATCH):
        assert list(paper.VALUES[setting]) == list(paper.TITLES)
    assert paper.value(paper.SCRATCH, "go1seesaw", "mat") == 0.07
    assert paper.value("scratch-bounded", "go1seesaw", "mappo") == 0.15
    assert paper.value("tuned", "go1seesaw", "mappo") == 0.73
    assert paper.value(paper.HIERARCHICAL, "go1tug", "mat") is None


def test_the_committed_report_is_remade_from_its_raw_data(tmp_path: Path) -> None:
    """Tables byte for byte; figures are drawn from the same tables, and their bytes depend on matplotlib's version."""
    sweep = Path(__file__).parent.parent / "results" / "sweep" / "killed"
    shutil.copytree(sweep / "raw", tmp_path / "raw")
    files = report(tmp_path)
    assert {file.name for file in files} == {file.name for file in (sweep / "report").iterdir()}
    for file in files:
        if file.suffix != ".png":
            assert file.read_bytes() == (sweep / "report" / file.name).read_bytes(), file.name


def test_other_settings_are_compared_by_their_evaluations(tmp_path: Path) -> None:
    """Training rewards may include shaping: tuned cells are drawn and compared by evaluations of the plain task."""
    write_record(tmp_path, made_up(Cell("go1gate", "mappo"), 0))
    for seed, score in enumerate((3.2, 3.4, 3.6)):
        record = made_up(Cell("go1gate", "mat", "tuned"), seed, scale=100.0)
        point = {"episodes": 32, "sampled": {_REWARD: score, "success_rate": 0.5}, "deterministic": {_REWARD: 0.1}}
        points = [{"env_steps": 20_000_000, **point}, {"env_steps": 40_000_000, **point}]
        evaluation = {"evaluations": points, "absolute": points[0]}
        write_record(tmp_path, Record(record.cell, seed, record.curve, evaluation))
    files = {path.name for path in report(tmp_path)}
    assert {"curves.png", "evaluations.png", "comparison.csv"} <= files
    rows = list(csv.DictReader((tmp_path / "report" / "comparison.csv").open()))
    assert [(row["setting"], row["compared"]) for row in rows] == [("hierarchical", "training"), ("tuned", "absolute")]
    assert rows[1]["paper"] == "3.1" and rows[1]["ours"] == "above"
    assert rows[0]["ours"] == ""  # a single seed
    (cell,) = evaluated({cell: runs for cell, runs in group(read_records(tmp_path)).items() if cell.setting == "tuned"})
    assert cell.algorithm == "mat"


def test_settings_from_scratch_are_not_drawn_beside_those_with_the_walk_policy(tmp_path: Path) -> None:
    write_record(tmp_path, made_up(Cell("go1gate", "mappo"), 0))
    record = made_up(Cell("go1gate", "mappo", "scratch-bounded"), 0)
    point = {"episodes": 32, "sampled": {_REWARD: 0.1, "success_rate": 0.0}, "deterministic": {_REWARD: 0.1}}
    points = [{"env_steps": steps, **point} for steps in (20_000_000, 40_000_000)]
    write_record(tmp_path, Record(record.cell, 0, record.curve, {"evaluations": points, "absolute": points[0]}))
    assert "evaluations.png" not in {path.name for path in report(tmp_path)}
    rows = list(csv.DictReader((tmp_path / "report" / "comparison.csv").open()))
    assert [row["paper"] for row in rows] == ["2.75", "0"]


@pytest.mark.parametrize(
    ("low", "middle", "high", "verdict"),
    [
        (3.2, 3.3, 3.4, "above"),
        (3.0, 3.3, 3.4, "above, within the interval"),
        (1.0, 2.0, 3.4, "below, within the interval"),
        (1.0, 2.0, 3.0, "below"),
        (math.nan, math.nan, math.nan, ""),
    ],
)
def test_verdicts(low: float, middle: float, high: float, verdict: str) -> None:
    columns = {"setting": ["hierarchical"], "seeds": [3], "paper": [3.1], "training": [middle]}
    finals = {**columns, "training_low": [low], "training_high": [high]}
    assert comparison(finals) == {"compared": ["training"], "ours": [verdict]}


def test_a_reward_term_that_a_seed_never_gets_is_zero(tmp_path: Path) -> None:
    for seed in (0, 1):
        record = made_up(Cell("go1gate", "mappo"), seed)
        curve = {**record.curve, "reward/success": record.curve["reward/success"] * seed}
        write_record(tmp_path, Record(record.cell, seed, curve, record.evaluation))
    records = read_records(tmp_path)
    assert "reward/success" not in records[0].curve
    _, middle, _, _ = band(records, "reward/success")
    np.testing.assert_allclose(middle, records[1].curve["reward/success"] / 2)
    assert "gate_terms.csv" in {path.name for path in report(tmp_path)}
