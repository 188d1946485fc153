"""Measurements of policies, and the published ones."""

import csv
import itertools
import json
import pkgutil
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from lab import measure as measuring
from mqe_jax.core.settings import build
from mqe_jax.runs import exploiting, playing, sweeping
from mqe_jax.study import sweep as sweeps
from tests.inputs import refuses

ROOT = Path(__file__).parents[2]
FILE = ROOT / "lab" / "strength.yaml"
MEASURES = """
rates:
  measure: evaluate
  tasks: [go1gate, go1tug]
  arguments: {policy: "{task}", episodes: 100}
  variants:
    scripted: {opponent: scripted}
    heavy: {env: {robot: go2, randomization.payload: [3, 3]}}
"""


def test_a_part_measures_policies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[Any] = []

    def evaluate(
        task: str,
        policy: Any = None,
        opponent: Any = None,
        *,
        env: Any = None,
        episodes: int,
        impl: str,
    ) -> Any:
        calls.append((task, policy, opponent, env, impl))
        if len(calls) == 2:
            raise KeyboardInterrupt
        found = {"win_rate": 0.5, "episodes": episodes, "intervals": {"win_rate": [0.4, 0.6]}}
        return SimpleNamespace(to_dict=lambda: found)

    monkeypatch.setattr(playing, "evaluate", evaluate)
    file = tmp_path / "strength.yaml"
    folder = tmp_path / "out"
    file.write_text(MEASURES)

    def run(*words: str) -> None:
        words = (str(file), "--part", "rates", "--folder", str(folder), "--impl", "c", *words)
        monkeypatch.setattr("sys.argv", ["measure", *words])
        measuring.main()

    with pytest.raises(KeyboardInterrupt):
        run()
    run()
    run()
    assert calls[0] == ("go1gate", "go1gate", "scripted", None, "c") and len(calls) == 5
    task, policy, _, env, _ = calls[-1]
    assert (task, policy, env["robot"]) == ("go1tug", "go1tug", "go2")
    (folder / "results" / "go1tug" / "heavy" / "result.json").unlink()
    run("--cells", "*/scripted")
    assert len(calls) == 5
    run("--cells", "go1tug/*")
    assert len(calls) == 6
    rows = list(csv.DictReader((folder / "rates.csv").open()))
    assert [(row["task"], row["variant"]) for row in rows] == list(
        itertools.product(("go1gate", "go1tug"), ("scripted", "heavy"))
    )
    shown = [rows[0][name] for name in ("rate", "value", "low", "high")]
    assert shown == ["win_rate", "0.5", "0.4", "0.6"]


def test_unknown_cells_and_parts_are_named(tmp_path: Path) -> None:
    file = tmp_path / "strength.yaml"
    file.write_text(MEASURES)
    part = measuring.load(file, "rates")
    refuses(
        r"'go1tug/heavi' matches no cell \(did you mean",
        measuring.measure,
        part,
        tmp_path,
        cells=["go1tug/heavi"],
    )
    refuses("has no part 'rate'", measuring.load, file, "rate")
    file.write_text("tasks: [go1gate]")
    refuses(r"strength\.yaml: measure: ", measuring.load, file)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            "measure: evaluates",
            "measure: 'evaluates' is not allowed; it must be one of evaluate, tournament",
        ),
        ("tasks: [go1gat]", "did you mean 'go1gate'"),
        (
            "arguments: {episode: 3}",
            "arguments.episode: 3 is not allowed; it must be an argument of evaluate: task, policy",
        ),
        (
            "by_task: {go1tug: {episodes: 64}}",
            "by_task: 'go1tug' is not allowed; it must be one of the part's tasks: go1g",
        ),
        (
            "by_task: {go1gate: 64}",
            "by_task.go1gate: 64 is not allowed; it must be a mapping of arguments",
        ),
        (
            "variants: {/tmp/up: {}}",
            "variants./tmp/up: {} is not allowed; it must be a mapping of settings, under a name",
        ),
        (
            "arguments: {dump_diverged: up}",
            "arguments.dump_diverged: 'up' is not allowed; it must be left out",
        ),
        (
            "arguments: {policy: ['no/*']}",
            "arguments.policy: 'no/*' is not allowed; it must be a pattern of files that",
        ),
    ],
)
def test_measurements_that_cannot_be_made_are_named(
    tmp_path: Path, change: str, message: str
) -> None:
    part = {"measure": "evaluate", "tasks": ["go1gate"], **yaml.safe_load(change)}
    refuses(
        re.escape(message),
        lambda: measuring.plan(build(measuring.Measurement, part), tmp_path),
    )


