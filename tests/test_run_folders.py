"""Run folders that are lost or replaced while a training writes; files written whole; several seeds
in one program.
"""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from mqe_jax.cli import programs
from mqe_jax.core import files
from mqe_jax.core.errors import InputError
from mqe_jax.core.types import Cast
from mqe_jax.train import runner
from mqe_jax.train.checkpoint import checkpoint_step, list_checkpoints
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.monitor import EvaluationLog, Monitor
from mqe_jax.train.policy import read_policy
from mqe_jax.train.runner import train, train_seeds
from tests.fake_env import SMALL
from tests.inputs import refuses
from tests.training import PROBE, Stop, largest_file, rows, settings, stop_after

pytestmark = pytest.mark.usefixtures("shared_programs")
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


@pytest.mark.parametrize("how", LOST)
def test_a_training_stops_when_its_folder_is_lost(how: str, tmp_path: Path) -> None:
    folder = tmp_path / "runs" / "run"

    def lose(state: object, row: dict[str, float]) -> None:
        # followed by a checkpoint, or by a row
        if row["updates"] == (2 if how == "replaced" else 1):
            LOST[how](folder)

    refuses(
        f"run_dir: {folder} was removed, renamed or replaced; nothing more is",
        train,
        PROBE,
        SETTINGS,
        folder,
        on_update=lose,
    )
    assert not folder.exists() or list(folder.iterdir()) == []
    moved = next(tmp_path.rglob("moved"), tmp_path / "other" / "run")
    if how != "removed":
        assert [path.name for path in list_checkpoints(moved)] == ["step_000000000000.safetensors"]
        assert len((moved / "metrics.csv").read_text().splitlines()) == (
            3 if how == "replaced" else 2
        )
    # not through the old path
    assert [path.name for path in tmp_path.rglob(".*")] == [files.LOCK] * (how != "removed")


