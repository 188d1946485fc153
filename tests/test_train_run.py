"""A complete training run: its folder, which may be lost or replaced, resuming, failures to write,
several seeds, evaluation, loaded policies.
"""

import contextlib
import dataclasses
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import load_file

from mqe_jax import names
from mqe_jax.acting.evaluate import evaluate_batch
from mqe_jax.cli import programs
from mqe_jax.core import files
from mqe_jax.core.errors import InputError, NonFiniteError
from mqe_jax.core.settings import override, to_mapping
from mqe_jax.core.types import Cast
from mqe_jax.runs.cast import environments
from mqe_jax.train import runner
from mqe_jax.train.checkpoint import checkpoint_step, list_checkpoints
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.folder import load_run_config
from mqe_jax.train.learner import TrainState
from mqe_jax.train.monitor import EvaluationLog, Monitor, read_evaluations
from mqe_jax.train.policy import TrainedPolicy, read_policy, save_policy
from mqe_jax.train.runner import train, train_seeds
from mqe_jax.train.schedules import check_ended, ended
from mqe_jax.train.start import check_same
from tests.fake_env import SMALL
from tests.inputs import refuses
from tests.training import (
    PROBE,
    Probe,
    Stop,
    assert_same,
    assert_same_run,
    largest_file,
    rows,
    settings,
    show_hidden_first,
    stop_after,
)

pytestmark = pytest.mark.usefixtures("shared_programs")
KEY = jax.random.PRNGKey(0)


@pytest.fixture(scope="module")
def straight(
    shared_programs: None, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, TrainState]:
    run_dir = tmp_path_factory.mktemp("runs") / "straight"
    return run_dir, train(PROBE, settings(), run_dir)


@pytest.mark.parametrize("updates", [0, 2])
def test_a_killed_training_resumes_as_if_never_stopped(
    updates: int, straight: Any, tmp_path: Path, capsys: Any
) -> None:
    """Its newest checkpoint is of that update, the last row of the next one."""
    (tmp_path / "nohup.out").touch()  # the output of its command
    with pytest.raises(Stop):
        train(PROBE, settings(), tmp_path, on_update=stop_after(updates))
    assert checkpoint_step(list_checkpoints(tmp_path)[-1]) == 16 * updates
    assert len(rows(tmp_path)) == updates + 1
    with (tmp_path / "metrics.csv").open("a") as file:
        file.write("64,4,0.1")  # a half-written row
    capsys.readouterr()
    assert_same(train(PROBE, settings(), tmp_path, resume=True), straight[1])
    told = capsys.readouterr()
    assert told.out == "" and "80 of 80 steps, reward" in told.err
    assert_same_run(straight[0], tmp_path)
    assert [int(row["env_steps"]) for row in rows(tmp_path)] == [16, 32, 48, 64, 80]


def test_a_finished_run_is_neither_repeated_nor_overwritten(
    straight: tuple[Path, TrainState], monkeypatch: pytest.MonkeyPatch
) -> None:
    run_dir, expected = straight
    assert_same(train(PROBE, settings(), run_dir, resume=True), expected)
    with monkeypatch.context() as patch:
        patch.setattr(type(PROBE), "digests", {"skill_weights": "other"}, raising=False)
        refuses("skill_weights: has changed", train, PROBE, settings(), run_dir, resume=True)
    taught = Cast(PROBE, digests=(("imitation.teacher own", "other"),))
    said = "imitation.teacher own: has changed since the run"
    refuses(said, train_seeds, taught, [settings()], [run_dir], resume=True)
    refuses("already holds a run", train, PROBE, settings(), run_dir)
    said = rf"ppo.gamma: 0\.5 differs from the run.*its settings are in {run_dir}/config\.yaml"
    refuses(said, train, PROBE, settings(ppo__gamma=0.5), run_dir, resume=True)
    refuses(
        r"total_steps: 16 .* at least", train, PROBE, settings(total_steps=16), run_dir, resume=True
    )
    assert load_run_config(run_dir) == settings()


def test_a_training_knows_the_contents_of_the_policies_that_play_in_it(tmp_path: Path) -> None:
    shipped: Any = names.find("go1gate")
    file = str(tmp_path / "own.safetensors")
    config = settings(
        task="go1gate",
        imitation__teacher=file,
        curriculum__demonstrator=file,
        curriculum__assistance=0.5,
    )
    found = []
    for factor in (1, 1, 0):
        params = jax.tree.map(lambda x, factor=factor: factor * x, shipped.params)
        Path(file).unlink(missing_ok=True)
        save_policy(tmp_path, dataclasses.replace(shipped, params=params), "own.safetensors")
        found.append(dict(environments(config, impl="c").digests))
    assert found[0] == found[1] != found[2]
    assert [*found[0]] == [f"imitation.teacher {file}", f"curriculum.demonstrator {file}"]