def test_arguments_of_a_task_override_the_parts_and_patterns_stand_for_files(
    tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("go1gate-seed1", "go1gate-seed0", "go1tug-seed0"):
        Path(name).touch()
    part = {
        "measure": "tournament",
        "tasks": ["go1gate", "go1tug"],
        "arguments": {"policies": ["{task}-*"], "seed": 3},
    }
    part |= {
        "by_task": {"go1tug": {"policies": ["{task}", "{task}-*"], "episodes": 64}},
        "variants": {"v": {"seed": 4}},
    }
    gate, tug = (
        item.arguments for item in measuring.plan(build(measuring.Measurement, part), tmp_path)
    )
    assert gate == {"impl": "auto", "policies": ["go1gate-seed0", "go1gate-seed1"], "seed": 4}
    assert tug == {
        "impl": "auto",
        "policies": ["go1tug", "go1tug-seed0"],
        "seed": 4,
        "episodes": 64,
    }


@pytest.mark.parametrize(
    "change",
    [
        lambda kept: [],
        lambda kept: {**kept, "result": [1]},
        lambda kept: {**kept, "result": {"intervals": {"win_rate": 3}}},
        lambda kept: {name: value for name, value in kept.items() if name != "result"},
    ],
)
def test_a_damaged_result_is_named(
    change: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    part = build(measuring.Measurement, {"measure": "evaluate", "tasks": ["go1gate"]})
    (item,) = measuring.plan(part, tmp_path)
    item.file.parent.mkdir(parents=True)
    item.file.write_text(json.dumps(change(item.provenance)))
    refuses(r"result\.json: damaged, or not a result", measuring.measure, part, tmp_path)


def published(part: str) -> measuring.Measurement:
    return measuring.load(FILE, part)


def test_published_parts_name_files_and_arguments_that_exist(monkeypatch: Any) -> None:
    monkeypatch.chdir(ROOT)
    for part, content in yaml.safe_load(FILE.read_text("utf-8")).items():
        if "measure" in content:
            assert measuring.plan(published(part), Path("none"))
        else:
            assert sweeps.load_sweep(FILE, part).tasks


class Started(Exception):
    """Ends a measurement at its first training."""


@pytest.mark.parametrize(
    ("part", "tasks"),
    [
        ("exploitability", ["go1tug"]),
        pytest.param("exploitability", ["*"], marks=pytest.mark.soak),
    ],
)
def test_published_trainings_can_start(
    part: str, tasks: list[str], monkeypatch: Any, tmp_path: Path
) -> None:
    """They are planned and checked with all of their settings, but not begun."""
    monkeypatch.chdir(ROOT)
    plan = sweeping._run
    begun = []

    def start(*options: Any) -> Any:
        begun.extend(plan(*options, dry_run=True)["left"]["jobs"])
        raise Started

    monkeypatch.setattr(sweeping, "_run", start)
    monkeypatch.setattr(exploiting, "_meet", lambda *given: np.ones((len(given[2]), 3), int))
    settings = published(part)
    for item in measuring.plan(settings, tmp_path, impl="c"):
        if item.task in tasks or tasks == ["*"]:
            with pytest.raises(Started):
                pkgutil.resolve_name(measuring.MEASURES[settings.measure])(
                    item.task, **item.arguments
                )
    assert {job["task"] for job in begun} == set(settings.tasks if tasks == ["*"] else tasks)
    assert all(job["steps_left"] >= 5_000_000 for job in begun)


def test_a_measurement_that_trains_has_a_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = {"exploitability_lower_bound": {"value": 0.2}}
    monkeypatch.setattr(
        exploiting, "exploitability", lambda task, policy, folder, impl: {**found, "folder": folder}
    )
    part = {"measure": "exploitability", "tasks": ["go1tug"], "arguments": {"policy": "{task}"}}
    measuring.measure(build(measuring.Measurement, part), tmp_path)
    place = tmp_path / "results" / "go1tug" / "plain"
    assert json.loads((place / "result.json").read_text())["result"] == {
        **found,
        "folder": str(place / "runs"),
    }


def test_a_measurement_of_another_file_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = tmp_path / "policy"
    seen = []

    def evaluate(task: str, policy: str, *, impl: str) -> Any:
        seen.append(Path(policy).read_text())
        found = {"success_rate": 0.5, "intervals": {"success_rate": [0.4, 0.6]}}
        return SimpleNamespace(to_dict=lambda: found)

    monkeypatch.setattr(playing, "evaluate", evaluate)
    part = {"measure": "evaluate", "tasks": ["go1gate"], "arguments": {"policy": str(policy)}}
    part |= {"variants": {"one": {}, "other": {}}}
    for text, cells in (("a", []), ("a", []), ("b", ["*/one"])):
        policy.write_text(text)
        measuring.measure(build(measuring.Measurement, part), tmp_path / "out", cells=cells)
    assert seen == ["a", "a", "b"]
    (row,) = csv.DictReader((tmp_path / "out" / "rates.csv").open())
    assert row["variant"] == "one", "the other one is of the former file"
