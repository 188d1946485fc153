"""Pictures: frames, files, rendering models, cameras; the viewer's simulation and arguments."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from PIL import Image, ImageSequence
from viewer import Driven, session

from mqe_jax.envs import TASKS
from mqe_jax.names import load_policy
from mqe_jax.physics.robots.index import trunk_bodies
from mqe_jax.sensors import marks as sensed
from mqe_jax.train.folder import CONFIG_FILE
from mqe_jax.view.menu import Entry, Menu, find_runs
from mqe_jax.view.session import HOLD_TIME, Drive
from mqe_jax.viz import cameras, clips, framing, geometry, recording, render
from mqe_jax.viz.framing import Camera
from mqe_jax.viz.recording import Episode
from tests.fake_env import FakeEnv
from tests.inputs import refuses
from tests.states import initial, made, placed
from tools.clips import typical

env = pytest.fixture(scope="module")(lambda: FakeEnv())


@pytest.fixture(scope="module")
def episode(env: Any) -> recording.Episode:
    policy = load_policy("forward", env)
    return recording.record_episodes(env, policy, jax.random.PRNGKey(0), episodes=2, seconds=1.0)[1]


def test_an_episode_starts_at_the_reset_and_stops_where_it_ends(
    env: Any, episode: recording.Episode
) -> None:
    assert len(episode) == 11  # the reset and ten steps
    np.testing.assert_allclose(episode.qpos[:, 0], 1.0 + 0.025 * np.arange(11), rtol=1e-5)
    assert episode.success == 1.0
    assert episode.reward == pytest.approx(0.05)


def test_the_typical_episode_is_the_median_of_the_successful_ones(
    episode: recording.Episode,
) -> None:
    rated = [(1.0, 0.3), (0.0, 0.9), (1.0, 0.1), (0.5, 0.7), (1.0, 0.2)]
    episodes = [
        dataclasses.replace(episode, success=success, reward=reward) for success, reward in rated
    ]
    assert typical(episodes) is episodes[4]  # of 0.5, then 0.1, 0.2 and 0.3
    assert typical(episodes[1:2]) is episodes[1]


def test_success_is_settled_from_its_last_change_on(env: Any, episode: recording.Episode) -> None:
    """Both robots are beyond x 1.2 from the ninth step on."""
    assert episode.settled == pytest.approx(9 * env.dt)
    assert episode.cut(slice(2, None)).settled == episode.settled


def test_robots_are_found_and_the_gates_walls_end_at_the_side_walls(
    env: Any, episode: recording.Episode
) -> None:
    assert [env.mj_model.body(body).name for body in trunk_bodies(env.mj_model)] == [
        "robot0/trunk",
        "robot1/trunk",
    ]
    drawn = geometry.rendering_model(env.mj_model, episode)
    low, high = geometry.extent(drawn, episode)
    assert high[1] == pytest.approx(1.5) and low[1] == pytest.approx(-1.5)
    own = geometry.extent(env.mj_model, episode)[1][1]
    assert own == pytest.approx(2.4)  # the environment's own model is as it was


def test_the_side_view_follows_the_first_robot(env: Any, episode: recording.Episode) -> None:
    model = env.mj_model
    data = mujoco.MjData(env.mj_model)
    camera = cameras.cameras(model, episode, "side", 1.5)[-1]
    geometry.pose(model, data, episode, len(episode) - 1)
    assert camera.lookat[:2] == pytest.approx(data.xpos[trunk_bodies(model)[0]][:2], abs=0.1)
    refuses(r"view: unknown name .*side", cameras.cameras, model, episode, "sid", 1.5)


@pytest.mark.parametrize("suffix", [".png", ".gif", ".webp", ".mp4"])
def test_clips_land_whole_without_gl(
    env: Any, episode: Episode, tmp_path: Path, capsys: Any, suffix: str
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


def test_an_image_from_above_is_of_the_time_that_the_caller_names(
    env: Any, episode: Episode, tmp_path: Path
) -> None:
    for at in (0.0, 1.0):
        file = tmp_path / f"{at}.png"
        render.render_episode(env, episode, file, size=(160, 90), at=at, backend=None)
    assert (tmp_path / "0.0.png").read_bytes() != (tmp_path / "1.0.png").read_bytes()


def test_a_line_says_what_is_rounded(
    env: Any, episode: Episode, tmp_path: Path, capsys: Any
) -> None:
    def lines(file: str, **options: Any) -> list[str]:
        path = tmp_path / file
        render.render_episode(env, episode, path, size=(160, 90), backend=None, **options)
        return [line for line in capsys.readouterr().err.splitlines() if "GL" not in line]

    assert lines("clip.gif", fps=12.5) == lines("image.png", at=0.1) == []
    (line,) = lines("clip.gif", fps=29.97)
    assert line.startswith("mqe: fps: 25, not 29.97")
    (line,) = lines("image.png", at=1000.0)
    assert line.startswith(f"mqe: at: the episode ends after {(len(episode) - 1) * episode.dt:g} s")


def test_a_gif_lasts_as_long_as_its_episode(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 255, (30, 16, 16, 3), np.uint8)
    clips.write_clip(tmp_path / "clip.gif", frames, 35.0)  # 28.6 ms a frame, of tens of ms
    with Image.open(tmp_path / "clip.gif") as clip:
        durations = [frame.info["duration"] for frame in ImageSequence.Iterator(clip)]
    assert sum(durations) == pytest.approx(30 * 1000 / 35, abs=10)


def test_gl_draws_robots_walls_and_floor(env: Any, episode: recording.Episode) -> None:
    if render.gl_backend() is None:
        pytest.skip("no GL library here (libegl1 libgl1-mesa-dri)")
    frames = list(render.render_frames(env, episode.cut(slice(None, None, 10)), size=(160, 90)))
    assert len(frames) == 2 and frames[0].shape == (90, 160, 3)
    red, green, blue = np.moveaxis(frames[-1].astype(int), -1, 0)
    assert np.count_nonzero((blue > red + 60) & (blue > green + 60)) > 5
    assert np.count_nonzero((green > red + 60) & (green > blue + 60)) > 5
    assert np.any(frames[0] != frames[1])
    before = env.mj_model.vis.global_.offwidth
    assert list(render.render_frames(env, episode.cut(slice(0, 1)), size=(1000, 80)))
    assert env.mj_model.vis.global_.offwidth == before  # the model's own settings are left alone


@pytest.mark.parametrize("backend", ["auto", None])
def test_what_the_first_robot_senses_is_drawn_and_explained(
    env: Any, episode: Episode, backend: str | None
) -> None:
    """Lines, points and an area in magenta, and the legend; the other robot's are not."""
    if backend and render.gl_backend() is None:
        pytest.skip("no GL library here (libegl1 libgl1-mesa-dri)")
    still = episode.cut(slice(0, 1))

    def pink(agent: int, **corners: jax.Array) -> int:
        every = {name: jnp.zeros((2, *x.shape)).at[agent].set(x) for name, x in corners.items()}
        shown = {
            f"{name[:-1]}_opacity": (jnp.arange(2.0) == agent)[:, None]
            for name in corners
            if name != "area"
        }
        options: Any = {**every, **shown}
        mark = sensed.marks("lidar", (1.0, 0.0, 1.0), jnp.full(2, 0.6), **options)
        marked = dataclasses.replace(
            still, marks=(jax.tree.map(lambda x: np.asarray(x)[None], mark),)
        )
        (frame,) = render.render_frames(env, marked, size=(320, 180), backend=backend)
        red, green, blue = np.moveaxis(frame.astype(int), -1, 0)
        return int(np.count_nonzero((red > green + 40) & (blue > green + 40)))

    corners = {"lines": jnp.array([[[0.5, -1.0], [3.5, 1.0]]]), "points": jnp.array([[2.0, -0.8]])}
    corners["area"] = jnp.array([[0.5, 0.0], [3.0, -1.0], [3.0, 1.0]])
    assert all(pink(0, **{name: x}) > 3 for name, x in corners.items())
    assert pink(1, lines=corners["lines"], points=corners["points"]) == 0
    mark = sensed.marks("lidar", (1.0, 0.0, 1.0), jnp.full(2, 0.6))
    blank = np.zeros((360, 640, 3), np.uint8)
    plain = framing.legend(env, (640, 360), ())(blank).any(axis=(0, 2)).sum()
    told = framing.legend(env, (640, 360), (mark,))(blank).any(axis=(0, 2)).sum()
    assert told > plain + 40


