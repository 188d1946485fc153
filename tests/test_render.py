"""Rendering: content of the frames, written files, rejected input."""

import dataclasses
import os
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
import pytest
from fake_env import FakeEnv
from PIL import Image, ImageSequence

from mqe_jax.errors import InputError
from mqe_jax.policies import load_policy
from mqe_jax.viz import cameras, clips, framing, geometry, legend, recording, render
from tests.states import made, placed


@pytest.fixture(scope="module")
def env() -> FakeEnv:
    return FakeEnv()


@pytest.fixture(scope="module")
def episode(env: FakeEnv) -> recording.Episode:
    act = load_policy("forward", env).act
    return recording.record(env, act, (), jax.random.PRNGKey(0), episodes=2, seconds=1.0)[1]


def test_an_episode_starts_at_the_reset_and_stops_where_it_ends(env: FakeEnv, episode: recording.Episode) -> None:
    assert len(episode) == 11  # the reset and ten steps
    np.testing.assert_allclose(episode.qpos[:, 0], 1.0 + 0.025 * np.arange(11), rtol=1e-5)
    assert episode.success == 1.0
    assert episode.reward == pytest.approx(0.05)


def test_the_typical_episode_is_the_median_of_the_successful_ones(episode: recording.Episode) -> None:
    rated = [(1.0, 0.3), (0.0, 0.9), (1.0, 0.1), (0.5, 0.7), (1.0, 0.2)]
    episodes = [dataclasses.replace(episode, success=success, reward=reward) for success, reward in rated]
    assert recording.typical(episodes) is episodes[4]  # of 0.5, then 0.1, 0.2 and 0.3
    assert recording.typical(episodes[1:2]) is episodes[1]


def test_success_is_settled_from_its_last_change_on(env: FakeEnv, episode: recording.Episode) -> None:
    """Both robots are beyond x 1.2 from the ninth step on."""
    assert episode.settled == pytest.approx(9 * env.dt)
    assert episode.cut(slice(2, None)).settled == episode.settled


def test_the_legend_names_teams_and_scripted_robots() -> None:
    env = made("go1football-defender")
    (team, own), (other, scripted) = legend.entries(env)
    assert (team, len(own), other, len(scripted)) == ("team", 2, "scripted", 1)
    assert own[0][2] > 200 and own[1][1] > 150 and scripted[0][0] > 200  # blue, green and red
    frame = np.zeros((360, 640, 3), np.uint8)
    shown = legend.legend(env, (640, 360))(frame)
    for color in (*own, *scripted):
        found = np.argwhere((shown == color).all(axis=-1))
        assert len(found) > 20 and found[:, 0].min() > 300 and found[:, 1].max() < 320  # lower left
    assert not frame.any() and not shown[:300].any()
    assert legend.legend(env, (40, 20))(frame[:20, :40]).shape == (20, 40, 3)  # larger than the frame


def test_robots_are_found_and_the_gates_walls_end_at_the_side_walls(env: FakeEnv, episode: recording.Episode) -> None:
    assert [env.mj_model.body(body).name for body in geometry.robot_bases(env.mj_model)] == ["a", "b"]
    drawn = geometry.rendering_model(env.mj_model, episode)
    low, high = geometry.extent(drawn, episode)
    assert high[1] == pytest.approx(1.5) and low[1] == pytest.approx(-1.5)
    own = geometry.extent(env.mj_model, episode)[1][1]
    assert own == pytest.approx(2.4)  # the environment's own model is as it was


def in_image(model: Any, camera: framing.Camera, point: np.ndarray, aspect: float) -> float:
    """Distance of a point's projection from the image centre: 1 is the edge."""
    a, e = np.radians(camera.azimuth), np.radians(camera.elevation)
    forward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([np.sin(a), -np.cos(a), 0.0])
    tangent = np.tan(np.radians(model.vis.global_.fovy) / 2)
    offset = point - camera.lookat
    depth = camera.distance + offset @ forward
    x, y = offset @ right / depth / tangent / aspect, offset @ np.cross(right, forward) / depth / tangent
    return float(max(abs(x), abs(y)))


@pytest.mark.parametrize("aspect", [1.0, 16 / 9])
def test_the_default_camera_holds_the_whole_track(env: FakeEnv, episode: recording.Episode, aspect: float) -> None:
    model = geometry.rendering_model(env.mj_model, episode)
    camera = cameras.default_camera(model, episode, aspect)
    low, high = geometry.extent(model, episode)
    corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T
    reach = [in_image(model, camera, corner, aspect) for corner in corners]
    assert max(reach) <= 1.0
    assert max(reach) > 0.85  # and no farther away than it must be


def test_following_cameras_hold_all_robots_in_every_frame(env: FakeEnv, episode: recording.Episode) -> None:
    model, data = env.mj_model, mujoco.MjData(env.mj_model)
    whole = cameras.cameras(model, episode, "scene", 1.5)[0]
    followed = cameras.cameras(model, episode, "follow", 1.5)
    assert len(followed) == len(episode)
    for index, camera in enumerate(followed):
        geometry.pose(model, data, episode, index)
        reach = [in_image(model, camera, data.xpos[body], 1.5) for body in geometry.robot_bases(model)]
        assert max(reach) < 1.0
    assert followed[0].distance < 0.8 * whole.distance  # nearer, so that legs are seen
    assert followed[-1].lookat[0] > followed[0].lookat[0] + 0.05  # the robots walk along +x


