"""What rendering models add to the physics models, and what the cameras of clips show."""

from __future__ import annotations

from typing import Any

import jax
import mujoco
import numpy as np
import pytest

from mqe_jax import make, zoo
from mqe_jax.appearance import GOAL_SITE
from mqe_jax.envs import TASKS
from mqe_jax.policies import all_agents, load_policy
from mqe_jax.viz import cameras, geometry, visibility
from mqe_jax.viz.framing import Camera
from mqe_jax.viz.recording import Episode, record
from tests.states import made, placed

BODIES = (
    *(f"body_{name}" for name in ("mass", "inertia", "pos", "quat", "ipos", "iquat", "parentid")),
    *(f"jnt_{name}" for name in ("type", "pos", "axis", "range", "margin", "bodyid")),
    *(f"dof_{name}" for name in ("armature", "damping", "frictionloss")),
    *(f"actuator_{name}" for name in ("gainprm", "biasprm", "forcerange")),
)
GEOM = ("type", "size", "pos", "quat", "contype", "conaffinity", "condim", "friction", "solref", "solimp", "margin")
ASPECT = 16 / 9
TWELVE = [task for task in TASKS if task != "go1plane"]


@pytest.mark.parametrize("task", TASKS)
def test_rendering_models_have_the_physics_models_bodies_and_contacts(task: str) -> None:
    """Visual geoms have no contacts and no mass: all else, and every collision geom, is as in the physics model."""
    env = made(task)
    physics, drawn = env.compiled.model, env.mj_model
    assert drawn.ngeom > physics.ngeom and physics.nsite == physics.ntex == physics.nlight == 0
    for name in ("nq", "nv", "nu", "nbody", "nmocap", "qpos0", *BODIES):
        np.testing.assert_array_equal(getattr(physics, name), getattr(drawn, name), err_msg=name)
    solid = np.flatnonzero((drawn.geom_contype | drawn.geom_conaffinity) != 0)
    assert [drawn.geom(i).name for i in solid] == [physics.geom(i).name for i in range(physics.ngeom)]
    for name in GEOM:
        ours, theirs = getattr(physics, f"geom_{name}"), getattr(drawn, f"geom_{name}")[solid]
        np.testing.assert_array_equal(ours, theirs, err_msg=name)


@pytest.mark.parametrize("task", TWELVE)
def test_team_colours_are_those_of_the_agents(task: str) -> None:
    """Robots of a match's first team are blue and green, of its second red and orange."""
    env = made(task)
    shown = [geometry.robot_color(env.mj_model, body)[:3] for body in geometry.robot_bases(env.mj_model)]
    warm = [red > blue for red, _, blue in shown]
    robots = range(len(shown))
    expected = [i in env.teams[1] for i in robots] if len(env.teams) > 1 else [i >= env.num_agents for i in robots]
    assert warm == expected and len(set(shown)) == len(shown)


def in_frame(model: mujoco.MjModel, episode: Episode, views: list[Camera]) -> np.ndarray:
    """Which targets' centres, then which goal points, are in the image of each frame (T, targets + P) bool."""
    data, bodies, rows = mujoco.MjData(model), visibility.targets(model, episode), []
    boxes, goals = geometry.body_boxes(model, bodies), visibility.goal_points(model, episode)
    tangent = np.tan(np.radians(model.vis.global_.fovy) / 2)
    for index, camera in enumerate(views):
        geometry.pose(model, data, episode, index)
        points = np.concatenate([geometry.posed(data, bodies, boxes).mean(axis=1), goals])
        forward, right, up = camera.axes
        offset = points - np.array(camera.lookat)
        depth = np.maximum(camera.distance + offset @ forward, 1e-6) * tangent
        rows.append((np.abs(offset @ right) <= ASPECT * depth) & (np.abs(offset @ up) <= depth))
    return np.array(rows)


def longest(flags: np.ndarray) -> int:
    """Returns the length of the longest run of true values in any column of `flags` (T, N)."""
    run, top = np.zeros(flags.shape[1], int), 0
    for row in flags:
        run = (run + 1) * row
        top = max(top, int(run.max(initial=0)))
    return top


def check(env: Any, episode: Episode) -> None:
    """Checks that a following camera shows all targets and the goal, unhidden, and moves smoothly."""
    model = geometry.rendering_model(env.mj_model, episode)
    views = cameras.cameras(model, episode, "follow", ASPECT)
    assert in_frame(model, episode, views).all(axis=1).mean() >= 0.95
    assert longest(visibility.hidden(model, episode, views) == 1.0) * episode.dt <= 1.0
    eyes = np.array([view.position for view in views])
    assert np.linalg.norm(np.diff(eyes, axis=0), axis=1).max(initial=0.0) < 4.0 * episode.dt  # m, at most 4 m/s


