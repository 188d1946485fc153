"""Sweeps on a probe: what is left, stops at any moment, what is reused. Reports from made-up runs:
same data, same files; figures and tables.

Statistics of few runs.

The statistics are compared with the package `rliable` 1.2.0 on random matrices (`PACKAGE`), which
samples its bootstrap from numpy's global state, seeded before each interval. Names and errors of
others are shown as they are.
"""

import csv
import dataclasses
import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from mqe_jax import names
from mqe_jax.core import version
from mqe_jax.core.errors import InputError, one_line
from mqe_jax.core.files import lock
from mqe_jax.core.literal import to_html, to_markdown
from mqe_jax.core.settings import build, override
from mqe_jax.core.types import Cast
from mqe_jax.policies import zoo
from mqe_jax.presets import Layers, resolve
from mqe_jax.runs import cast
from mqe_jax.study import provenance, statistics
from mqe_jax.study import sweep as sweeps
from mqe_jax.study.estimates import band, group, score_matrices, select_evaluated
from mqe_jax.study.report import markdown, write_report
from mqe_jax.study.runs import REWARD, Cell, Run, read_runs
from mqe_jax.study.sweep import Sweep
from mqe_jax.train.config import TrainConfig
from tests.inputs import refuses
from tests.training import Probe, pay_near_hidden, show_hidden

pytestmark = pytest.mark.usefixtures("shared_programs")


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


# -- sweeps


CONFIGS = Path(__file__).parents[1] / "configs"
PROBE = Probe(show_hidden, pay_near_hidden, num_envs=4)
FILE = """
tasks: [go1gate]
algorithms: [mappo, jrpo]
seeds: [0, 1]
settings:
  num_envs: 4
  total_steps: 48
  rollout_steps: 4
  ppo: {epochs: 1}
  network: {hidden_sizes: [4], recurrent: false, openrl_layers: false}
  checkpoint: {every: 1, environments: false}
  evaluation: {every: 2, episodes: 4}
"""
VARIANTS = FILE + "variants: {plain: {}, scratch: {env: {control: position}}}\n"


def config_of(cell: Cell, layers: Layers) -> TrainConfig:
    return resolve(cell.task, TrainConfig(task=cell.task), cell.algorithm, layers)


def of_train(cell: Cell, layers: Layers) -> TrainConfig:
    return names.settings(cell.task, layers=layers)


def load(tmp_path: Path, text: str = FILE) -> Sweep:
    path = tmp_path / "small.yaml"
    path.write_text(text)
    return sweeps.load_sweep(path)


@pytest.mark.soak
def test_processes_share_a_sweep(tmp_path: Path) -> None:
    sweep = load(tmp_path)
    folder = tmp_path / "study"
    jobs = sweeps.plan(sweep, folder, config_of)
    trained: list[str] = []

    def environments(config: TrainConfig, seeds: int) -> Cast:
        trained.append(config.ppo.ratio)
        return Cast(PROBE, PROBE)

    jobs[0].folders[1].mkdir(parents=True)
    with lock(jobs[0].folders[1]):
        assert sweeps.run(jobs, environments) == (jobs[:1], [])
    assert trained == ["joint"]
    assert sweeps.run(jobs, environments) == ([], [])
    assert trained == ["joint", "dimension"]
    assert sweeps.plan(sweep, folder, config_of) == []


@pytest.mark.soak
def test_a_sweep_that_is_stopped_and_copied_resumes_elsewhere(tmp_path: Path) -> None:
    sweep = load(tmp_path)
    folder = tmp_path / "study"
    there = tmp_path / "there"
    sweep = override(sweep, {"algorithms": ("mappo",), "settings.checkpoint": {"every": 9}})
    sweeps.prepare(sweep, folder)
    asked = iter([False, False, False, True, True])
    jobs = sweeps.plan(sweep, folder, config_of)
    assert sweeps.run(jobs, lambda config, seeds: Cast(PROBE, PROBE), stop=lambda: next(asked)) == (
        [],
        [],
    )
    shutil.copytree(folder, there)
    left = sweeps.plan(sweep, there, config_of)
    assert [job.steps_left for job in left] == [32]
    assert sweeps.run(left, lambda config, seeds: Cast(PROBE, PROBE)) == ([], [])
    for run in read_runs(there):
        assert list(run.curve["env_steps"]) == [16, 32, 48] and len(run.evaluations) == 2


