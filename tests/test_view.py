"""The viewer: its simulation, its scene and its arguments."""

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import mujoco
import numpy as np
import pytest
from fake_env import FakeEnv
from viewer import Driven, free_port, session

from mqe_jax import cli, make
from mqe_jax.core.errors import InputError
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


@pytest.fixture(scope="module")
def stage() -> Iterator[Any]:
    """The scene of three environments of Narrow Gate, on a server without a page."""
    pytest.importorskip("mjviser")
    import viser

    from mqe_jax.view.stage import Stage
    from mqe_jax.viz.recording import Episode

    env = make("go1gate", impl="c", control="position", num_envs=3)
    data = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 3)).data
    frame = Episode(np.asarray(data.qpos), np.asarray(data.mocap_pos), np.asarray(data.mocap_quat), env.dt)
    server = viser.ViserServer(host="127.0.0.1", port=free_port(), verbose=False)
    yield SimpleNamespace(env=env, frame=frame, stage=Stage(server, env.mj_model, frame), server=server)
    server.stop()


def test_environments_stand_side_by_side_and_every_moving_body_is_drawn(stage: Any) -> None:
    scene, frame, model = stage.stage, stage.frame, stage.env.mj_model
    drawn = sorted(int(body) for batch in scene._batches for body in batch.bodies)
    with_shape = {int(model.geom_bodyid[g]) for g in range(model.ngeom) if model.geom_group[g] != 3}
    robots = [b for b in with_shape if model.body_mocapid[b] < 0 and b != 0]
    assert drawn == sorted(robots)
    trunk = model.body("robot0/trunk").id
    batch = next(batch for batch in scene._batches if trunk in batch.bodies)
    place = batch.handle.batched_positions.reshape(3, len(batch.bodies), 3)[:, list(batch.bodies).index(trunk)]
    away = place - frame.qpos[:, stage.env.index.base_qpos[0, :3]]
    np.testing.assert_allclose(away[:, [0, 2]], 0.0, atol=1e-5)
    apart = np.diff(away[:, 1])
    assert np.all(apart > 3.1)  # wider than the track with its walls
    np.testing.assert_allclose(away[1, 1], 0.0, atol=1e-6)


def test_contact_forces_carry_the_robots() -> None:
    """Of two Go1s that stand on their feet; robots are named by colour."""
    pytest.importorskip("mjviser")
    from mqe_jax.view.overlay import _METRES_PER_NEWTON, contact_arrows
    from mqe_jax.view.panel import robot_labels
    from mqe_jax.viz.recording import Episode

    env = make("go1plane", impl="c", control="position", num_envs=1)
    model, joints = env.mj_model, np.asarray(env.index.joint_qpos)
    data = mujoco.MjData(model)
    data.qpos[joints] = env.robot.default_joints
    for i, base in enumerate(env.index.base_qpos):
        data.qpos[base[:3]] = 2.0, i - 0.5, 0.29
    data.ctrl[:] = data.qpos[joints].ravel()
    mujoco.mj_step(model, data, 400)
    frame = Episode(data.qpos[None], data.mocap_pos[None], data.mocap_quat[None], env.dt)
    arrows = contact_arrows(model, mujoco.MjData(model), frame, data.qvel, data.ctrl)
    weight = 9.81 * sum(model.body_subtreemass[model.body(f"robot{i}/trunk").id] for i in range(2))
    force = (arrows[:, 1] - arrows[:, 0]).sum(0) / _METRES_PER_NEWTON
    np.testing.assert_allclose(force, [0.0, 0.0, weight], atol=0.05 * weight)
    assert len(arrows) >= 8 and np.all(np.abs(arrows[:, 0, 2]) < 0.01)
    names = [label.partition(" (")[0] for label in robot_labels(model)]
    assert names == ["robot 1", "robot 2"] and len(set(robot_labels(model))) == 2


def test_the_page_offers_policies_of_the_package_and_of_run_folders(tmp_path: Path) -> None:
    from mqe_jax.train.folder import CONFIG_FILE
    from mqe_jax.view.menu import Entry, Menu, find_runs

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


def test_a_choice_replaces_the_session_and_a_wrong_one_keeps_it() -> None:
    pytest.importorskip("mjviser")
    from mqe_jax.view.menu import Entry, Menu
    from mqe_jax.view.viewer import Viewer

    def open_choice(choice: Entry) -> Any:
        if choice.policy == "bad":
            raise InputError("policy: bad")
        return session(Driven(), num_envs=3)

    viewer = Viewer(port=free_port(), menu=Menu(open_choice, Entry("go1gate"), {}))
    viewer.show(session(Driven()))
    first, panel, gui = viewer.session, viewer._panel, viewer.server.gui
    widgets, commands = len(gui._gui_input_handle_from_uuid), len(gui._command_handle_from_uuid)
    assert not viewer._open_chosen()
    panel._wanted = Entry("go1gate", "bad")
    assert not viewer._open_chosen() and viewer.session is first and first.paused
    panel._wanted = Entry("go1gate", "idle")
    assert viewer._open_chosen() and viewer.session is not first and viewer.session.num_envs == 3
    assert (len(gui._gui_input_handle_from_uuid), len(gui._command_handle_from_uuid)) == (widgets, commands)
    assert viewer._panel is not panel and viewer._panel.take_choice() is None
    viewer._panel.shapes = viewer._panel.contacts = True
    viewer._draw()
    assert viewer._shapes and viewer._overlay._arrows is not None
    viewer._panel.shapes = viewer._panel.contacts = False
    viewer._draw()
    assert not viewer._shapes and viewer._overlay._arrows is None
    viewer.server.stop()


@pytest.mark.parametrize("num_envs", [1, 3])
def test_own_lights_alone_and_cameras_at_the_action_of_one_environment(num_envs: int, monkeypatch: Any) -> None:
    pytest.importorskip("mjviser")
    from viser import SceneApi

    from mqe_jax.view.viewer import Viewer

    lights: dict[str, Any] = {}
    for name in ("configure_default_lights", "configure_environment_map", "add_light_directional"):
        monkeypatch.setattr(SceneApi, name, lambda _, *first, name=name, **rest: lights.update({name: (first, rest)}))
    viewer, run = Viewer(port=free_port()), session(Driven(), num_envs=num_envs)
    viewer.show(run)
    camera, robots = viewer.server.initial_camera, run.moment().frame.qpos[0, FakeEnv.robot_x[:, None] + np.arange(2)]
    assert [lights[f"configure_{name}"][0] for name in ("default_lights", "environment_map")] == [(False,), (None,)]
    assert lights["add_light_directional"][1]["cast_shadow"] is False
    distance = float(np.linalg.norm(np.subtract(camera.position, camera.look_at)))
    followed, (position, target) = num_envs == 1, viewer._stage.overview()
    middle = robots.mean(axis=0) if followed else np.zeros(2)
    np.testing.assert_allclose(np.asarray(viewer._stage._root.position)[:2], -middle, atol=1e-5)
    near, whole = 3.0 + np.linalg.norm(np.subtract(*robots)), np.linalg.norm(np.subtract(position, target))
    assert distance == pytest.approx(near if followed else whole, abs=0.02) and whole > near + 0.2
    viewer.server.stop()


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
