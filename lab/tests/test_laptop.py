"""The table of what a laptop reaches: its data, and the command that measures it and resumes."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from lab import laptop
from lab.paper_page import filled
from mqe_jax.core.errors import InputError
from mqe_jax.runs import playing
from mqe_jax.study.sweep import load_sweep

METRICS = "env_steps,average_step_reward,processor_seconds\n64,0.5,60\n128,0.6,30\n"


HEAD = "task,seed,env_steps,processor_minutes,episodes,rate,low,high,source\n"


@pytest.fixture
def results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of results, without those of a laptop."""
    shutil.copy(laptop.RESULTS / "trainings.csv", tmp_path)
    monkeypatch.setattr(laptop, "RESULTS", tmp_path)
    return tmp_path


def test_pages_and_package_have_the_measured_levels() -> None:
    for section, table in laptop.tables().items():
        page = laptop.PAGES[section].read_text("utf-8")
        assert filled(page, {section: table}) == page, "run python -m lab.laptop --table"
    assert json.loads(laptop.LEVELS.read_text("utf-8")) == laptop.levels()


def test_sweeps_have_the_settings_that_they_are_named_after() -> None:
    for name in laptop.CONFIGS:
        sweep = load_sweep(laptop.ROOT / "lab" / f"{name}.yaml")
        assert (sweep.config, sweep.seeds_together) == (name, 1)
        assert {*laptop.levels()} >= {*sweep.tasks}


def test_a_task_without_a_time_is_left_out(results: Path) -> None:
    rows = "go1gate,0,64,24,256,0.5,0.4,0.6,x\ngo1gate,1,64,nan,256,1,0.9,1,x\n"
    (results / "laptop.csv").write_text(f"{HEAD}{rows}go1tug,0,64,nan,256,1,0.9,1,x\n")
    table = laptop.markdown(laptop.levels()).splitlines()
    assert len(table) == 3 and table[2] == "| `go1gate` | 12 | 75.0 | 50.0 of 2 |"
    slower = rows.replace(",x\n", ",other machine\n")
    (results / "laptop.csv").write_text(HEAD + slower)
    assert "| 12* |" in laptop.markdown(laptop.levels())


def test_a_second_call_measures_only_new_teams(
    tmp_path: Path, results: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    evaluated: list[Any] = []
    trained = ["go1gate"]

    def sweep(file: Path, folder: Path, *, dry_run: bool = False, **options: Any) -> None:
        if dry_run:
            return
        for task in trained:
            run = folder / "runs" / task / "default" / "seed1"
            run.mkdir(parents=True, exist_ok=True)
            (run / "metrics.csv").write_text(METRICS)
        raise InputError("cells: 1 of 2 trainings failed")

    def evaluate(
        task: str,
        policy: str,
        opponent: Any = None,
        *,
        impl: str,
        episodes: int,
        sides: str = "first",
    ) -> Any:
        evaluated.append((task, policy, opponent, sides, episodes))
        rate = "success_rate" if opponent is None else "win_rate"
        found = {rate: 0.5, "episodes": episodes, "intervals": {rate: [0.4, 0.6]}}
        return SimpleNamespace(to_dict=lambda: found)

    monkeypatch.setattr(laptop, "sweep", sweep)
    monkeypatch.setattr(laptop, "is_finished", lambda run: (run / "metrics.csv").is_file())
    monkeypatch.setattr(playing, "evaluate", evaluate)
    table = results / "laptop.csv"
    table.write_text(HEAD)
    file = laptop.ROOT / "lab" / "laptop.yaml"
    tasks = ("go1gate", "go1tug")
    run = tmp_path / "runs"
    assert [row["task"] for row in laptop.train(file, tmp_path, 1, tasks)] == ["go1gate"]
    trained.append("go1tug")
    rows = laptop.train(file, tmp_path, 1, tasks)
    assert evaluated == [
        ("go1gate", f"{run}/go1gate/default/seed1", None, "first", 256),
        ("go1tug", f"{run}/go1tug/default/seed1", "scripted", "both", 256),
    ]
    for _ in range(2):
        laptop.keep(table, rows)
    kept = laptop.read(table)
    assert [(row["task"], row["processor_minutes"]) for row in kept] == [
        ("go1gate", 1.5),
        ("go1tug", 1.5),
    ]
