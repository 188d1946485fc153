"""The viewer: its simulation, its scene and its arguments."""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest
from fake_env import FakeEnv
from viewer import Driven, free_port, session

from mqe_jax import cli, make
from mqe_jax.view.session import HOLD_TIME, Drive

LIMIT = np.array([1.0, 0.5, 0.5])


def test_a_driven_robot_obeys_the_hand_and_the_others_their_policy() -> None:
    run = session(Driven(), name="forward")
    run.drive.env, run.drive.robot = 1, 1
    run.drive.change((-1.0, 0.5, 1.0))
    run.advance()
    moved = run.frame().qpos[:, run.env.robot_x] - np.array([1.0, 1.0])
    np.testing.assert_allclose(moved, [[0.025, 0.025], [0.025, -0.05]], atol=1e-6)
    np.testing.assert_allclose(run.commands[-1][0], [[0.5, 0, 0], [0.5, 0, 0]])
    # Teleoperation commands are in the robot's frame, although its agent acts in a mirrored one.
    np.testing.assert_allclose(run.commands[-1][1], [[0.5, 0, 0], [-1.0, 0.25, 0.5]], atol=1e-6)


def test_a_held_button_counts_until_its_messages_stop() -> None:
    now = [0.0]
    drive = Drive(LIMIT, clock=lambda: now[0])
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
    drive = Drive(LIMIT)
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
    np.testing.assert_allclose(run.frame().qpos[:, run.env.robot_x], 1.0)


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


def test_walls_end_at_their_own_track_and_a_followed_body_stays_at_the_origin(stage: Any) -> None:
    scene = stage.stage
    walls = scene._wall_handles
    centre = np.stack([wall.batched_positions for wall in walls]) - scene.offset
    half = np.stack([wall.batched_scales for wall in walls])
    assert np.all(np.abs(centre[..., 1]) + half[..., 1] < 1.55)
    widths = 3.0 - 2 * half[..., 1].sum(0)
    np.testing.assert_allclose(widths, 0.6, atol=0.1)
    trunk = scene.bodies["robot 2"]
    scene.draw(stage.frame, (2, trunk))
    want = stage.frame.qpos[2, stage.env.index.base_qpos[1, :2]] + scene.offset[2, :2]
    np.testing.assert_allclose(np.asarray(scene._root.position)[:2], -want, atol=1e-5)
    scene.release()
    np.testing.assert_allclose(scene._root.position, 0.0)


def test_cameras_follow_robots_and_the_ball() -> None:
    pytest.importorskip("mjviser")
    from mqe_jax.view.stage import followable

    env = make("go1football-1vs1", impl="c", control="position", num_envs=1)
    assert list(followable(env.mj_model)) == ["robot 1", "robot 2", "ball"]


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
