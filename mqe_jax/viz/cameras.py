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
    fitted, everywhere = [], []
    for index in range(len(episode)):
        pose(model, data, episode, index)
        if view == "side":
            x, y, _ = data.xpos[robots[0]]
            fitted.append(Camera((float(x), float(y), 0.22), 1.3, azimuth=90.0, elevation=-8.0))
            continue
        places = data.xpos[_followed(data, robots, objects)]
        corners = np.concatenate([places + _MARGIN * (a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)])
        everywhere.append(corners)
        if view == "follow":
            fitted.append(_fitted(model, corners, start, aspect, (2.0, 9.0)))
    if view == "near":
        return [_fitted(model, np.concatenate(everywhere), start, aspect, (2.0, 14.0))] * len(episode)
    width = 0.3 if view == "side" else _SMOOTHING
    return _smoothed(fitted, max(1, round(width / episode.dt)))


def _followed(data: mujoco.MjData, robots: Sequence[int], objects: Sequence[int]) -> list[int]:
    """Returns the bodies to frame: robots and moving objects; of the robots around a single object only near ones."""
    if len(objects) != 1 or len(robots) < 2:
        return [*robots, *objects]
    apart = {robot: float(np.linalg.norm(data.xpos[robot] - data.xpos[objects[0]])) for robot in robots}
    closest = sorted(robots, key=lambda robot: apart[robot])
    return [*(robot for i, robot in enumerate(closest) if i == 0 or apart[robot] < _REACH), *objects]


def _smoothed(fitted: Sequence[Camera], width: int) -> list[Camera]:
    """Returns cameras smoothed by a triangular window of `2 width + 1` frames."""
    values = np.array([[*camera.lookat, camera.distance] for camera in fitted])
    padded = np.concatenate([np.repeat(values[:1], width, 0), values, np.repeat(values[-1:], width, 0)])
    weights = np.minimum(np.arange(1, 2 * width + 2), np.arange(2 * width + 1, 0, -1)) / (width + 1) ** 2
    means = np.stack([np.convolve(column, weights, mode="valid") for column in padded.T], axis=1)
    return [
        replace(camera, lookat=(float(x), float(y), float(z)), distance=float(distance))
        for camera, (x, y, z, distance) in zip(fitted, means, strict=True)
    ]


def _fitted(
    model: mujoco.MjModel, corners: np.ndarray, camera: Camera, aspect: float, distances: tuple[float, float]
) -> Camera:
    """Returns a camera of the same direction whose image contains and centres the points `corners` (P, 3)."""
    azimuth, elevation = np.radians(camera.azimuth), np.radians(camera.elevation)
    forward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    up = np.cross(right, forward)
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
    distance = float(np.clip(1.04 * distance, *distances))
    return replace(camera, lookat=(float(lookat[0]), float(lookat[1]), float(lookat[2])), distance=distance)
