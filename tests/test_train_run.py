"""A complete training run: run folder, resuming, failures to write, evaluation, loaded policies."""

import contextlib
import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import load_file

from mqe_jax.acting.evaluate import evaluate_batch
from mqe_jax.core.errors import NonFiniteError
from mqe_jax.core.settings import override, to_mapping
from mqe_jax.core.types import Cast
from mqe_jax.train import runner
from mqe_jax.train.checkpoint import checkpoint_step, list_checkpoints
from mqe_jax.train.folder import load_run_config
from mqe_jax.train.learner import TrainState
from mqe_jax.train.monitor import Monitor, read_evaluations
from mqe_jax.train.policy import TrainedPolicy, read_policy, save_policy
from mqe_jax.train.runner import train, train_seeds
from mqe_jax.train.schedules import check_ended
from mqe_jax.train.start import check_same
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


def test_a_killed_training_resumes_as_if_never_stopped(
    straight: Any, tmp_path: Path, capsys: Any
) -> None:
    straight_dir, expected = straight
    run_dir = tmp_path / "killed"

    with pytest.raises(Stop):
        # the checkpoint of update 2, the row of update 3
        train(PROBE, settings(), run_dir, on_update=stop_after(2))
    assert len(rows(run_dir)) == 3
    with (run_dir / "metrics.csv").open("a") as file:
        file.write("64,4,0.1")  # a half-written row
    capsys.readouterr()
    state = train(PROBE, settings(), run_dir, resume=True)
    assert_same(state, expected)
    told = capsys.readouterr()
    assert told.out == "" and "80 of 80 steps, reward" in told.err
    assert_same_run(straight_dir, run_dir)
    assert [int(row["env_steps"]) for row in rows(run_dir)] == [16, 32, 48, 64, 80]


def test_a_finished_run_is_neither_repeated_nor_overwritten(
    straight: tuple[Path, TrainState], monkeypatch: pytest.MonkeyPatch
) -> None:
    run_dir, expected = straight
    assert_same(train(PROBE, settings(), run_dir, resume=True), expected)
    with monkeypatch.context() as patch:
        patch.setattr(type(PROBE), "digests", {"skill_weights": "other"}, raising=False)
        refuses("skill_weights: has changed", train, PROBE, settings(), run_dir, resume=True)
    refuses("already holds a run", train, PROBE, settings(), run_dir)
    said = rf"ppo.gamma: 0\.5 differs from the run.*its settings are in {run_dir}/config\.yaml"
    refuses(said, train, PROBE, settings(ppo__gamma=0.5), run_dir, resume=True)
    refuses(
        r"total_steps: 16 .* at least", train, PROBE, settings(total_steps=16), run_dir, resume=True
    )
    assert load_run_config(run_dir) == settings()


def test_a_longer_run_brings_back_nothing_that_has_ended(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    warmed = settings(ppo__critic_warmup=0.4)
    train(PROBE, dataclasses.replace(warmed, total_steps=32), run_dir)
    longer = dataclasses.replace(warmed, total_steps=96)
    said = r"total_steps: 96 .* at most 80, beyond which ppo.critic_warmup, which has ended"
    refuses(said, train, PROBE, longer, run_dir, resume=True)
    assert int(train(PROBE, warmed, run_dir, resume=True).updates) == 5


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
        check_ended(longer, before, 1)
        refuses(f"at most 80, .*{name}", check_ended, longer, before, 2)


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


def test_a_training_killed_before_its_first_update_can_be_resumed(tmp_path: Path) -> None:
    (tmp_path / "nohup.out").touch()  # the output of its command
    with pytest.raises(Stop):
        train(PROBE, settings(), tmp_path, on_update=stop_after(0))
    assert [path.name for path in list_checkpoints(tmp_path)] == ["step_000000000000.safetensors"]
    train(PROBE, settings(), tmp_path, resume=True)
    assert len(rows(tmp_path)) == 5


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
