"""What a Go1 looks like: primitives that touch nothing and weigh nothing, m, in the frames of its links."""

from __future__ import annotations

from typing import Any

import mujoco

# Robot colours by agent (red, green, blue, alpha): 1 blue, 2 green, 3 red, 4 orange.
COLORS = (
    (0.13, 0.59, 0.95, 1.0),
    (0.36, 0.80, 0.26, 1.0),
    (0.93, 0.28, 0.20, 1.0),
    (0.98, 0.60, 0.12, 1.0),
)


_DARK = (0.13, 0.14, 0.16, 1.0)
_GREY = (0.32, 0.34, 0.37, 1.0)


def _look(body: Any, kind: Any, rgba: tuple[float, ...], **shape: Any) -> None:
    body.add_geom(type=kind, rgba=rgba, contype=0, conaffinity=0, group=2, mass=0.0, **shape)


def add_trunk(trunk: Any, color: tuple[float, ...]) -> None:
    """Adds what is looked at of the trunk, in a colour."""
    box, capsule = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CAPSULE
    ellipsoid, sphere = mujoco.mjtGeom.mjGEOM_ELLIPSOID, mujoco.mjtGeom.mjGEOM_SPHERE
    _look(trunk, box, color, size=(0.155, 0.052, 0.048), pos=(0.0, 0, 0.012))
    _look(trunk, ellipsoid, color, size=(0.2, 0.056, 0.05), pos=(0.0, 0, 0.024))
    _look(trunk, box, _DARK, size=(0.145, 0.045, 0.03), pos=(0, 0, -0.03))
    for end in (-1, 1):  # the hip motors' housings
        _look(trunk, box, _DARK, size=(0.035, 0.075, 0.042), pos=(end * 0.188, 0, 0))
    _look(trunk, capsule, _DARK, size=(0.03, 0, 0), fromto=(0.2, 0, 0.02, 0.255, 0, 0.028))
    _look(trunk, box, color, size=(0.03, 0.046, 0.032), pos=(0.275, 0, 0.034))
    _look(trunk, box, _DARK, size=(0.006, 0.04, 0.024), pos=(0.304, 0, 0.034))
    for side in (-1, 1):
        _look(trunk, sphere, (0.9, 0.95, 1.0, 1.0), size=(0.009, 0, 0), pos=(0.309, side * 0.022, 0.04))
        _look(
            trunk,
            capsule,
            _DARK,
            size=(0.008, 0, 0),
            fromto=(-0.13, side * 0.035, 0.068, 0.13, side * 0.035, 0.068),
        )


def add_leg(
    hip: Any, thigh: Any, calf: Any, left: int, color: tuple[float, ...], lengths: tuple[float, float], foot: float
) -> None:
    """Adds what is looked at of one leg, on the left (1) or the right (-1), in a colour.

    Args:
        hip, thigh, calf: bodies.
        left: 1 or -1.
        color: red, green, blue, alpha.
        lengths: of thigh and calf, m.
        foot: its radius, m.
    """
    thigh_length, calf_length = lengths
    cylinder, capsule = mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_CAPSULE
    sphere = mujoco.mjtGeom.mjGEOM_SPHERE
    _look(hip, cylinder, _GREY, size=(0.043, 0, 0), fromto=(0, left * 0.03, 0, 0, left * 0.075, 0))
    _look(thigh, cylinder, color, size=(0.04, 0, 0), fromto=(0, -left * 0.022, 0, 0, left * 0.02, 0))
    _look(thigh, capsule, _DARK, size=(0.022, 0, 0), fromto=(0, 0, -0.02, -0.012, 0, -0.11))
    _look(thigh, capsule, _DARK, size=(0.017, 0, 0), fromto=(-0.012, 0, -0.11, 0, 0, -thigh_length))
    _look(calf, capsule, _GREY, size=(0.013, 0, 0), fromto=(0, 0, 0, 0.008, 0, -0.1))
    _look(calf, capsule, _GREY, size=(0.01, 0, 0), fromto=(0.008, 0, -0.1, 0, 0, -calf_length))
    _look(calf, sphere, _DARK, size=(foot, 0, 0), pos=(0, 0, -calf_length))
