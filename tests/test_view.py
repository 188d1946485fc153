"""The viewer: its simulation, its choices and its arguments."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_env import FakeEnv
from viewer import Driven, session

from mqe_jax import cli
from mqe_jax.train.folder import CONFIG_FILE
from mqe_jax.view.menu import Entry, Menu, find_runs
from mqe_jax.view.session import HOLD_TIME, Drive

LIMIT = np.array([1.0, 0.5, 0.5])


def test_a_driven_robot_obeys_the_hand_and_the_others_their_policy() -> None:
    run = session(Driven(), name="forward")
    run.drive.env, run.drive.robot = 1, 1
    run.drive.change((-1.0, 0.5, 1.0))
    run.advance()
    moved = run.moment().frame.qpos[:, FakeEnv.robot_x] - np.array([1.0, 1.0])
    np.testing.assert_allclose(moved, [[0.025, 0.025], [0.025, -0.05]], atol=1e-6)
    np.testing.assert_allclose(run.commands[-1][0], [[0.5, 0, 0], [0.5, 0, 0]])
    # Teleoperation commands are in the robot's frame, although its agent acts in a mirrored one.
    np.testing.assert_allclose(run.commands[-1][1], [[0.5, 0, 0], [-1.0, 0.25, 0.5]], atol=1e-6)


def test_a_held_button_counts_until_its_messages_stop() -> None:
    now = [0.0]
    drive = Drive(-LIMIT, LIMIT, clock=lambda: now[0])
    drive.hold((1.0, 0.0, 0.0))
    drive.hold((0.0, 0.0, 1.0))
    np.testing.assert_allclose(drive.now(), [1.0, 0.0, 0.5])
    now[0] = 0.5 * HOLD_TIME
    drive.hold((1.0, 0.0, 0.0))
    now[0] = 1.1 * HOLD_TIME
    np.testing.assert_allclose(drive.now(), [1.0, 0.0, 0.0])
    now[0] = 2.0 * HOLD_TIME
    np.testing.assert_allclose(drive.now(), 0.0)


def test_keys_step_the_command_within_its_limits_and_stop_it() -> None:
    drive = Drive(-LIMIT, LIMIT)
    for _ in range(6):
        drive.change((0.25, 0.0, -0.25))
    np.testing.assert_allclose(drive.now(), [1.0, 0.0, -0.5])
    drive.change((-0.25, 0.0, 0.0))
    np.testing.assert_allclose(drive.now(), [0.75, 0.0, -0.5])
    drive.change((0.0, 0.0, 0.0))
    np.testing.assert_allclose(drive.now(), 0.0)


def test_episodes_start_over_and_the_record_keeps_the_last_seconds() -> None:
    run = session(FakeEnv(), name="forward", history=0.3)
    for _ in range(21):
        run.advance()
    assert run.episodes.tolist() == [2, 2]
    assert run.terms == ("reward/progress", "average_step_reward")
    assert len(run.rewards) == len(run.times) == 15 and run.rewards[-1].shape == (2, 2)
    np.testing.assert_allclose(run.rewards[-1], 0.05, rtol=1e-5)
    assert run.times[-1] == pytest.approx(21 * 0.02)
    assert not run.drivable
    run.reset()
    np.testing.assert_allclose(run.moment().frame.qpos[:, FakeEnv.robot_x], 1.0)


def test_the_page_offers_policies_of_the_package_and_of_run_folders(tmp_path: Path) -> None:
    for name, task in (("b", "go1gate"), ("a", "go1tug"), ("no task", None)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "policy.safetensors").touch()
        (tmp_path / name / CONFIG_FILE).write_text(f"task: {task or 'null'}\n")
    (tmp_path / "unreadable").mkdir()
    (tmp_path / "unreadable" / "policy.safetensors").touch()
    (tmp_path / "unreadable" / CONFIG_FILE).write_text(": [")
    (tmp_path / "unfinished").mkdir()
    runs = find_runs([tmp_path, tmp_path])
    assert {Path(run).name: task for run, task in runs.items()} == {"a": "go1tug", "b": "go1gate"}
    menu = Menu(lambda choice: session(FakeEnv()), Entry("go1gate", "given.safetensors"), runs)
    common = ("random", "idle", "forward")
    gate, tug = (next(run for run, its in runs.items() if its == task) for task in ("go1gate", "go1tug"))
    assert menu.policies("go1gate") == ("default", "go1gate", "scripted", *common, gate, "given.safetensors")
    assert menu.policies("go1tug") == ("default", "go1tug", "scripted", *common, tug)
    assert menu.policies("go1plane") == ("default", *common)
    assert (menu.is_match("go1tug"), menu.is_match("go1gate")) == (True, False)


def test_matches_are_counted_by_outcome() -> None:
    run = session(FakeEnv())
    run.outcomes, run.counts = ("win", "draw", "loss"), np.zeros(3, int)
    run._count(np.array([True, False]), np.array([[False, False, True], [True, False, False]]))
    run._count(np.array([True, True]), np.array([[True, False, False], [False, True, False]]))
    assert run.counts.tolist() == [1, 1, 1] and run.last == ["win", "draw"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--host", "192.0.2.1"], ("host", "192.0.2.1", "an address of this machine")),
        (["--host", "no such host"], ("host", "no such host", "an address of this machine")),
        (["--policy", "scriptd"], ("policy", "scriptd", "scripted")),
    ],
)
def test_bad_arguments_are_refused_in_a_line(arguments: list[str], words: tuple[str, ...], capsys: Any) -> None:
    assert cli.main(["view", "go1gate", *arguments]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and all(word in said for word in words)
