"""Visual geoms and flat marks on the ground."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from mqe_jax.appearance import GOAL_SITE, GROUND_GROUP, MEADOW, SITE_GROUP, VISUAL_GROUP, WHITE, Color

Kind = mujoco.mjtGeom
LAYER = 0.002  # height of a mark's top above that of the mark below it, m
Point = tuple[float, float]


def add_visual(body: Any, kind: Any, color: Color, group: int = VISUAL_GROUP, **options: Any) -> None:
    """Adds a massless geom without contacts to a body; `options` are those of `add_geom`."""
    body.add_geom(type=kind, rgba=color, contype=0, conaffinity=0, group=group, mass=0.0, **options)


def add_box(body: Any, color: Color, half: ArrayLike, pos: ArrayLike, **options: Any) -> None:
    """Adds a visual box of half extents (3,) at a position (3,), m."""
    add_visual(body, Kind.mjGEOM_BOX, color, size=half, pos=pos, **options)


def add_rod(body: Any, color: Color, radius: float, start: Sequence[float], end: Sequence[float]) -> None:
    """Adds a visual cylinder between two points (3,), m."""
    add_visual(body, Kind.mjGEOM_CYLINDER, color, size=(radius, 0, 0), fromto=(*start, *end))


def about_z(yaw: float) -> tuple[float, float, float, float]:
    """Returns the quaternion wxyz of a rotation about z, rad."""
    return float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2))


@dataclasses.dataclass(frozen=True)
class Mark:
    """A flat box, or a disc where `size` has one entry."""

    center: tuple[float, float, float]
    """Centre of its top, with the height of what it is painted on, m."""
    size: tuple[float, ...]
    """Extents along x and y (2,), or a disc's radius (1,), m."""
    color: Color = WHITE
    """Colour."""
    level: int = 1
    """Marks of a higher level cover those of lower ones."""
    yaw: float = 0.0
    """Rotation about z, rad."""

    def add(self, body: Any) -> None:
        """Adds the mark's geom to a body, usually the world."""
        x, y, z = self.center
        half, disc = LAYER * self.level / 2, len(self.size) == 1
        size = (self.size[0], half, 0) if disc else (self.size[0] / 2, self.size[1] / 2, half)
        kind = Kind.mjGEOM_CYLINDER if disc else Kind.mjGEOM_BOX
        place = {"pos": (x, y, z + half), "quat": about_z(self.yaw)}
        add_visual(body, kind, self.color, GROUND_GROUP, size=size, **place)


@dataclasses.dataclass(frozen=True)
class Rod:
    """A cylinder, such as a goal post."""

    start: tuple[float, float, float]
    """First end of its axis, m."""
    end: tuple[float, float, float]
    """Second end, m."""
    radius: float
    """Radius, m."""
    color: Color = WHITE
    """Colour."""

    def add(self, body: Any) -> None:
        """Adds the rod's geom to a body, usually the world."""
        add_rod(body, self.color, self.radius, self.start, self.end)


@dataclasses.dataclass(frozen=True)
class Tuft:
    """An ellipsoid on the ground, such as grass."""

    center: tuple[float, float, float]
    """Centre, m."""
    half: tuple[float, float, float]
    """Half extents, m."""
    color: Color
    """Colour."""

    def add(self, body: Any) -> None:
        """Adds the tuft's geom to a body, usually the world."""
        add_visual(body, Kind.mjGEOM_ELLIPSOID, self.color, GROUND_GROUP, size=self.half, pos=self.center)


@dataclasses.dataclass(frozen=True)
class Slab:
    """An upright box, such as the side of a stage."""

    center: tuple[float, float, float]
    """Centre, m."""
    size: tuple[float, float, float]
    """Extents, m."""
    color: Color
    """Colour."""

    def add(self, body: Any) -> None:
        """Adds the slab's geom to a body, usually the world."""
        add_box(body, self.color, [extent / 2 for extent in self.size], self.center)


Shape = Mark | Rod | Tuft | Slab


@dataclasses.dataclass(frozen=True)
class Ground:
    """What the ground of a scene, and whatever stands on it, looks like."""

    color: Color = MEADOW
    """Colour of the plane."""
    shapes: tuple[Shape, ...] = ()
    """What is painted on it or stands on it."""
    goals: tuple[tuple[float, float, float], ...] = ()
    """Points that a camera keeps in view, such as goal posts, m."""

    def add(self, world: Any) -> None:
        """Adds all of it to the world's body."""
        for shape in self.shapes:
            shape.add(world)
        for number, point in enumerate(self.goals):
            world.add_site(name=f"{GOAL_SITE}/{number}", pos=point, group=SITE_GROUP)


def rectangle(x: Point, y: Point, color: Color, level: int = 1, z: float = 0.0) -> Mark:
    """Returns a filled rectangle between two x and two y, m."""
    return Mark((sum(x) / 2, sum(y) / 2, z), (x[1] - x[0], y[1] - y[0]), color, level)


def line(start: Point, end: Point, color: Color = WHITE, width: float = 0.05, level: int = 3, z: float = 0.0) -> Mark:
    """Returns a straight line between two points (2,), m."""
    (x0, y0), (x1, y1) = start, end
    yaw = float(np.arctan2(y1 - y0, x1 - x0))
    return Mark(((x0 + x1) / 2, (y0 + y1) / 2, z), (float(np.hypot(x1 - x0, y1 - y0)), width), color, level, yaw)


def outline(x: Point, y: Point, color: Color = WHITE, width: float = 0.05, z: float = 0.0) -> tuple[Mark, ...]:
    """Returns the four edges of a rectangle."""
    corners = [(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])]
    return tuple(line(a, b, color, width, z=z) for a, b in zip(corners, corners[1:] + corners[:1], strict=True))


def circle(center: Point, radius: float, color: Color = WHITE, width: float = 0.05, z: float = 0.0) -> tuple[Mark, ...]:
    """Returns a circle as short lines."""
    angles = np.linspace(0, 2 * np.pi, 37)
    reach = (radius + width / 2) / np.cos(np.pi / 36) - width / 2  # the lines' outer edges meet
    points = [(float(center[0] + reach * np.cos(a)), float(center[1] + reach * np.sin(a))) for a in angles]
    return tuple(line(a, b, color, width, z=z) for a, b in itertools.pairwise(points))
