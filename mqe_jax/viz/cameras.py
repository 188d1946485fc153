"""Cameras: fixed views of a scene, and views that track robots and objects."""

import itertools

import mujoco
import numpy as np

from mqe_jax.core.errors import known_name
from mqe_jax.viz.framing import Camera, fit, goal_points, hidden, smooth, targets
from mqe_jax.viz.geometry import (
    body_boxes,
    extent,
    height_factor,
    pose_boxes,
    pose_frames,
    shown_bases,
)
from mqe_jax.viz.recording import Episode

VIEWS = ("follow", "near", "scene", "side")
"""Names of the views.

- follow: tracks robots, objects and the goal from the direction in which they are seen best.
- near: the same, fixed.
- scene: fixed, the whole scene.
- side: tracks the first robot from its side.
"""

_MARGIN = np.array([0.4, 0.4, 0.25])  # around a robot's trunk, m
_SMOOTHING = 0.6  # duration over which a following camera is averaged, s
_SAMPLES = 24  # frames of an episode by which directions are compared
_DISTANCES = (2.0, 16.0)  # of a camera that follows up to `_FEW` robots, m; further away from more
_FEW = 8
_AZIMUTHS = (90.0, 60.0, 30.0, 0.0, -30.0, 120.0)
_ELEVATIONS = (-30.0, -38.0, -48.0, -60.0)
_BEHIND = 2.0  # m of distance that a camera may add to see the robots beside each other
_HIDDEN = 12.0  # m of distance that a camera may add to see the targets all the time


def default_camera(model: mujoco.MjModel, episode: Episode, aspect: float = 16 / 9) -> Camera:
    """Returns a three-quarter view from behind and above of the track and all trajectories."""
    low, high = extent(model, episode)
    ends = ((low[0], high[0]), (low[1], high[1]), (0, high[2]))
    corners = np.array(list(itertools.product(*ends)))
    return fit(model, corners, Camera((0.0, 0.0, 0.0), 1.0), aspect, (1.5, 60.0))


def cameras(
    model: mujoco.MjModel, episode: Episode, view: str, aspect: float = 16 / 9
) -> list[Camera]:
    """Returns the camera of every frame of an episode, for a view of `VIEWS`.

    InputError for an unknown view.
    """
    if known_name("view: unknown name", view, VIEWS) == "scene":
        return [default_camera(model, episode, aspect)] * len(episode)
    if view == "side":
        return _beside(model, episode)
    points = _points(model, episode)
    goals = goal_points(model, episode)
    fixed = len(episode) if view == "near" else 0
    direction = _direction(model, episode, points, goals, aspect, fixed)
    width = max(1, min(round(_SMOOTHING / episode.dt), len(episode) // 5))
    views = _following(model, points, goals, direction, aspect, fixed or width)
    return views if fixed else smooth(views, width)


def _points(model: mujoco.MjModel, episode: Episode) -> list[np.ndarray]:
    """Returns the corners (8 x targets, 3) of boxes about the targets of each frame, m."""
    bodies = targets(model, episode)
    robots = len(shown_bases(model))
    local = body_boxes(model, bodies)
    frames = []
    corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    margins = height_factor(model) * _MARGIN * corners
    for data in pose_frames(model, episode, range(len(episode))):
        boxes = pose_boxes(data, bodies, local)
        boxes[:robots] = data.xpos[bodies[:robots], None] + margins
        frames.append(boxes.reshape(-1, 3))
    return frames


def _direction(
    model: mujoco.MjModel,
    episode: Episode,
    points: list[np.ndarray],
    goals: np.ndarray,
    aspect: float,
    width: int,
) -> Camera:
    """Returns a camera of the direction in which the targets are hidden least and close enough."""
    sample = np.unique(np.linspace(0, len(episode) - 1, _SAMPLES).astype(int))
    part = Episode(
        episode.qpos[sample], episode.mocap_pos[sample], episode.mocap_quat[sample], dt=episode.dt
    )
    few = [points[i] for i in sample]

    def cost(camera: Camera) -> float:
        views = _following(model, few, goals, camera, aspect, width)
        away = [
            np.linalg.norm(box - view.position, axis=-1).mean()
            for box, view in zip(few, views, strict=True)
        ]
        unseen = hidden(model, part, views).mean(axis=0).max()
        return max(away) + _BEHIND * _alignment(model, part, camera.axes[1]) + _HIDDEN * unseen

    angles = itertools.product(_AZIMUTHS, _ELEVATIONS)
    return min((Camera((0.0, 0.0, 0.0), 1.0, *pair) for pair in angles), key=cost)


def _alignment(model: mujoco.MjModel, episode: Episode, right: np.ndarray) -> float:
    """Returns how much robots are behind each other, 0 to 1, for a view whose right is `right`."""
    robots = shown_bases(model)
    values = []
    for data in pose_frames(model, episode, range(len(episode))):
        place = data.xpos[robots, :2]
        apart = (place[:, None] - place)[np.triu_indices(len(robots), 1)]
        across = np.abs(apart @ right[:2]) / np.maximum(np.linalg.norm(apart, axis=1), 1e-6)
        values.append(1.0 - across.mean() if len(across) else 0.0)
    return float(np.mean(values))


def _following(
    model: mujoco.MjModel,
    points: list[np.ndarray],
    goals: np.ndarray,
    direction: Camera,
    aspect: float,
    width: int,
) -> list[Camera]:
    """Returns a camera for each frame that contains the goal and the targets.

    The targets are those of all frames at most `width` away.
    """
    views = []
    near, far = _DISTANCES
    far *= max(1.0, float(np.sqrt(len(shown_bases(model)) / _FEW)))
    for index in range(len(points)):
        around = points[max(0, index - width) : index + width + 1]
        corners = np.stack([np.min(around, axis=0), np.max(around, axis=0)]).reshape(-1, 3)
        views.append(fit(model, np.concatenate([corners, goals]), direction, aspect, (near, far)))
    return views


def _beside(model: mujoco.MjModel, episode: Episode) -> list[Camera]:
    robot = shown_bases(model)[0]
    frames = pose_frames(model, episode, range(len(episode)))
    places = [data.xpos[robot, :2].tolist() for data in frames]
    factor = height_factor(model)
    views = [
        Camera((x, y, 0.22 * factor), 1.3 * factor, azimuth=90.0, elevation=-8.0) for x, y in places
    ]
    return smooth(views, max(1, round(0.3 / episode.dt)))