def walking(task: str, path: Any, objects: Any = None, frames: int = 21, dt: float = 0.2) -> Episode:
    """An episode in which the robots have the positions `path(t)` (R, 3), t from 0 to 1, and objects `objects(t)`."""
    states = [placed(made(task), path(t), objects=objects and objects(t)) for t in np.linspace(0, 1, frames)]
    data = [state.data for state in states]
    fields = ("qpos", "mocap_pos", "mocap_quat")
    return Episode(*(np.stack([np.asarray(getattr(one, name)) for one in data]) for name in fields), dt=dt)


def test_the_gates_camera_shows_both_robots_the_one_that_waits_too() -> None:
    """The second robot stands in a corner beside the wall while the first one passes."""
    env = made("go1gate")
    gate = np.asarray(placed(env, np.zeros((2, 3))).anchors[0])
    through = lambda t: [[1.0 + 4.5 * t, gate[1], 0.3], [gate[0] - 0.45, -1.15, 0.3]]  # noqa: E731
    check(env, walking("go1gate", through))


def test_the_pitchs_camera_shows_four_robots_ball_and_goal() -> None:
    start = np.array([[4, -2, 0.3], [4, 2, 0.3], [10, 2, 0.3], [10, -2, 0.3]])
    speed = np.array([[6.0, 1.0, 0], [2.0, -3.0, 0], [-4.0, -1.0, 0], [1.0, 3.0, 0]])
    ball = lambda t: {"ball": [7.0 + 5.3 * t, 0.5 * t, 0.1, 1, 0, 0, 0]}  # noqa: E731
    check(made("go1football-2vs2"), walking("go1football-2vs2", lambda t: start + t * speed, ball))


def test_the_meadows_camera_shows_nine_sheep() -> None:
    grid = np.stack(np.meshgrid([-1.5, 0, 1.5], [-1.5, 0, 1.5]), axis=-1).reshape(-1, 2)
    flock = lambda t: {f"sheep{i}": [4 + 5 * t + x * (1 - t / 2), y * (1 - t / 2)] for i, (x, y) in enumerate(grid)}  # noqa: E731
    dogs = lambda t: [[1.0 + 5 * t, -1.5, 0.3], [1.0 + 5 * t, 1.5, 0.3]]  # noqa: E731
    check(made("go1sheep-hard"), walking("go1sheep-hard", dogs, flock, frames=11))


def test_a_robot_behind_a_wall_is_hidden_and_one_beside_another_is_not() -> None:
    env = made("go1gate")
    episode = walking("go1gate", lambda t: [[3.9, 1.2, 0.3], [1.0, 1.2, 0.3]], frames=2)
    model = geometry.rendering_model(env.mj_model, episode)
    low = Camera((3.0, 1.2, 0.3), 5.0, azimuth=0.0, elevation=-2.0)  # from the start, along the track
    assert visibility.hidden(model, episode, [low] * 2)[:, 0].tolist() == [1.0, 1.0]
    assert visibility.hidden(model, episode, [low] * 2)[:, 1].tolist() == [0.0, 0.0]
    above = Camera((3.0, 1.2, 0.3), 5.0, azimuth=0.0, elevation=-80.0)
    assert visibility.hidden(model, episode, [above] * 2).max() == 0.0
    near = Camera((1.0, 1.2, 0.3), 1.5, azimuth=90.0, elevation=-80.0)
    inside = in_frame(model, episode, [near] * 2)
    assert inside[:, 1].all() and not inside[:, 0].any()  # the other robot is beyond the image's edge


def test_runs_are_measured_within_columns() -> None:
    flags = np.array([[1, 0], [1, 1], [0, 1], [1, 1], [0, 1]], bool)
    assert longest(flags) == 4
    assert longest(flags[:, :1]) == 2
    assert longest(flags[:0]) == 0


def test_gates_and_goals_are_marked_for_the_cameras() -> None:
    """The sites of a gate are at the edges of its gap."""
    env = made("go1gate")
    episode = walking("go1gate", lambda t: [[1, -0.7, 0.3], [1, 0.7, 0.3]], frames=1)
    points = visibility.goal_points(env.mj_model, episode)
    gate, half = np.asarray(placed(env, np.zeros((2, 3))).anchors[0]), env.params.gate_width / 2
    np.testing.assert_allclose(np.unique(points[:, 1].round(4)), [gate[1] - half, gate[1] + half], atol=1e-3)
    assert all(env.mj_model.site(i).name.startswith(GOAL_SITE) for i in range(env.mj_model.nsite))


@pytest.mark.soak
@pytest.mark.parametrize("task", TWELVE)
def test_the_camera_of_every_task_shows_an_episode_of_its_policy(task: str) -> None:
    env = make(task, impl="c")
    own = load_policy(task if task in zoo.names() else "scripted", env)
    policy = all_agents(env, own, own if len(env.teams) > 1 else None)
    for episode in record(env, policy.act, policy.initial_memory(4), jax.random.PRNGKey(1), episodes=4):
        check(env, episode.cut(slice(None, None, 4)))