def test_no_robot_of_a_match_is_cut_by_the_image() -> None:
    """Four robots spread over the field walk towards the ball; the view contains a robot wholly or not at all."""
    env = made("go1football-2vs2")
    frames = 30
    states = [
        placed(env, [[4 + 0.06 * t, -2 + 0.06 * t, 0.3], [4, 2, 0.3], [10 - 0.08 * t, 2, 0.3], [10, -2.5, 0.3]])
        for t in range(frames)
    ]
    qpos = np.stack([np.asarray(state.data.qpos) for state in states])
    still = (np.repeat(np.asarray(x)[None], frames, 0) for x in (states[0].data.mocap_pos, states[0].data.mocap_quat))
    episode = recording.Episode(qpos, *still, dt=0.2)
    model, data = env.mj_model, mujoco.MjData(env.mj_model)
    whole = 0
    for index, camera in enumerate(cameras.cameras(model, episode, "follow")):
        geometry.pose(model, data, episode, index)
        for body in geometry.robot_bases(model):
            corners = data.xpos[body] + np.array(
                [[x, y, z] for x in (-0.3, 0.3) for y in (-0.3, 0.3) for z in (-0.2, 0.2)]
            )
            reach = [in_image(model, camera, corner, 16 / 9) for corner in corners]
            assert max(reach) <= 1.0 or min(reach) >= 1.0
            whole += max(reach) <= 1.0
    assert whole >= 2 * frames


def test_the_side_view_follows_the_first_robot(env: FakeEnv, episode: recording.Episode) -> None:
    model, data = env.mj_model, mujoco.MjData(env.mj_model)
    camera = cameras.cameras(model, episode, "side", 1.5)[-1]
    geometry.pose(model, data, episode, len(episode) - 1)
    assert camera.lookat[:2] == pytest.approx(data.xpos[geometry.robot_bases(model)[0]][:2], abs=0.1)
    with pytest.raises(InputError, match=r"view: unknown name .*side"):
        cameras.cameras(model, episode, "sid", 1.5)


def test_slow_motion_lasts_longer(env: FakeEnv, episode: recording.Episode, tmp_path: Path) -> None:
    seconds = {}
    for speed in (1.0, 0.5):
        file = tmp_path / f"{speed}.gif"
        render.render_episode(env, episode, file, size=(64, 36), backend=None, fps=10.0, speed=speed)
        with Image.open(file) as clip:
            seconds[speed] = sum(frame.info["duration"] for frame in ImageSequence.Iterator(clip)) / 1000
    assert seconds[0.5] > 1.4 * seconds[1.0]


@pytest.mark.parametrize("suffix", [".png", ".gif", ".webp", ".mp4"])
def test_clips_land_whole_without_gl(
    env: FakeEnv, episode: recording.Episode, tmp_path: Path, capsys: Any, suffix: str
) -> None:
    if suffix == ".mp4":
        pytest.importorskip("imageio_ffmpeg")
    file = tmp_path / f"clip{suffix}"
    assert render.render_episode(env, episode, file, size=(160, 90), backend=None) == "matplotlib"
    assert [path.name for path in tmp_path.iterdir()] == [file.name]
    start = file.read_bytes()[:12]
    assert {".png": b"PNG", ".gif": b"GIF89", ".webp": b"WEBP", ".mp4": b"ftyp"}[suffix] in start
    errors = capsys.readouterr().err
    assert errors.count("\n") == 1 and "libegl1" in errors


def test_gl_draws_robots_walls_and_floor(env: FakeEnv, episode: recording.Episode) -> None:
    if render.gl_backend() is None:
        pytest.skip("no GL library here (libegl1 libgl1-mesa-dri)")
    frames = list(render.render_frames(env, episode.cut(slice(None, None, 10)), size=(160, 90)))
    assert len(frames) == 2 and frames[0].shape == (90, 160, 3)
    red, green, blue = np.moveaxis(frames[-1].astype(int), -1, 0)
    assert np.count_nonzero((blue > red + 60) & (blue > green + 60)) > 5
    assert np.count_nonzero((green > red + 60) & (green > blue + 60)) > 5
    assert np.any(frames[0] != frames[1])


def test_a_broken_drawing_leaves_nothing_behind(tmp_path: Path) -> None:
    def frames() -> Any:
        yield np.zeros((8, 8, 3), np.uint8)
        raise RuntimeError("out of frames")

    with pytest.raises(RuntimeError):
        clips.write_clip(tmp_path / "clip.gif", frames(), 10.0)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("clip.avi", r"clip\.avi.*\.mp4, \.webp, \.gif, \.png"),
        (".", "suffix"),
        ("/proc/nowhere/clip.png", "cannot be written"),
    ],
)
def test_bad_outputs_are_refused(tmp_path: Path, name: str, said: str) -> None:
    if name.startswith("/proc") and not os.path.isdir("/proc"):
        pytest.skip("no read-only folder here")
    with pytest.raises(ValueError, match=said):
        clips.check_output(tmp_path / name)


def test_the_models_own_settings_are_left_alone(env: FakeEnv, episode: recording.Episode) -> None:
    if render.gl_backend() is None:
        pytest.skip("no GL library here (libegl1 libgl1-mesa-dri)")
    before = env.mj_model.vis.global_.offwidth
    list(render.render_frames(env, episode.cut(slice(None, None, 10)), size=(1000, 80)))
    assert env.mj_model.vis.global_.offwidth == before
    assert isinstance(env.mj_model, mujoco.MjModel)
