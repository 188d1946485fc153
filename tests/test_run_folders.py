"""Run folders that are removed, renamed, replaced, or nested while or before a training writes to them."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import probes
import pytest
from fake_env import SMALL
from probes import Probe
from test_train_run import settings

from mqe_jax import cli, interrupts
from mqe_jax.errors import InputError
from mqe_jax.files import locked, remove_temporaries, replacing, write_atomically
from mqe_jax.train.checkpoint import list_checkpoints
from mqe_jax.train.learner import Learner, make_learner
from mqe_jax.train.runner import train

PROBE = Probe(probes.show_hidden_first, probes.pay_near_hidden, num_envs=4)
SETTINGS = settings(network__recurrent=False, ppo__epochs=1, ppo__minibatches=1)


def replace(folder: Path) -> None:
    shutil.move(folder, folder.with_name("moved"))
    folder.mkdir()


LOST: dict[str, Callable[[Path], object]] = {
    "removed": shutil.rmtree,
    "renamed": lambda folder: folder.rename(folder.with_name("moved")),
    "replaced": replace,
    "parent renamed": lambda folder: folder.parent.rename(folder.parent.with_name("other")),
}


@pytest.fixture(scope="module")
def learner() -> Learner:
    """The compiled learner of all trainings of this file."""
    return make_learner(PROBE, SETTINGS)


@pytest.mark.parametrize("how", LOST)
def test_a_training_stops_when_its_folder_is_lost(
    how: str, tmp_path: Path, learner: Learner, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With one line; neither the old path nor the folder that is there now gets a file."""
    monkeypatch.setattr("mqe_jax.train.start.make_learner", lambda *_: learner)
    folder = tmp_path / "runs" / "run"

    def lose(state: object, row: dict[str, float]) -> None:
        if row["updates"] == (2 if how == "replaced" else 1):  # followed by a checkpoint, or by a row
            LOST[how](folder)

    with pytest.raises(InputError, match=f"run_dir: {folder} was removed, renamed or replaced; nothing more is"):
        train(PROBE, SETTINGS, folder, on_update=lose)
    assert not folder.exists() or list(folder.iterdir()) == []
    moved = next(tmp_path.rglob("moved"), tmp_path / "other" / "run")
    if how != "removed":
        assert [path.name for path in list_checkpoints(moved)] == ["step_000000000000.safetensors"]
        assert len((moved / "metrics.csv").read_text().splitlines()) == (3 if how == "replaced" else 2)
    assert not [path for path in tmp_path.rglob(".*")]


def test_a_second_training_keeps_its_checkpoints(
    tmp_path: Path, learner: Learner, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a folder that is renamed while a training writes to it, and replaced by another training."""
    monkeypatch.setattr("mqe_jax.train.start.make_learner", lambda *_: learner)
    folder, seen = tmp_path / "run", {}

    def lose(state: object, row: dict[str, float]) -> None:
        if row["updates"] == 1:
            folder.rename(tmp_path / "moved")
            train(PROBE, SETTINGS, folder)
            seen.update({path: path.read_bytes() for path in folder.rglob("*") if path.is_file()})

    with pytest.raises(InputError, match="was removed, renamed or replaced"):
        train(PROBE, SETTINGS, folder, on_update=lose)
    assert len(seen) >= 5 and {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == seen


def test_a_lock_that_ends_is_forgotten(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    with locked(folder):
        replace(folder)
        with pytest.raises(InputError, match="run_dir"):
            write_atomically(folder / "file", b"1")
    write_atomically(folder / "file", b"2")
    assert (folder / "file").read_bytes() == b"2"


@pytest.mark.usefixtures("fake_tasks")
def test_seeds_and_a_single_run_do_not_share_a_folder(capfd: pytest.CaptureFixture[str]) -> None:
    """Neither several seeds in a single run's folder, nor a run in the folder of several seeds; resumed or not."""
    for folder, inner, flags in (("single", "", ["--num-seeds", "2"]), ("seeds", "seed0", [])):
        checkpoint = Path(folder, inner, "checkpoints", "step_000000000032.safetensors")
        checkpoint.parent.mkdir(parents=True)
        checkpoint.touch()
        before = sorted(Path(folder).rglob("*"))
        for resume in ([], ["--resume"]):
            assert cli.main(["train", "fake", "--run-dir", folder, *SMALL, *flags, *resume]) == 2
            assert "holds another run" in capfd.readouterr().err
            assert sorted(Path(folder).rglob("*")) == before


def test_files_of_dead_processes_go_when_a_run_starts(
    tmp_path: Path, learner: Learner, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of processes that run, such as a clip that is being written, stay."""
    monkeypatch.setattr("mqe_jax.train.start.make_learner", lambda *_: learner)
    dead = 2**22 + 1  # above the largest process number
    (tmp_path / "checkpoints").mkdir()
    gone = [f".policy.{n}.tmp.safetensors" for n in (dead, os.getpid())]
    gone += [f"checkpoints/.step_000000000016.{dead}.tmp.safetensors"]
    kept = [f".clip.{os.getppid()}.tmp.mp4", ".hidden", "notes.tmp"]
    for name in (*gone, *kept):
        (tmp_path / name).write_text("half")
    train(PROBE, SETTINGS, tmp_path)
    assert [name for name in (*gone, *kept) if (tmp_path / name).exists()] == kept


def test_a_file_that_is_being_written_is_not_removed(tmp_path: Path) -> None:
    with replacing(tmp_path / "a.txt") as temporary:
        temporary.write_text("new")
        assert temporary in interrupts.temporaries
        remove_temporaries(tmp_path)
    assert (tmp_path / "a.txt").read_text() == "new"