BODIES = (
    *(f"body_{name}" for name in ("mass", "inertia", "pos", "quat", "ipos", "iquat", "parentid")),
    *(f"jnt_{name}" for name in ("type", "pos", "axis", "range", "margin", "bodyid")),
    *(f"dof_{name}" for name in ("armature", "damping", "frictionloss")),
    *(f"actuator_{name}" for name in ("gainprm", "biasprm", "forcerange")),
)
GEOM = (
    "type",
    "size",
    "pos",
    "quat",
    "contype",
    "conaffinity",
    "condim",
    "friction",
    "solref",
    "solimp",
    "margin",
)
ASPECT = 16 / 9
TWELVE = [task for task in TASKS if task != "go1plane"]


@pytest.mark.parametrize("task", TASKS)
def test_rendering_models_have_the_physics_models_bodies_and_contacts(task: str) -> None:
    env = made(task)
    physics = env.compiled.model
    drawn = env.mj_model
    assert drawn.ngeom > physics.ngeom and physics.nsite == physics.ntex == physics.nlight == 0
    for name in ("nq", "nv", "nu", "nbody", "nmocap", "qpos0", *BODIES):
        np.testing.assert_array_equal(getattr(physics, name), getattr(drawn, name), err_msg=name)
    solid = np.flatnonzero((drawn.geom_contype | drawn.geom_conaffinity) != 0)
    assert [drawn.geom(i).name for i in solid] == [
        physics.geom(i).name for i in range(physics.ngeom)
    ]
    for name in GEOM:
        ours = getattr(physics, f"geom_{name}")
        theirs = getattr(drawn, f"geom_{name}")[solid]
        np.testing.assert_array_equal(ours, theirs, err_msg=name)