def test_seeds_and_names_of_tasks(tmp_path: Path) -> None:
    text = FILE.replace(
        "settings:", 'settings:\n  opponents: ["{task}", idle]\n  start: "{task}.safetensors"'
    )
    jobs = sweeps.plan(load(tmp_path, text), tmp_path, config_of, ["*/jrpo"], [1])
    assert [folder.name for job in jobs for folder in job.folders] == ["seed1"]
    assert (
        jobs[0].configs[0].opponents == ("go1gate", "idle")
        and jobs[0].configs[0].start == "go1gate.safetensors"
    )
    refuses(
        "seeds: 7 is not allowed; it must be one of the sweep's: 0, 1",
        sweeps.plan,
        load(tmp_path),
        tmp_path,
        config_of,
        (),
        [1, 7],
    )


def test_seeds_that_stopped_at_other_steps_are_trained_alone(tmp_path: Path) -> None:
    sweep = override(load(tmp_path), {"seeds": (0, 1, 2, 3), "algorithms": ("mappo",)})
    for seed, step in ((0, 32), (2, 48), (3, 32)):
        folder = tmp_path / "study" / "runs" / "go1gate" / "mappo" / f"seed{seed}" / "checkpoints"
        folder.mkdir(parents=True)
        (folder / f"step_{step:012}.safetensors").touch()
    jobs = sweeps.plan(sweep, tmp_path / "study", config_of)
    assert [[config.seed for config in job.configs] for job in jobs] == [[2], [0, 3], [1]]


