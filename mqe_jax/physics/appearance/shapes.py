"""Visual geoms, flat marks on the ground, and the walls of tracks and gates."""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from mqe_jax.physics.appearance import (
    DARK_WOOD,
    GOAL_SITE,
    GROUND_GROUP,
    INK,
    MEADOW,
    NAVY,
    SITE_GROUP,
    STEEL,
    VISUAL_GROUP,
    WHITE,
    WOOD,
    YELLOW,
    Color,
)

Kind = mujoco.mjtGeom
LAYER = 0.002  # height of a mark's top above that of the mark below it, m
Point = tuple[float, float]
Place = tuple[float, float, float]


def add_visual(
    body: Any, kind: Any, color: Color, group: int = VISUAL_GROUP, **options: Any
) -> None:
    """Adds a massless geom without contacts to a body; `options` are those of `add_geom`."""
    body.add_geom(type=kind, rgba=color, contype=0, conaffinity=0, group=group, mass=0.0, **options)


def add_box(body: Any, color: Color, half: ArrayLike, pos: ArrayLike, **options: Any) -> None:
    """Adds a visual box of half extents (3,) at a position (3,), m."""
    add_visual(body, Kind.mjGEOM_BOX, color, size=half, pos=pos, **options)


def add_rod(
    body: Any, color: Color, radius: float, start: Sequence[float], end: Sequence[float]
) -> None:
    """Adds a visual cylinder between two points (3,), m."""
    add_visual(body, Kind.mjGEOM_CYLINDER, color, size=(radius, 0, 0), fromto=(*start, *end))


def about_z(yaw: float) -> tuple[float, float, float, float]:
    """Returns the quaternion wxyz of a rotation about z, rad."""
    return float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2))


class Shape(NamedTuple):
    """A visual geom that is still to be added to a body."""

    kind: Any
    color: Color
    group: int
    options: Mapping[str, Any]  # options of `add_geom`

    def add(self, body: Any) -> None:
        """Adds the geom to a body, usually the world."""
        add_visual(body, self.kind, self.color, self.group, **self.options)


def mark(
    center: Place, size: tuple[float, ...], color: Color = WHITE, level: int = 1, yaw: float = 0.0
) -> Shape:
    """Returns a flat box of extents `size` (2,), or a disc of radius `size` (1,), m.

    `yaw` turns it about z.

    `center` is that of its top, with the height of what it is painted on; higher levels cover lower
    ones.
    """
    x, y, z = center
    half = LAYER * level / 2
    disc = len(size) == 1
    extents = (size[0], half, 0) if disc else (size[0] / 2, size[1] / 2, half)
    options = {"size": extents, "pos": (x, y, z + half), "quat": about_z(yaw)}
    return Shape(Kind.mjGEOM_CYLINDER if disc else Kind.mjGEOM_BOX, color, GROUND_GROUP, options)


def rod(start: Place, end: Place, radius: float, color: Color) -> Shape:
    """Returns a cylinder between two points, m, such as a goal post."""
    return Shape(
        Kind.mjGEOM_CYLINDER,
        color,
        VISUAL_GROUP,
        {"size": (radius, 0, 0), "fromto": (*start, *end)},
    )


def tuft(center: Place, half: Place, color: Color) -> Shape:
    """Returns an ellipsoid of half extents (3,) on the ground, m, such as grass."""
    return Shape(Kind.mjGEOM_ELLIPSOID, color, GROUND_GROUP, {"size": half, "pos": center})


def slab(center: Place, size: Place, color: Color) -> Shape:
    """Returns an upright box of extents (3,), m, such as the side of a stage."""
    options = {"size": [extent / 2 for extent in size], "pos": center}
    return Shape(Kind.mjGEOM_BOX, color, VISUAL_GROUP, options)


@dataclasses.dataclass(frozen=True)
class Ground:
    """Looks of the ground of a scene and of what stands on it."""

    color: Color = MEADOW  # colour of the plane
    shapes: tuple[Shape, ...] = ()  # what is painted on it or stands on it
    goals: tuple[Place, ...] = ()  # points that a camera keeps in view, such as goal posts, m

    def add(self, world: Any) -> None:
        """Adds all of it to the world's body."""
        for shape in self.shapes:
            shape.add(world)
        for number, point in enumerate(self.goals):
            world.add_site(name=f"{GOAL_SITE}/{number}", pos=point, group=SITE_GROUP)


