"""For the measurement of penetration: limb axes of two robots that pass through each other between two frames."""

from __future__ import annotations

import mujoco
import numpy as np

from mqe_jax.robots.index import prefix
from mqe_jax.robots.robot import LEGS


def limb_axes(model: mujoco.MjModel, count: int, qpos: np.ndarray) -> np.ndarray:
    """Returns the ends of all limb axes, thighs then calves (F, R, 8, 2, 3), m, world frame."""
    points = np.zeros((len(qpos), count, 3, 4, 3))
    joints = [
        [[model.body(f"{prefix(r)}{leg}_{joint}").id for leg in LEGS] for joint in ("thigh", "calf")]
        for r in range(count)
    ]
    feet = [[model.geom(f"{prefix(r)}full/foot/{leg}").id for leg in LEGS] for r in range(count)]
    data = mujoco.MjData(model)
    for frame, pose in enumerate(qpos):
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        points[frame, :, :2] = data.xpos[joints]
        points[frame, :, 2] = data.geom_xpos[feet]
    return np.concatenate([np.stack([points[:, :, i], points[:, :, i + 1]], axis=3) for i in (0, 1)], axis=2)


def crossings(before: np.ndarray, after: np.ndarray) -> int:
    """Counts limb axes of two robots that pass through each other between frames (F, R, 8, 2, 3).

    The ends move in straight lines in between. Two axes can only cross where their four ends lie in one plane,
    at a change of sign of the volume that they span, which bisection finds.
    """
    total = 0
    for first in range(before.shape[1]):
        for second in range(first + 1, before.shape[1]):
            old = _pairs(before[:, first], before[:, second])
            new = _pairs(after[:, first], after[:, second])
            change = _volume(old) * _volume(new) < 0
            old, new = old[change], new[change]
            low, high = np.zeros(len(old)), np.ones(len(old))
            sign = _volume(old) > 0
            for _ in range(40):
                middle = (low + high) / 2
                same = (_volume(old + middle[:, None, None] * (new - old)) > 0) == sign
                low, high = np.where(same, middle, low), np.where(same, high, middle)
            total += int(np.sum(_meet(old + low[:, None, None] * (new - old))))
    return total


def _pairs(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """All pairs of axes (F, 8, 2, 3) x (F, 8, 2, 3) as four ends (F * 64, 4, 3)."""
    frames, axes = one.shape[:2]
    shape = (frames, axes, axes, 2, 3)
    pairs = np.concatenate([np.broadcast_to(one[:, :, None], shape), np.broadcast_to(two[:, None], shape)], axis=3)
    return pairs.reshape(-1, 4, 3)


def _volume(ends: np.ndarray) -> np.ndarray:
    """Six times the signed volume spanned by four points (P, 4, 3)."""
    a, b, c, d = np.moveaxis(ends, 1, 0)
    return np.sum(np.cross(b - a, d - c) * (c - a), axis=-1)


def _meet(ends: np.ndarray) -> np.ndarray:
    """Whether two segments (P, 4, 3) that lie in one plane cross (P,)."""
    a, b, c, d = np.moveaxis(ends, 1, 0)
    u, v, w = b - a, d - c, c - a
    normal = np.cross(u, v)
    scale = np.maximum(np.sum(normal**2, axis=-1), 1e-18)
    s = np.sum(np.cross(w, v) * normal, axis=-1) / scale
    t = np.sum(np.cross(w, u) * normal, axis=-1) / scale
    return (s > 0) & (s < 1) & (t > 0) & (t < 1)
