"""Spheres and capsules in place of shapes of other kinds: all engines support them."""

from collections.abc import Sequence

import mujoco
import numpy as np

from mqe_jax.physics.robots.robot import Primitive

ROW = 3  # capsules side by side, at most
_GEOM = mujoco.mjtGeom


def cloud(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Returns points (N, 3), m, of the surface of a geom, in the frame of its body."""
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
    turn = turn.reshape(3, 3)
    kind = model.geom_type[geom]
    size = model.geom_size[geom]
    if kind == _GEOM.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first = model.mesh_vertadr[mesh]
        own = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
    else:
        half = {
            int(_GEOM.mjGEOM_SPHERE): size[[0, 0, 0]],
            int(_GEOM.mjGEOM_CAPSULE): size[[0, 0, 1]] + [0, 0, size[0]],
            int(_GEOM.mjGEOM_CYLINDER): size[[0, 0, 1]],
        }.get(int(kind), size)
        own = half * np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return model.geom_pos[geom] + own @ turn.T


def fit(points: np.ndarray, most: int = ROW) -> list[Primitive]:
    """Returns capsules along the longest side of a box about points (N, 3), m.

    The box has the axes of the frame, or the points' principal ones if the capsules are then
    smaller. Up to `most` capsules are side by side; one that is not longer than wide is a sphere.
    """
    _, principal = np.linalg.eigh(np.cov((points - points.mean(axis=0)).T))
    rows = [_row(points, axes, most) for axes in (np.eye(3), principal)]
    return min(rows, key=lambda row: round(volume(row), 9))


def _row(points: np.ndarray, axes: np.ndarray, most: int) -> list[Primitive]:
    """Returns the capsules in a box with given axes, the columns (3, 3)."""
    own = points @ axes
    low = own.min(axis=0)
    half = (own.max(axis=0) - low) / 2
    short, mid, long = np.argsort(half, kind="stable")
    if half[long] < 1.25 * half[mid] or half[long] < 1e-3:  # a disc or a ball
        return [Primitive("sphere", max(float(half.mean()), 1e-3), _triple(axes @ (low + half)))]
    count = int(np.clip(round(half[mid] / max(half[short], 1e-3)), 1, most))
    radius = max(half[short] if count > 1 else (half[short] + half[mid]) / 2, 1e-3)
    reach = max(half[long] - radius, 0.0) * axes[:, long]
    found = []
    for place in np.linspace(-1.0, 1.0, count) if count > 1 else (0.0,):
        center = axes @ (low + half) + place * (half[mid] - radius) * axes[:, mid]
        if np.linalg.norm(reach) < 0.05 * radius:
            found.append(Primitive("sphere", float(radius), _triple(center)))
        else:
            ends = (_triple(center - reach), _triple(center + reach))
            found.append(Primitive("capsule", float(radius), *ends))
    return found


def volume(primitives: Sequence[Primitive]) -> float:
    """Returns the sum of the volumes of spheres and capsules, m^3."""
    return sum(_volume(each) for each in primitives)


def _volume(primitive: Primitive) -> float:
    radius = float(np.atleast_1d(primitive.size)[0])
    length = 0.0
    if primitive.end is not None:
        length = float(np.linalg.norm(np.subtract(primitive.end, primitive.position)))
    return np.pi * radius**2 * (length + 4 / 3 * radius)


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
