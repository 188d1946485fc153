"""Cameras: fixed views of the whole scene or of all trajectories, and views that track robots and objects."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from mqe_jax.errors import InputError, nearest
from mqe_jax.viz.geometry import box_corners, extent, moving_bodies, pose, robot_bases, scenery_geoms
from mqe_jax.viz.recording import Episode


@dataclass(frozen=True)
class Camera:
    """A free camera, in MuJoCo's convention; angles in degrees."""

    lookat: tuple[float, float, float]
    """Point in the centre of the view, m."""
    distance: float
    """Distance from that point, m."""
    azimuth: float = 60.0
    """Azimuth, degrees: 0 points along +x, 90 along +y."""
    elevation: float = -46.0
    """Elevation, degrees: -90 points straight down."""


VIEWS = ("follow", "near", "scene", "side")
"""Names of the views. follow: tracks robots and objects; near: fixed, frames their trajectories; scene: fixed, whole
scene; side: tracks the first robot from its side."""

_MARGIN = np.array([0.45, 0.45, 0.3])  # around a followed body, m
_REACH = 3.0  # distance from the ball within which robots are followed, m
_TALL = 0.4  # height of walls above the trunks beyond which the camera is steeper, m
_ROUNDS = 8  # of following further robots
_SMOOTHING = 0.8  # duration over which a following camera is averaged, s


def default_camera(model: mujoco.MjModel, episode: Episode, aspect: float = 16 / 9) -> Camera:
    """Returns a three-quarter view from behind and above that contains the track and all robot trajectories."""
    low, high = extent(model, episode)
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (0, high[2])])
    return _fitted(model, corners, Camera((0.0, 0.0, 0.0), 1.0), aspect, (1.5, 60.0))


def cameras(model: mujoco.MjModel, episode: Episode, view: str, aspect: float = 16 / 9) -> list[Camera]:
    """Returns the camera of every frame of an episode, for a view of `VIEWS`.

    Raises:
        InputError: for an unknown view.
    """
    if view not in VIEWS:
        raise InputError(f"view: unknown name {view!r}{nearest(view, VIEWS)}; allowed: {', '.join(VIEWS)}")
    if view == "scene":
        return [default_camera(model, episode, aspect)] * len(episode)
    data = mujoco.MjData(model)
    pose(model, data, episode, 0)
    robots, objects = robot_bases(model), moving_bodies(model, episode)
    # Walls well above the robots would occlude them from a low camera.
    tops = [box_corners(model, data, geom)[:, 2].max() for geom in scenery_geoms(model)]
    tall = max(tops, default=0.0) > min(data.xpos[body][2] for body in robots) + _TALL
    start = Camera((0.0, 0.0, 0.0), 1.0, elevation=-50.0 if tall else -30.0)
    corners: list[dict[int, np.ndarray]] = []
    followed = np.zeros((len(episode), model.nbody), bool)
    for index in range(len(episode)):
        pose(model, data, episode, index)
        corners.append({body: _box(data, body) for body in (*robots, *objects)})
        followed[index, [robots[0]] if view == "side" else _followed(data, robots, objects)] = True

    def fit(chosen: Sequence[np.ndarray], distances: tuple[float, float]) -> Camera:
        return _fitted(model, np.concatenate(chosen), start, aspect, distances)

    if view == "near":
        inside = [corners[index][body] for index, body in np.argwhere(followed).tolist()]
        return [fit(inside, (2.0, 14.0))] * len(episode)
    if view == "side":
        centers = [boxes[robots[0]].mean(axis=0) for boxes in corners]
        fitted = [Camera((float(x), float(y), 0.22), 1.3, azimuth=90.0, elevation=-8.0) for x, y, _ in centers]
        return _smoothed(fitted, max(1, round(0.3 / episode.dt)))
    width = max(1, round(_SMOOTHING / episode.dt))
    views: list[Camera] = []
    for _ in range(_ROUNDS):
        chosen = [[boxes[body] for body in boxes if row[body]] for boxes, row in zip(corners, followed, strict=True)]
        views = _smoothed([fit(boxes, (2.0, 12.0)) for boxes in chosen], width)
        rows = zip(corners, views, strict=True)
        cut = np.array([[_cut(model, boxes[robot], camera, aspect) for robot in robots] for boxes, camera in rows])
        before = followed.copy()
        # A robot that the image would cut is followed too, from earlier on.
        for index, which in np.argwhere(cut).tolist():
            followed[max(0, index - 2 * width) : index + 2 * width + 1, robots[which]] = True
        if np.array_equal(before, followed):
            break
    return views