def test_variants_override_the_settings(tmp_path: Path) -> None:
    jobs = sweeps.plan(load(tmp_path, VARIANTS + "seeds_together: 1\n"), tmp_path, config_of)
    assert len(jobs) == 8
    scratch = [job for job in jobs if job.cell.variant == "scratch"]
    assert scratch[0].configs[0].env == {"control": "position"}
    assert scratch[0].folders[0] == tmp_path / "runs" / "go1gate" / "mappo+scratch" / "seed0"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seeds": [0, 0]}, "seeds: .*without repetitions"),
        ({"task": ["go1gate"]}, "task: unknown name .*'tasks'"),
        ({"variants": {"a b": {}}}, r"variants\.a b"),
        ({"variants": {}}, "variants: {}"),
        (
            {"variants": {"a": {"task": "go1tug"}}},
            r"^variants\.a\.task: 'go1tug' is not allowed; it must be left out",
        ),
        ({"settings": {"seed": 3}}, r"^settings\.seed: 3 is not allowed; it must be left out"),
    ],
)
def test_mistakes_are_named(change: dict[str, Any], message: str) -> None:
    refuses(message, build, Sweep, {"tasks": ["go1gate"], **change})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("settings: {ppo: {clips: 1}}\n", r"^settings\.ppo"),
        (
            "variants: {plain: {}, a: {env: {gate_wdth: 1}}}\n",
            r"^go1gate/mappo\+a: gate_wdth.*'gate_width'",
        ),
        ("settings: {train_env: {rewards: {colision: 1}}}\n", r"^go1gate/mappo: rewards\.colision"),
        (
            "variants: {a: {env: {task: go1tug}}}\n",
            r"^variants\.a\.env\.task: is not a task parameter",
        ),
        ("settings: {start: none.safetensors}\n", r"^go1gate/mappo: .*none\.safetensors"),
        (
            f"settings: {{start: {zoo.file_of('go1tug')}}}\n",
            r"^go1gate/mappo: start: .* needs task 'go1tug'",
        ),
        (
            f"settings: {{start: {zoo.file_of('go1gate')}}}\n",
            r"^go1gate/mappo: .* with this run's network",
        ),
        (
            "settings: {num_envs: 7, ppo: {minibatches: 1000}}\n",
            r"^go1gate/mappo: ppo\.minibatches: 1000",
        ),
        ("settings: {opponents: [idle]}\n", r"^go1gate/mappo: opponents"),
        (
            "settings: {train_env: {control: position}}\n",
            r"^go1gate/mappo: train_env\.control: .* env, 'command'",
        ),
        (
            "tasks: [go1tug]\nsettings: {opponents: [older, older], league: {members: 2}}\n",
            r"^go1tug/mappo: league\.members: 2",
        ),
        (
            "tasks: [go1gate, go1tug]\nvariants: {a: {opponents: [nobody]}}\n",
            r"^go1gate/mappo\+a: opponents",
        ),
    ],
)
def test_every_cell_is_checked_before_the_first_trains(
    text: str, message: str, tmp_path: Path
) -> None:
    sweep = load(tmp_path, text if text.startswith("tasks") else "tasks: [go1gate]\n" + text)
    refuses(message, sweeps.plan, sweep, tmp_path, config_of, check=cast.check_start)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda study: (study / "runs").touch(),
            r"run_dir: .*seed0 cannot be written \(Not a directory",
        ),
        (lambda study: (study / "runs/go1gate/jrpo/seed1/a").mkdir(parents=True), None),
        (
            lambda study: (study / "runs/go1gate/jrpo/seed1/a/b").mkdir(parents=True),
            "seed1 holds a but no checkpoint",
        ),
        (
            lambda study: (study / "report").symlink_to("/proc/none"),
            "folder: .*report cannot be written",
        ),
    ],
    ids=["file", "empty folder", "other files", "report"],
)
def test_folders_are_checked_before_the_first_cell_trains(
    make: Any, message: Any, tmp_path: Path, mqe: Any
) -> None:
    load(tmp_path)
    (tmp_path / "study").mkdir()
    make(tmp_path / "study")
    before = sorted(tmp_path.rglob("*"))
    words = f"sweep {tmp_path}/small.yaml --folder {tmp_path}/study --dry-run"
    assert re.search(message or "^$", mqe(words, code=2 if message else 0).err)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("file", "part", "cell", "seed"),
    [
        ("zoo", "published", "go1seesaw/*", 10),
        pytest.param("zoo", "matches", "go1bridge/*", 10, marks=pytest.mark.soak),
        *(
            ("levers", task, "*", 0)
            for task in ("go1gate", "go1seesaw", "go1sheep-easy", "go1pushbox")
        ),
    ],
)
def test_published_sweeps_can_be_planned_on_a_gpu(
    file: str, part: str, cell: str, seed: int, monkeypatch: Any
) -> None:
    monkeypatch.setattr("jax.default_backend", lambda: "gpu")
    folder = CONFIGS if file == "zoo" else CONFIGS.parent / "lab"
    sweep = sweeps.load_sweep(folder / f"{file}.yaml", part)
    assert sweeps.plan(sweep, CONFIGS, of_train, [cell], [seed], check=cast.check_start)


def test_a_cell_that_fails_is_named_and_the_others_are_trained(
    tmp_path: Path, monkeypatch: Any, mqe: Any
) -> None:
    load(tmp_path)
    trained: list[str] = []

    def train(made: Cast, configs: list[TrainConfig], *given: object, **named: object) -> None:
        if configs[0].ppo.ratio == "dimension":
            raise InputError("opponents: this one cannot be read")
        trained.append(configs[0].ppo.ratio)

    monkeypatch.setattr(cast, "environments", lambda *_, **named: Cast(PROBE, PROBE))
    monkeypatch.setattr(sweeps, "train_seeds", train)
    monkeypatch.setattr("mqe_jax.study.report.report", lambda folder: [])
    said = mqe(f"sweep {tmp_path}/small.yaml --folder {tmp_path}/study", code=2).err
    assert trained == ["joint"]
    assert said.splitlines() == [
        "mqe: go1gate/mappo failed: opponents: this one cannot be read",
        "mqe: cells: 1 of 2 trainings failed: go1gate/mappo",
    ]


