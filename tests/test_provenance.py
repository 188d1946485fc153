"""Kept results are reused only if they come from the same settings, files, episodes and version."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import yaml

from mqe_jax.core import version
from mqe_jax.core.settings import build
from mqe_jax.core.types import Cast
from mqe_jax.presets import Layers, resolve
from mqe_jax.study import provenance
from mqe_jax.study import sweep as sweeps
from mqe_jax.study.runs import Cell
from mqe_jax.train.config import TrainConfig
from tests.inputs import refuses

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
    values = {"task": "go1gate", "start": "run", "env": {"skill_weights": "weights"}}
    values |= {"opponents": ["idle", "empty", "none", "", "x" * 300, "\0"], "seed": 1}
    assert {*provenance.digests(values)} == {"run", "weights"}