def test_a_folder_that_is_lost_while_a_file_is_written_gets_none(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    with files.lock(folder):
        with pytest.raises(InputError, match="run_dir"), files.replacing(folder / "file"):
            replace(folder)
        refuses("run_dir", files.write_atomically, folder / "file", b"1")
    files.write_atomically(folder / "file", b"2")  # the lock has ended
    assert (folder / "file").read_bytes() == b"2"


@pytest.mark.usefixtures("fake_tasks")
def test_seeds_and_a_single_run_do_not_share_a_folder(mqe: Any) -> None:
    for folder, inner, flags in (("single", "", "--num-seeds 2"), ("seeds", "seed0", "")):
        checkpoint = Path(folder, inner, "checkpoints", "step_000000000032.safetensors")
        checkpoint.parent.mkdir(parents=True)
        checkpoint.touch()
        before = sorted(Path(folder).rglob("*"))
        for resume in ("", "--resume"):
            error = mqe(f"train fake --run-dir {folder} {flags} {resume}", *SMALL, code=2).err
            assert "holds another run" in error and error.count("\n") == 1
            assert sorted(Path(folder).rglob("*")) == before


@pytest.mark.parametrize("name", ["checkpoints", "best", "metrics.csv"])
def test_a_training_writes_and_removes_nothing_through_links(name: str, tmp_path: Path) -> None:
    run = tmp_path / "run"
    other = tmp_path / "other"
    run.mkdir()
    other.mkdir()
    (other / "step_000000000001.safetensors").touch()
    (run / name).symlink_to(other)
    refuses(f"{name} is a symbolic link", train, PROBE, SETTINGS, run, resume=True)
    assert [path.name for path in other.iterdir()] == ["step_000000000001.safetensors"]
    (tmp_path / "metrics.csv").symlink_to(tmp_path / "foreign.csv")
    with pytest.raises(OSError, match=r"metrics\.csv"):
        files.append(tmp_path / "metrics.csv", b"row")
    (tmp_path / "named").symlink_to(tmp_path / "folder")
    (tmp_path / "folder").mkdir()
    train(PROBE, SETTINGS, tmp_path / "named")
    assert (tmp_path / "folder" / "policy.safetensors").is_file()


def test_policies_of_others_beside_the_best_one_stay(tmp_path: Path) -> None:
    (tmp_path / "best").mkdir()
    for name in ("mine.safetensors", "step_000000000016.safetensors"):
        (tmp_path / "best" / name).touch()
    EvaluationLog(tmp_path, 0).prune()
    assert [path.name for path in (tmp_path / "best").iterdir()] == ["mine.safetensors"]


def test_temporary_files_are_new_and_unpredictable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with files.replacing(tmp_path / "a") as first, files.replacing(tmp_path / "a") as second:
        assert first != second and first.stat().st_mode & 0o777 == 0o666 & ~os.umask(os.umask(0o22))
    monkeypatch.setattr("secrets.token_hex", lambda size: 16 * "a")
    with files.replacing(tmp_path / "a") as name:
        pass
    name.symlink_to(tmp_path / "foreign")
    with pytest.raises(FileExistsError):
        files.write_atomically(tmp_path / "a", b"new")
    assert not (tmp_path / "foreign").exists()


def test_a_reader_sees_the_old_file_until_the_new_one_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "clip.mp4"
    seen = []
    path.write_bytes(b"old")
    with pytest.raises(KeyError), files.replacing(path) as temporary:
        assert temporary.parent == tmp_path and temporary.suffix == ".mp4"
        temporary.write_bytes(b"ha")
        raise KeyError
    monkeypatch.setattr(
        os,
        "fsync",
        lambda descriptor: seen.append((path.read_bytes(), os.fstat(descriptor).st_size)),
    )
    files.write_atomically(path, b"the new one")
    assert seen == [(b"old", len(b"the new one"))]  # flushed before it is renamed
    assert path.read_bytes() == b"the new one" and list(tmp_path.iterdir()) == [path]


def seeded(seed: int, **values: Any) -> TrainConfig:
    return settings(seed=seed, **{"checkpoint__every": 1, **values})


def test_seeds_killed_between_two_checkpoints_resume(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where each keeps one checkpoint, they keep the one before too, which all have."""
    configs = [seeded(seed, checkpoint__kept=1) for seed in (0, 1)]
    folders = [tmp_path / "0", tmp_path / "1"]
    save = runner.save_checkpoint

    def killed(folder: Path, tree: Any, step: int, *arguments: Any) -> Path:
        if (folder, step) == (folders[1], 48):
            raise Stop
        return save(folder, tree, step, *arguments)

    monkeypatch.setattr(runner, "save_checkpoint", killed)
    with pytest.raises(Stop):
        train_seeds(Cast(PROBE), configs, folders)
    newest = [checkpoint_step(list_checkpoints(folder)[-1]) for folder in folders]
    assert newest == [48, 32]
    monkeypatch.setattr(runner, "save_checkpoint", save)
    states = train_seeds(Cast(PROBE), configs, folders, resume=True)
    assert [int(state.updates) for state in states] == [5, 5]
    for folder in folders:
        assert [row["env_steps"] for row in rows(folder)] == ["16", "32", "48", "64", "80"]


def test_a_seed_without_a_checkpoint_is_named(tmp_path: Path) -> None:
    checkpoint = tmp_path / "old" / "checkpoints" / "step_000000000080.safetensors"
    checkpoint.parent.mkdir(parents=True)
    checkpoint.touch()
    folders = [tmp_path / "old", tmp_path / "new"]
    refuses(
        "old 80, new none", train_seeds, Cast(PROBE), [seeded(1), seeded(2)], folders, resume=True
    )
    assert not (tmp_path / "new").exists()


def test_evaluations_keep_the_best_policy_and_end_with_the_absolute_metric(tmp_path: Path) -> None:
    configs = [seeded(seed, evaluation__every=2, evaluation__episodes=4) for seed in (0, 1)]
    folders = [tmp_path / f"seed{config.seed}" for config in configs]
    with pytest.raises(Stop):
        train_seeds(Cast(PROBE, PROBE), configs, folders, on_update=stop_after(4))
    train_seeds(Cast(PROBE, PROBE), configs, folders, resume=True)
    for folder in folders:
        record = json.loads((folder / "evaluations.json").read_text())
        assert [e["env_steps"] for e in record["evaluations"]] == [32, 64, 80]
        assert record["absolute"]["episodes"] == 40
        best = max(record["evaluations"], key=lambda e: e["sampled"]["average_step_reward"])
        assert record["absolute"]["env_steps"] == best["env_steps"]
        (policy,) = (folder / "best").glob("*.safetensors")
        chosen = read_policy(policy)
        assert chosen.metadata["env_steps"] == best["env_steps"]
        (again,) = Monitor(PROBE, configs[0]).evaluate(
            [chosen], [best["env_steps"]], 40, absolute=True
        )
        assert record["absolute"]["sampled"] == again["sampled"]
        assert (
            best["deterministic"]["average_step_reward"] != best["sampled"]["average_step_reward"]
        )


def test_a_compiled_program_is_stored_whole_or_not_at_all(tmp_path: Path) -> None:
    """JAX reads a file that was cut off, by a kill or a full disk, in vain at every start, and
    never replaces it.
    """
    from jax._src.lru_cache import LRUCache

    programs.write_whole()
    cache = LRUCache(str(tmp_path), max_size=-1)
    with largest_file(100), pytest.raises(OSError, match="File too large"):
        cache.put("jit_step-1", bytes(1000))
    assert cache.get("jit_step-1") is None and list(tmp_path.iterdir()) == []
    cache.put("jit_step-1", bytes(1000))
    assert cache.get("jit_step-1") == bytes(1000)