def test_cells_are_selected_by_name_or_pattern(tmp_path: Path) -> None:
    sweep = load(tmp_path, VARIANTS)

    def names(*patterns: str) -> list[str]:
        return [
            job.cell.path.as_posix() for job in sweeps.plan(sweep, tmp_path, config_of, patterns)
        ]

    assert names() == [
        "go1gate/mappo",
        "go1gate/mappo+scratch",
        "go1gate/jrpo",
        "go1gate/jrpo+scratch",
    ]
    assert names("go1gate/jrpo") == ["go1gate/jrpo"]
    assert names("go1gate/jrpo+scratch", "*/mappo") == ["go1gate/mappo", "go1gate/jrpo+scratch"]
    refuses(
        r"cells: 'go1gate/mapo' matches no cell \(did you mean 'go1gate/mappo'\?\)",
        names,
        "*/mappo",
        "go1gate/mapo",
    )


def test_the_commands_say_what_is_left_and_report(
    tmp_path: Path, monkeypatch: Any, mqe: Any
) -> None:
    load(tmp_path)
    monkeypatch.setattr(cast, "environments", lambda *_, **named: Cast(PROBE, PROBE))
    study = tmp_path / "study"
    sweep = f"sweep {tmp_path}/small.yaml --folder {study}"
    out = mqe(f"{sweep} --dry-run").out
    assert "go1gate jrpo plain" in out and "time unknown" in out and not study.exists()
    for cells in ("--cells */mappo", ""):
        assert json.loads(mqe(f"{sweep} --json {cells}").out)["left"]["jobs"] == []
        done = [run.cell.algorithm for run in read_runs(study)]
        assert done == (["mappo"] * 2 if cells else ["jrpo"] * 2 + ["mappo"] * 2)
    report = study / "report" / "report.md"
    text = report.read_text()
    assert "| go1gate | mappo |" in text and "| go1gate | jrpo |" in text
    report.unlink()
    mqe(f"report {study}")
    assert report.read_text() == text
    (tmp_path / "small.yaml").write_text("tasks: [go1gat]")
    assert "did you mean 'go1gate'" in mqe(sweep, code=2).err


def test_one_file_may_hold_several_sweeps(tmp_path: Path) -> None:
    path = tmp_path / "sweeps.yaml"
    path.write_text("first: {tasks: [go1gate]}\nsecond: {tasks: [go1tug]}")
    assert sweeps.load_sweep(path, "second").tasks == ("go1tug",)
    refuses(
        r"has no part 'secnd' \(did you mean 'second'\?\); it has: first, second",
        sweeps.load_sweep,
        path,
        "secnd",
    )


# -- results are reused only if they come from the same settings, files and version


USUAL: dict[str, Any] = {"num_envs": 8, "rollout_steps": 8, "ppo": {"clip": 0.2}}


@dataclasses.dataclass
class Study:
    """A sweep with a file of settings, whose trainings write an empty policy."""

    folder: Path

    def edit(self, **changes: Any) -> None:
        """Writes the file of settings."""
        values = {**USUAL, "start": str(self.folder / "start"), "train_env": {"friction": 1}}
        (self.folder / "own.yaml").write_text(yaml.safe_dump(values | changes))

    def plan(self) -> list[sweeps.Job]:
        """Returns the jobs that are left."""
        config = str(self.folder / "own.yaml")
        names = {"tasks": ["go1gate"], "algorithms": ["default"], "seeds": [0], "config": config}

        def settings(cell: Cell, layers: Layers) -> TrainConfig:
            return resolve(cell.task, config, None, layers)

        return sweeps.plan(build(sweeps.Sweep, names), self.folder, settings)

    def run(self, jobs: list[sweeps.Job]) -> list[str]:
        """Trains jobs; returns the errors of those that failed."""
        return [str(error) for _, error in sweeps.run(jobs, lambda *_: Cast(None)).failed]


