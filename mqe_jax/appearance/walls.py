"""Walls of the tracks: boards with a rail above, wooden fences, and the walls of gates."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from mqe_jax.appearance import DARK_WOOD, INK, NAVY, STEEL, WHITE, WOOD, YELLOW, Color
from mqe_jax.appearance.shapes import about_z, add_box

Style = Literal["boards", "fence"]
"""Looks of walls, through which a camera sees the robots: boards with a rail above, or wooden fences."""

WALL_COLOR: Color = (0.90, 0.89, 0.86, 1.0)
WALL_GROUP = 1
_THICK = 0.2  # half thickness from which a wall is a block without a marked edge, m
_BOARD = 0.28  # height of the boards as a fraction of the wall's
_RAIL = 0.045  # half height of a fence's rails, m


def side_wall(world: Any, style: Style, center: np.ndarray, half: tuple[float, float, float], yaw: float) -> None:
    """Adds the look of a fixed wall of half extents (thickness, length, height) at its `center` (3,), m."""
    x, y, z = half
    quat = about_z(yaw)

    def box(color: Color, size: tuple[float, float, float], along: float, height: float) -> None:
        turned = np.array([-np.sin(yaw), np.cos(yaw)]) * along
        place = (center[0] + turned[0], center[1] + turned[1], height)
        add_box(world, color, size, place, quat=quat, group=WALL_GROUP)

    wood = style == "fence"
    rail, post = (WOOD, DARK_WOOD) if wood else (STEEL, STEEL)
    for part in (0.35, 0.85) if wood else (1.0,):
        box(rail, (0.6 * x, y, _RAIL if wood else 0.015), 0.0, 2 * part * z)
    count = max(2, round(2 * y / 1.25) + 1)
    for along in np.linspace(0.03 - y, y - 0.03, count):
        box(post, (x, 0.035 if wood else 0.02, z), float(along), z)
    if not wood:
        board = _BOARD * 2 * z
        box(NAVY, (x, y, board / 2), 0.0, board / 2)
        box(WHITE, (1.05 * x, y, 0.012), 0.0, board)


def gate_wall(body: Any, style: Style, half: np.ndarray, inner: float) -> None:
    """Adds the look of a wall of half extents (3,), m, to its body; `inner` is the sign of y towards the gap."""
    x, y, z = half
    if style == "fence":
        for part in (0.22, 0.56, 0.9):
            add_box(body, WOOD, (0.3 * x, y, _RAIL), (0, 0, (2 * part - 1) * z), group=WALL_GROUP)
    else:
        proud = x + 0.004
        if x < _THICK:
            add_box(body, NAVY, (proud, y, 0.03), (0, 0, z - 0.03 + 0.004), group=WALL_GROUP)
        add_box(body, NAVY, (proud, y, 0.2 * z), (0, 0, -0.8 * z), group=WALL_GROUP)
    if x > _THICK:
        return
    wide = 0.05
    for number, color in enumerate((YELLOW, INK, YELLOW, INK, YELLOW)):
        height = z / 5
        place = (0, inner * (y - wide + 0.004), -z + (2 * number + 1) * height)
        add_box(body, color, (1.1 * x, wide, height + 0.002), place, group=WALL_GROUP)
