"""The table of what a laptop reaches: its data, and the command that measures it and resumes."""

import json
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


def test_page_and_package_have_the_measured_levels() -> None:
    found = laptop.levels()
    page = laptop.PAGE.read_text("utf-8")
    assert filled(page, {"levels": laptop.markdown(found)}) == page, "python -m lab.laptop --table"
    assert json.loads(laptop.LEVELS.read_text("utf-8")) == found
    assert {*load_sweep(laptop.FILE).tasks} == {*found}


def test_a_task_without_a_time_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = "go1gate,0,64,24,256,0.5,0.4,0.6,x\ngo1gate,1,64,nan,256,1,0.9,1,x\n"
    head = "task,seed,env_steps,processor_minutes,episodes,rate,low,high,source\n"
    file = tmp_path / "laptop.csv"
    file.write_text(f"{head}{rows}go1tug,0,64,nan,256,1,0.9,1,x\n")
    monkeypatch.setattr(laptop, "LAPTOP", file)
    table = laptop.markdown(laptop.levels()).splitlines()
    assert len(table) == 3 and table[2].startswith("| `go1gate` | 12 | 75.0 (50.0 to 100) | 5.7 |")


def test_a_second_call_measures_only_new_teams(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
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
    file = tmp_path / "laptop.csv"
    file.write_text("task,seed,env_steps,processor_minutes,episodes,rate,low,high,source\n")
    monkeypatch.setattr(laptop, "LAPTOP", file)
    tasks = ("go1gate", "go1tug")
    run = tmp_path / "runs"
    assert [row["task"] for row in laptop.train(tmp_path, 1, tasks)] == ["go1gate"]
    trained.append("go1tug")
    rows = laptop.train(tmp_path, 1, tasks)
    assert evaluated == [
        ("go1gate", f"{run}/go1gate/default/seed1", None, "first", 256),
        ("go1tug", f"{run}/go1tug/default/seed1", "scripted", "both", 256),
    ]
    for _ in range(2):
        laptop.keep(rows)
    kept = laptop.read(file)
    assert [(row["task"], row["processor_minutes"]) for row in kept] == [
        ("go1gate", 1.5),
        ("go1tug", 1.5),
    ]