@pytest.mark.parametrize("task", TWELVE)
def test_team_colours_are_those_of_the_agents(task: str) -> None:
    env = made(task)
    shown = [geometry.robot_color(env.mj_model, body)[:3] for body in trunk_bodies(env.mj_model)]
    warm = [red > blue for red, _, blue in shown]
    robots = range(len(shown))
    expected = (
        [i in env.teams[1] for i in robots]
        if len(env.teams) > 1
        else [i >= env.num_agents for i in robots]
    )
    assert warm == expected and len(set(shown)) == len(shown)


def in_frame(model: mujoco.MjModel, episode: Episode, views: list[Camera]) -> np.ndarray:
    """Which targets' centres, then which goal points, are in the image of each frame (T, targets +
    P) bool.
    """
    data = mujoco.MjData(model)
    bodies = framing.targets(model, episode)
    rows = []
    boxes = geometry.body_boxes(model, bodies)
    goals = framing.goal_points(model, episode)
    tangent = np.tan(np.radians(model.vis.global_.fovy) / 2)
    for index, camera in enumerate(views):
        geometry.pose(model, data, episode, index)
        points = np.concatenate([geometry.pose_boxes(data, bodies, boxes).mean(axis=1), goals])
        forward, right, up = camera.axes
        offset = points - np.array(camera.lookat)
        depth = np.maximum(camera.distance + offset @ forward, 1e-6) * tangent
        rows.append((np.abs(offset @ right) <= ASPECT * depth) & (np.abs(offset @ up) <= depth))
    return np.array(rows)


def longest(flags: np.ndarray) -> int:
    """Returns the length of the longest run of true values in any column of `flags` (T, N)."""
    columns = ("".join("x" if flag else " " for flag in column) for column in flags.T)
    return max((len(run) for column in columns for run in column.split()), default=0)


def check(env: Any, episode: Episode, view: str = "follow") -> None:
    model = geometry.rendering_model(env.mj_model, episode)
    views = cameras.cameras(model, episode, view, ASPECT)
    assert in_frame(model, episode, views).all(axis=1).mean() >= 0.95
    assert longest(framing.hidden(model, episode, views) == 1.0) * episode.dt <= 1.0
    eyes = np.array([view.position for view in views])
    # m, at most 4 m/s
    assert np.linalg.norm(np.diff(eyes, axis=0), axis=1).max(initial=0.0) < 4.0 * episode.dt