def _followed(data: mujoco.MjData, robots: Sequence[int], objects: Sequence[int]) -> list[int]:
    """Returns the bodies to frame: robots and moving objects; of the robots around a single object only near ones."""
    if len(objects) != 1 or len(robots) < 2:
        return [*robots, *objects]
    apart = {robot: float(np.linalg.norm(data.xpos[robot] - data.xpos[objects[0]])) for robot in robots}
    closest = sorted(robots, key=lambda robot: apart[robot])
    return [*(robot for i, robot in enumerate(closest) if i == 0 or apart[robot] < _REACH), *objects]


def _box(data: mujoco.MjData, body: int) -> np.ndarray:
    """Returns the corners of a box about a body (8, 3), m."""
    return np.array([data.xpos[body] + _MARGIN * (a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)])


def _cut(model: mujoco.MjModel, corners: np.ndarray, camera: Camera, aspect: float) -> bool:
    """Returns whether the image contains some, but not all of the corners (P, 3)."""
    forward, right, up = _axes(camera)
    offset = corners - np.array(camera.lookat)
    depth = (camera.distance + offset @ forward) * np.tan(np.radians(model.vis.global_.fovy) / 2)
    inside = (np.abs(offset @ right) <= depth * aspect) & (np.abs(offset @ up) <= depth)
    return bool(inside.any() and not inside.all())


def _axes(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the camera's directions forward, right and up (3,)."""
    azimuth, elevation = np.radians(camera.azimuth), np.radians(camera.elevation)
    forward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    return forward, right, np.cross(right, forward)


def _smoothed(fitted: Sequence[Camera], width: int) -> list[Camera]:
    """Returns cameras smoothed by a triangular window of `2 width + 1` frames."""
    values = np.array([[*camera.lookat, camera.distance] for camera in fitted])
    padded = np.concatenate([np.repeat(values[:1], width, 0), values, np.repeat(values[-1:], width, 0)])
    weights = np.minimum(np.arange(1, 2 * width + 2), np.arange(2 * width + 1, 0, -1)) / (width + 1) ** 2
    means = np.stack([np.convolve(column, weights, mode="valid") for column in padded.T], axis=1)
    rows = zip(fitted, means.tolist(), strict=True)
    return [replace(camera, lookat=(x, y, z), distance=distance) for camera, (x, y, z, distance) in rows]


def _fitted(
    model: mujoco.MjModel, corners: np.ndarray, camera: Camera, aspect: float, distances: tuple[float, float]
) -> Camera:
    """Returns a camera of the same direction whose image contains and centres the points `corners` (P, 3)."""
    forward, right, up = _axes(camera)
    tangent = np.tan(np.radians(model.vis.global_.fovy) / 2)
    lookat, distance = (corners.min(axis=0) + corners.max(axis=0)) / 2, 1.0
    for _ in range(60):  # centre the projection, then adjust the distance
        offset = corners - lookat
        # A corner is in the image where |offset right| <= depth tan aspect and |offset up| <= depth tan.
        need = np.maximum(np.abs(offset @ right) / aspect, np.abs(offset @ up)) / tangent - offset @ forward
        distance = need.max()
        depth = distance + offset @ forward
        across, along = offset @ right / depth, offset @ up / depth
        shift = distance * ((across.max() + across.min()) * right + (along.max() + along.min()) * up) / 4
        lookat = lookat + shift
    return replace(camera, lookat=tuple(lookat.tolist()), distance=float(np.clip(1.04 * distance, *distances)))
