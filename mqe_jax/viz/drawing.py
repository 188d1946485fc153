"""What a robot senses, over a scene of MuJoCo's renderer."""

import itertools
from collections.abc import Sequence

import mujoco
import numpy as np

from mqe_jax.sensors.marks import Marks

_LINE = 1 / 450  # width of a line, as a part of the image's height
_POINT = 1 / 220  # radius of a point, as a part of the camera's distance
_AREA = 0.3  # opacity of an area
_SHADE = 0.55  # of a line's colour, as MuJoCo lights lines more than surfaces
_TYPE = mujoco.mjtGeom


def add_marks(
    scene: mujoco.MjvScene, marks: Sequence[Marks], frame: int, height: int, distance: float
) -> None:
    """Adds the first agent's marks in a frame to a scene.

    The image is `height` pixels high and seen from `distance`, m.
    """
    for mark in marks:
        lines = np.asarray(mark.lines[frame][0], float)
        opacity = np.asarray(mark.line_opacity[frame][0])
        width = max(1.0, (2 if mark.bold else 1) * _LINE * height)
        for (start, end), alpha in zip(lines[opacity > 0], opacity[opacity > 0], strict=True):
            geom = _add(scene, _TYPE.mjGEOM_LINE, mark, alpha)
            mujoco.mjv_connector(geom, _TYPE.mjGEOM_LINE, width, start, end)
        points = np.asarray(mark.points[frame][0], float)
        opacity = np.asarray(mark.point_opacity[frame][0])
        for point, alpha in zip(points[opacity > 0], opacity[opacity > 0], strict=True):
            geom = _add(scene, _TYPE.mjGEOM_SPHERE, mark, alpha)
            geom.size[:] = _POINT * distance
            geom.pos[:] = point
        area = np.asarray(mark.area[frame][0], float)
        for one, other in itertools.pairwise(area[1:]):
            # A triangle's corners are its origin and the ends of the first two axes.
            geom = _add(scene, _TYPE.mjGEOM_TRIANGLE, mark, _AREA)
            geom.size[:] = 1.0
            geom.pos[:] = area[0]
            geom.mat[:] = np.stack([one - area[0], other - area[0], (0.0, 0.0, 1.0)], axis=1)


def _add(
    scene: mujoco.MjvScene, kind: mujoco.mjtGeom, mark: Marks, opacity: float
) -> mujoco.MjvGeom:
    """Adds a geom of a kind that casts no shadow and does not shine."""
    geom = scene.geoms[scene.ngeom]
    shade = _SHADE if kind == _TYPE.mjGEOM_LINE else 1.0
    color = np.array([*(shade * part for part in mark.color), opacity], np.float32)
    mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), color)
    geom.specular = 0.0
    geom.category = mujoco.mjtCatBit.mjCAT_DECOR
    scene.ngeom += 1
    return geom