@pytest.mark.soak
def test_a_longer_run_brings_back_nothing_that_has_ended(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    warmed = settings(ppo__critic_warmup=0.4)
    train(PROBE, dataclasses.replace(warmed, total_steps=32), run_dir)
    longer = dataclasses.replace(warmed, total_steps=96)
    said = r"total_steps: 96 .* at most 80, or more with --ppo.critic-warmup 0.3333: else ppo"
    refuses(said, train, PROBE, longer, run_dir, resume=True)
    assert int(train(PROBE, warmed, run_dir, resume=True).updates) == 5


def test_a_longer_run_leaves_out_what_has_ended(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    fewer = settings(curriculum__failure_bootstrap=0.5, total_steps=32)
    train(PROBE, fewer, run_dir)
    longer = dataclasses.replace(fewer, total_steps=96)
    said = r"at most 64, or more with --curriculum.failure-bootstrap-until 0.3333: else"
    refuses(said, train, PROBE, longer, run_dir, resume=True)
    said = "curriculum.failure_bootstrap: 0.25 differs from the run"
    other = override(longer, {"curriculum.failure_bootstrap": 0.25})
    refuses(said, train, PROBE, other, run_dir, resume=True)
    without = override(longer, {"curriculum.failure_bootstrap_until": 0.3333})
    assert int(train(PROBE, without, run_dir, resume=True).updates) == 6
    assert load_run_config(run_dir) == without


def test_schedules_that_have_ended_bound_the_total_of_a_run() -> None:
    changes: dict[str, dict[str, Any]] = {
        "curriculum.assistance": {"curriculum": {"assistance": 0.5, "assistance_until": 0.4}},
        "curriculum.failure_bootstrap": {
            "curriculum": {"failure_bootstrap": 0.5, "failure_bootstrap_until": 0.4}
        },
        "imitation": {"imitation": {"teacher": "scripted", "until": 0.4}},
    }
    for name, change in changes.items():
        before = override(settings(), change)  # the schedule ends with the second of five updates
        longer = override(before, {"total_steps": 96})
        assert not ended(before, 1)
        assert [*ended(before, 2)] == [name]
        refuses(f"at most 80, .*{name}", check_ended, longer, [name], 2)
        check_ended(override(longer, {ended(before, 2)[name]: 0.3}), [name], 2)


@pytest.mark.parametrize("before", [{"width": 0.7}, {"width": 0.7, "other": 1}])
def test_a_resumed_run_has_all_parameters_of_before(before: dict[str, Any]) -> None:
    config = settings(env={"width": 0.7} if "other" in before else {})
    lost = (
        "env.other: None differs from the run in x, which has 1"
        if "other" in before
        else "env.width: None differs"
    )
    refuses(lost, check_same, Path("x"), {**to_mapping(config), "env": before}, config)
    check_same(Path("x"), to_mapping(config), config)


@pytest.mark.parametrize("left", ["policy.safetensors", "metrics.csv", "config.yaml", "notes.md"])
@pytest.mark.parametrize("resume", [False, True])
def test_a_folder_with_a_run_but_no_checkpoint_is_left_alone(
    left: str, resume: bool, tmp_path: Path
) -> None:
    (tmp_path / left).write_text("a user's work")
    (tmp_path / "checkpoints").mkdir()  # of a training that was killed at its start
    (tmp_path / "nohup.out").touch()
    refuses(f"{left}.*name another folder", train, PROBE, settings(), tmp_path, resume=resume)
    assert {path.name for path in tmp_path.iterdir()} == {left, "checkpoints", "nohup.out"}
    assert (tmp_path / left).read_text() == "a user's work"


def test_a_second_training_in_the_same_folder_is_refused(tmp_path: Path) -> None:
    def again(state: TrainState, row: dict[str, float]) -> None:
        for resume in (False, True):
            refuses(
                r"already holds a run|in use by another process",
                train,
                PROBE,
                settings(),
                tmp_path,
                resume=resume,
            )
        raise Stop

    with pytest.raises(Stop):
        train(PROBE, settings(), tmp_path, on_update=again)


def test_an_interrupted_evaluation_is_made_when_the_run_resumes(
    tmp_path: Path, monkeypatch: Any
) -> None:
    config = settings(evaluation={"every": 2, "episodes": 4})

    def interrupt(*arguments: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Monitor, "evaluate", interrupt)
        train(PROBE, config, tmp_path, eval_env=PROBE)
    assert list_checkpoints(tmp_path)[-1].name == "step_000000000032.safetensors"
    train(PROBE, config, tmp_path, resume=True, eval_env=PROBE)
    assert [
        evaluation["env_steps"] for evaluation in read_evaluations(tmp_path)["evaluations"]
    ] == [32, 64, 80]


def test_a_writer_that_fails_ends_the_training_and_is_named(
    straight: Any, tmp_path: Path, monkeypatch: Any
) -> None:
    """Every time the lock is released, nothing half-written stays, and the run resumes exactly."""
    pytest.importorskip("tensorboardX", reason="needs the extra log")
    limits = contextlib.ExitStack()

    def fill(state: TrainState, row: dict[str, float]) -> None:
        if writer == "events.out" and row["updates"] == 3:
            (events,) = (tmp_path / "tensorboard").iterdir()
            limits.enter_context(largest_file(events.stat().st_size))  # metrics.csv is smaller
        elif writer == "metrics.csv":
            limits.enter_context(largest_file(1))
        elif writer == "step_000000000064" and row["updates"] == 4:
            limits.enter_context(largest_file(1000))

    def save(run_dir: Path, policy: TrainedPolicy) -> None:
        if writer == "policy.safetensors" and policy.metadata["env_steps"] == 80:
            limits.enter_context(largest_file(1000))
        save_policy(run_dir, policy)

    monkeypatch.setattr(runner, "save_policy", save)
    for writer in ("events.out", "metrics.csv", "step_000000000064", "policy.safetensors"):
        with limits, pytest.raises(OSError, match="File too large") as failed:
            train(PROBE, settings(), tmp_path, resume=True, on_update=fill)
        assert failed.value.filename.startswith(str(tmp_path)) and writer in failed.value.filename
        assert not list(tmp_path.rglob(".*"))
    monkeypatch.undo()
    assert_same(train(PROBE, settings(), tmp_path, resume=True), straight[1])
    assert [int(row["env_steps"]) for row in rows(tmp_path)] == [16, 32, 48, 64, 80]
    assert read_policy(tmp_path).metadata["env_steps"] == 80


def pay_nan_later(hidden: jax.Array, action: jax.Array) -> jax.Array:
    """Reward NaN for actions above about 3 standard deviations."""
    return jnp.where(action[:, 0, 0] > 2.0, jnp.nan, 0.0)


def test_a_training_stops_at_the_first_update_that_is_not_finite(tmp_path: Path) -> None:
    env = Probe(show_hidden_first, pay_nan_later, num_envs=4)
    with pytest.raises(NonFiniteError, match=r"update \d+ \(\d+ environment steps\) made loss/"):
        train(
            env,
            settings(total_steps=100 * 16, network={"recurrent": False, "log_std_init": -0.5}),
            tmp_path,
        )
    logged = rows(tmp_path)
    assert len(logged) >= 1 and all(row["loss/value"] != "nan" for row in logged)
    assert checkpoint_step(list_checkpoints(tmp_path)[-1]) <= int(logged[-1]["env_steps"])
    read_policy(tmp_path)


def test_the_policy_acts_outside_the_training(straight: tuple[Path, TrainState]) -> None:
    run_dir, _ = straight
    policy = read_policy(run_dir)
    obs = np.zeros((3, 2, 3), np.float32)
    memory = policy.initial_memory(3)
    action, memory = policy.act(obs, memory, jax.random.PRNGKey(0))
    assert action.shape == (3, 2, 1) and float(jnp.abs(action).max()) <= 1.0
    quiet = dataclasses.replace(policy, deterministic=True)
    mean, _ = quiet.act(obs, policy.initial_memory(3), jax.random.PRNGKey(0))
    single, single_memory = policy.act(obs[0], policy.initial_memory())
    np.testing.assert_allclose(mean[0], single, atol=1e-6)
    assert jax.tree.leaves(single_memory)[0].shape == (2, 4)
    assert policy.task == "probe"
    refuses(r"obs: shape \(3, 3, 2\)", policy.act, np.zeros((3, 3, 2)), memory)
    refuses("holds a checkpoint; a policy is needed", read_policy, list_checkpoints(run_dir)[-1])
    result = evaluate_batch(PROBE, policy, 8, jax.random.PRNGKey(0))
    assert result.episodes == 8 and result.episode_length == 4.0


def test_a_run_starts_from_a_policy(straight: tuple[Path, TrainState], tmp_path: Path) -> None:
    run_dir, trained = straight
    cast = Cast(PROBE, start=read_policy(run_dir))
    start = str(run_dir)

    def kill(state: TrainState, row: dict[str, float]) -> None:
        assert float(state.obs_normalizer.obs.samples) > float(trained.obs_normalizer.obs.samples)
        raise Stop

    with pytest.raises(Stop):
        train_seeds(cast, [settings(start=start)], [tmp_path / "a"], on_update=kill)
    first = load_file(list_checkpoints(tmp_path / "a")[0])
    last = load_file(list_checkpoints(run_dir)[-1])
    same = [name for name in first if name.startswith(("params/actor/", "params/log_std"))]
    assert len(same) > 5
    for name in same:
        np.testing.assert_array_equal(first[name], last[name])
    refuses(
        r"action_scale: 0\.25 differs from that of the policy in .*straight, ",
        train_seeds,
        cast,
        [settings(start=start, action_scale=0.25)],
        [tmp_path / "b"],
    )
    other = settings(start=start, network__hidden_sizes=(8,))
    said = r"start: .*straight.* is not allowed; it must be a policy with this run's network"
    refuses(said, train_seeds, cast, [other], [tmp_path / "b"])
    refuses("start: .* `start` of the training's cast", train, PROBE, other, tmp_path / "b")


# -- run folders that are lost, links, files written whole, several seeds


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
