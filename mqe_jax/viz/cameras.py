"""Cameras that frame the whole scene."""

from dataclasses import dataclass, replace

import mujoco
import numpy as np

from mqe_jax.viz.geometry import extent
from mqe_jax.viz.recording import Episode


@dataclass(frozen=True)
class Camera:
    """A free camera, in MuJoCo's convention; angles in degrees."""

    lookat: tuple[float, float, float]
    """Point in the centre of the view, m."""
    distance: float
    """Distance from that point, m."""
    azimuth: float = 60.0
    """Azimuth, degrees: 0 looks along +x, 90 along +y."""
    elevation: float = -46.0
    """Elevation, degrees: -90 looks straight down."""


def default_camera(model: mujoco.MjModel, episode: Episode, aspect: float = 16 / 9) -> Camera:
    """Returns a three-quarter view from behind and above that contains the track and all robot trajectories."""
    low, high = extent(model, episode)
    centre = (low + high) / 2
    camera = Camera((float(centre[0]), float(centre[1]), 0.2), 1.0)
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (0, high[2])])
    azimuth, elevation = np.radians(camera.azimuth), np.radians(camera.elevation)
    forward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    up = np.cross(right, forward)
    tangent = np.tan(np.radians(model.vis.global_.fovy) / 2)
    lookat, distance = np.array(camera.lookat), 1.0
    for _ in range(60):  # centre the projection, then adjust the distance
        offset = corners - lookat
        # A corner is in the image where |offset right| <= depth tan aspect and |offset up| <= depth tan.
        need = np.maximum(np.abs(offset @ right) / aspect, np.abs(offset @ up)) / tangent - offset @ forward
        distance = need.max()
        depth = distance + offset @ forward
        across, along = offset @ right / depth, offset @ up / depth
        shift = distance * ((across.max() + across.min()) * right + (along.max() + along.min()) * up) / 4
        lookat = lookat + shift
    distance = float(np.clip(1.04 * distance, 1.5, 60.0))
    return replace(camera, lookat=(float(lookat[0]), float(lookat[1]), float(lookat[2])), distance=distance)