def rectangle(x: Point, y: Point, color: Color, level: int = 1, z: float = 0.0) -> Shape:
    """Returns a filled rectangle between two x and two y, m."""
    return mark((sum(x) / 2, sum(y) / 2, z), (x[1] - x[0], y[1] - y[0]), color, level)


def line(
    start: Point,
    end: Point,
    color: Color = WHITE,
    width: float = 0.05,
    level: int = 3,
    z: float = 0.0,
) -> Shape:
    """Returns a straight line between two points (2,), m."""
    x0, y0 = start
    x1, y1 = end
    middle = ((x0 + x1) / 2, (y0 + y1) / 2, z)
    length = float(np.hypot(x1 - x0, y1 - y0))
    yaw = float(np.arctan2(y1 - y0, x1 - x0))
    return mark(middle, (length, width), color, level, yaw)


def outline(
    x: Point, y: Point, color: Color = WHITE, width: float = 0.05, z: float = 0.0
) -> tuple[Shape, ...]:
    """Returns the four edges of a rectangle."""
    corners = [(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])]
    edges = zip(corners, corners[1:] + corners[:1], strict=True)
    return tuple(line(a, b, color, width, z=z) for a, b in edges)


def circle(center: Point, radius: float, width: float) -> tuple[Shape, ...]:
    """Returns a white circle as short lines."""
    angles = np.linspace(0, 2 * np.pi, 37)
    reach = (radius + width / 2) / np.cos(np.pi / 36) - width / 2  # the lines' outer edges meet
    points = [
        (float(center[0] + reach * np.cos(a)), float(center[1] + reach * np.sin(a))) for a in angles
    ]
    return tuple(line(a, b, width=width) for a, b in itertools.pairwise(points))


Style = Literal["boards", "fence"]
"""Looks of walls, through which a camera sees the robots: boards with a rail above, or wooden
fences."""

WALL_COLOR: Color = (0.90, 0.89, 0.86, 1.0)
WALL_GROUP = 1
_THICK = 0.2  # half thickness from which a wall is a block without a marked edge, m
_BOARD = 0.28  # height of the boards as a fraction of the wall's
_RAIL = 0.045  # half height of a fence's rails, m


def side_wall(
    world: Any, style: Style, center: np.ndarray, half: tuple[float, float, float], yaw: float
) -> None:
    """Adds the look of a fixed wall at its `center` (3,), m.

    Its half extents are thickness, length and height, m.
    """
    x, y, z = half
    quat = about_z(yaw)

    def box(color: Color, size: tuple[float, float, float], along: float, height: float) -> None:
        place = (center[0] - along * np.sin(yaw), center[1] + along * np.cos(yaw), height)
        add_box(world, color, size, place, quat=quat, group=WALL_GROUP)

    count = max(2, round(2 * y / 1.25) + 1)
    posts = np.linspace(0.03 - y, y - 0.03, count).tolist()
    if style == "fence":
        for part in (0.35, 0.85):
            box(WOOD, (0.6 * x, y, _RAIL), 0.0, 2 * part * z)
        for along in posts:
            box(DARK_WOOD, (x, 0.035, z), along, z)
    else:
        box(STEEL, (0.6 * x, y, 0.015), 0.0, 2 * z)
        for along in posts:
            box(STEEL, (x, 0.02, z), along, z)
        board = _BOARD * 2 * z
        box(NAVY, (x, y, board / 2), 0.0, board / 2)
        box(WHITE, (1.05 * x, y, 0.012), 0.0, board)


def gate_wall(body: Any, style: Style, half: np.ndarray, inner: float) -> None:
    """Adds the look of a wall of half extents (3,), m, to its body.

    `inner` is the sign of y towards the gap.
    """
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
    height = z / 5
    for number, color in enumerate((YELLOW, INK, YELLOW, INK, YELLOW)):
        place = (0, inner * (y - wide + 0.004), -z + (2 * number + 1) * height)
        add_box(body, color, (1.1 * x, wide, height + 0.002), place, group=WALL_GROUP)