@pytest.fixture
def study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Study:
    def write(cast: Cast, configs: Any, run_dirs: list[Path], **_: Any) -> None:
        for run in run_dirs:
            (run / "checkpoints").mkdir(parents=True)
            (run / "checkpoints" / "step_000000000064.safetensors").touch()
            (run / "policy.safetensors").touch()

    monkeypatch.setattr(sweeps, "train_seeds", write)
    made = Study(tmp_path)
    made.edit()
    (tmp_path / "start").write_text("old")
    return made


CHANGES: dict[str, tuple[Any, str]] = {
    "setting": (lambda x, _: x.edit(ppo={"clip": 0.1}), r"ppo\.clip: 0\.1 differs from 0\.2"),
    "parameter": (
        lambda x, _: x.edit(train_env={"friction": 2}),
        r"train_env\.friction: 2 differs",
    ),
    "no parameter": (
        lambda x, _: x.edit(train_env={}),
        r"train_env\.friction: None differs from 1",
    ),
    "episodes": (
        lambda x, _: x.edit(evaluation={"episodes": 64}),
        r"evaluation\.episodes: 64 differs from 32",
    ),
    "steps": (lambda x, _: x.edit(total_steps=640), "total_steps: 640 differs"),
    "policy file": (
        lambda x, _: (x.folder / "start").write_text("new"),
        "start: has changed since",
    ),
    "version": (
        lambda _, patch: patch.setattr(version, "__version__", "9.9"),
        r"version: '9\.9' differs",
    ),
    "version 0.3": (
        lambda x, _: (x.folder / "runs/go1gate/default/provenance.json").unlink(),
        r"its runs are of version 0\.3 or before",
    ),
}


@pytest.mark.parametrize("change", CHANGES)
def test_runs_of_other_settings_files_or_versions_are_not_reused(
    change: str, study: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert study.run(study.plan()) == []
    study.plan()
    make, message = CHANGES[change]
    make(study, monkeypatch)
    refuses(f"^go1gate/default: .*{message}.* name another folder$", study.plan)


def test_damaged_provenance_is_named(study: Study) -> None:
    assert study.run(study.plan()) == []
    (file,) = study.folder.rglob(sweeps.PROVENANCE)
    for content in ("{", "[]", "3"):
        file.write_text(content)
        refuses(rf"^go1gate/default: {file}: damaged, or not ", study.plan)


def test_of_two_processes_the_one_that_trains_first_settles_the_settings(study: Study) -> None:
    before = study.plan()
    study.edit(ppo={"clip": 0.1})
    assert study.run(study.plan()) == []
    (error,) = study.run(before)
    assert error.startswith("ppo.clip: 0.2 differs from 0.1 of the results in ")


def test_files_and_policies_of_run_folders_are_told_from_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for folder in ("run", "empty", "go1gate"):
        Path(folder).mkdir()
    for file in ("run/policy.safetensors", "go1gate/policy.safetensors", "weights"):
        Path(file).write_text("a")
    shipped = str(zoo.file_of("go1gate"))
    values = {"task": "go1gate", "start": "run", "env": {"skill_weights": "weights"}}
    values |= {"opponents": ["idle", "empty", "none", "", "x" * 300, "\0"], "seed": 1}
    assert {*provenance.digests(values)} == {"run", "weights"}
    assert provenance.digests({"start": "go1gate"})["go1gate"] == provenance.digest(shipped)


def test_a_result_comes_from_all_files_of_a_robot(tmp_path: Path) -> None:
    robot = tmp_path / "dog.xml"
    robot.write_bytes(Path("examples/robots/dog.xml").read_bytes())
    found = []
    for speed in (20, 30):
        (tmp_path / "dog.yaml").write_text(f"speed: {speed}")
        found.append(provenance.digests({"env.robot": str(robot)})[str(robot)])
    assert found[0] != found[1]


def test_a_result_of_a_shipped_policy_comes_from_its_contents(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zoo, "FOLDER", tmp_path)
    assert provenance.digests({"policy": "go1gate"}) == {}
    found = []
    for content in (b"one", b"other"):
        (tmp_path / "go1gate.safetensors").write_bytes(content)
        found.append(provenance.digests({"policy": "go1gate"})["go1gate"])
    assert found[0] != found[1]