def walking(
    task: str, path: Any, objects: Any = None, frames: int = 21, dt: float = 0.2
) -> Episode:
    """An episode in which the robots have the positions `path(t)` (R, 3), t from 0 to 1, and
    objects `objects(t)`.
    """
    states = [
        placed(made(task), path(t), objects=objects and objects(t))
        for t in np.linspace(0, 1, frames)
    ]
    data = [state.data for state in states]
    fields = ("qpos", "mocap_pos", "mocap_quat")
    return Episode(
        *(np.stack([np.asarray(getattr(one, name)) for one in data]) for name in fields), dt=dt
    )


@pytest.mark.parametrize("task", TWELVE)
def test_the_cameras_of_every_task_show_all_from_the_start(task: str) -> None:
    env = made(task)
    start = np.asarray(initial(env).data.qpos)[np.asarray(env.index.base_qpos)][:, :3]
    episode = walking(task, lambda t: start + t * np.array([1.0, 0.0, 0.0]), frames=6)
    for view in ("follow", "near"):
        check(env, episode, view)


def test_a_robot_behind_a_wall_is_hidden_and_one_beside_another_is_not() -> None:
    env = made("go1gate")
    episode = walking("go1gate", lambda t: [[3.9, 1.2, 0.3], [1.0, 1.2, 0.3]], frames=2)
    model = geometry.rendering_model(env.mj_model, episode)
    # from the start, along the track
    low = Camera((3.0, 1.2, 0.3), 5.0, azimuth=0.0, elevation=-2.0)
    assert framing.hidden(model, episode, [low] * 2)[:, 0].tolist() == [1.0, 1.0]
    assert framing.hidden(model, episode, [low] * 2)[:, 1].tolist() == [0.0, 0.0]
    above = Camera((3.0, 1.2, 0.3), 5.0, azimuth=0.0, elevation=-80.0)
    assert framing.hidden(model, episode, [above] * 2).max() == 0.0
    near = Camera((1.0, 1.2, 0.3), 1.5, azimuth=90.0, elevation=-80.0)
    inside = in_frame(model, episode, [near] * 2)
    # the other robot is beyond the image's edge
    assert inside[:, 1].all() and not inside[:, 0].any()


LIMIT = np.array([1.0, 0.5, 0.5])


def test_a_driven_robot_obeys_the_hand_and_the_others_their_policy() -> None:
    run = session(Driven(), name="forward")
    run.drive.env = 1
    run.drive.robot = 1
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
    settings = {
        "b": "task: go1gate",
        "a": "task: go1tug",
        "no task": "task: null",
        "unreadable": ": [",
    }
    for name, text in settings.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "policy.safetensors").touch()
        (tmp_path / name / CONFIG_FILE).write_text(text)
    (tmp_path / "unfinished").mkdir()
    runs = find_runs([tmp_path, tmp_path])
    assert {Path(run).name: task for run, task in runs.items()} == {"a": "go1tug", "b": "go1gate"}
    menu = Menu(lambda choice: session(FakeEnv()), Entry("go1gate", "given.safetensors"), runs)
    common = ("random", "idle", "forward")
    gate, tug = (
        next(run for run, its in runs.items() if its == task) for task in ("go1gate", "go1tug")
    )
    assert menu.policies("go1gate") == (
        "default",
        "go1gate",
        "scripted",
        *common,
        gate,
        "given.safetensors",
    )
    assert menu.policies("go1tug") == ("default", "go1tug", "scripted", *common, tug)
    assert menu.policies("go1plane") == ("default", *common)
    assert (menu.is_match("go1tug"), menu.is_match("go1gate")) == (True, False)


def test_matches_are_counted_by_outcome() -> None:
    run = session(FakeEnv())
    run.outcomes = ("win", "draw", "loss")
    run.counts = np.zeros(3, int)
    run._count(np.array([True, False]), np.array([[False, False, True], [True, False, False]]))
    run._count(np.array([True, True]), np.array([[True, False, False], [False, True, False]]))
    assert run.counts.tolist() == [1, 1, 1] and run.last == ["win", "draw"]
