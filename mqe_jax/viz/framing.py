"""Free cameras, and the one of a given direction whose image contains some points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

_ROOM = 1.07  # factor of the distance at which the points would reach the image's edges


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

    @property
    def axes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Directions forward, right and up (3,)."""
        azimuth, elevation = np.radians(self.azimuth), np.radians(self.elevation)
        level = np.cos(elevation)
        forward = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
        right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
        return forward, right, np.cross(right, forward)

    @property
    def position(self) -> np.ndarray:
        """Position (3,), m."""
        return np.array(self.lookat) - self.distance * self.axes[0]


def fitted(
    model: mujoco.MjModel, corners: np.ndarray, camera: Camera, aspect: float, distances: tuple[float, float]
) -> Camera:
    """Returns a camera of the same direction whose image contains and centres the points `corners` (P, 3)."""
    forward, right, up = camera.axes
    tangent = float(np.tan(np.radians(model.vis.global_.fovy) / 2))  # of half the vertical field of view
    lookat, distance = (corners.min(axis=0) + corners.max(axis=0)) / 2, 1.0
    for _ in range(25):  # centre the projection, then adjust the distance
        offset = corners - lookat
        # A corner is in the image where |offset right| <= depth tan aspect and |offset up| <= depth tan.
        need = np.maximum(np.abs(offset @ right) / aspect, np.abs(offset @ up)) / tangent - offset @ forward
        distance = need.max()
        depth = distance + offset @ forward
        across, along = offset @ right / depth, offset @ up / depth
        shift = distance * ((across.max() + across.min()) * right + (along.max() + along.min()) * up) / 4
        lookat = lookat + shift
    return replace(camera, lookat=tuple(lookat.tolist()), distance=float(np.clip(_ROOM * distance, *distances)))


def smoothed(views: Sequence[Camera], width: int) -> list[Camera]:
    """Returns cameras smoothed by a triangular window of `2 width + 1` frames."""
    values = np.array([[*camera.lookat, camera.distance] for camera in views])
    padded = np.concatenate([np.repeat(values[:1], width, 0), values, np.repeat(values[-1:], width, 0)])
    weights = np.minimum(np.arange(1, 2 * width + 2), np.arange(2 * width + 1, 0, -1)) / (width + 1) ** 2
    means = np.stack([np.convolve(column, weights, mode="valid") for column in padded.T], axis=1)
    rows = zip(views, means.tolist(), strict=True)
    return [replace(camera, lookat=(x, y, z), distance=distance) for camera, (x, y, z, distance) in rows]
