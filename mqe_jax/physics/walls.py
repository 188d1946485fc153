"""Walls and ground of a scene, as a terrain lays them out."""

import dataclasses
from typing import Any, Protocol

import mujoco
import numpy as np

from mqe_jax.physics.appearance import GOAL_SITE, GROUND_GROUP, HIDDEN_GROUP, SITE_GROUP
from mqe_jax.physics.appearance.shapes import (
    WALL_COLOR,
    WALL_GROUP,
    Ground,
    Style,
    gate_wall,
    side_wall,
)
from mqe_jax.physics.collision import GROUND_BIT, WALL_BIT

_THICKNESS = 0.04  # of the side walls, m


@dataclasses.dataclass(frozen=True)
class Wall:
    """A box-shaped wall."""

    name: str
    center: tuple[float, float, float]
    """Centre (3,), m; relative to the anchor (z: to the ground) if `anchor` is not None."""
    size: tuple[float, float, float]
    """Full extents (3,), m."""
    anchor: int | None = None
    """Index of the anchor to which it is attached, or None for a fixed wall."""


@dataclasses.dataclass(frozen=True)
class Barrier:
    """An infinite vertical plane that blocks motion against `normal`; rendered as a box."""

    name: str
    point: tuple[float, float]
    """A point on the plane (2,), m."""
    normal: tuple[float, float]
    """Unit normal (2,)."""
    length: float
    """Rendered length, m."""


@dataclasses.dataclass(frozen=True)
class Anchor:
    """A reference point for moving walls, sampled at every reset."""

    name: str
    """The block's name and number, such as `gate1`."""
    position: tuple[float, float]
    """Mean position (2,), m."""
    spread: tuple[float, float]
    """Half-widths of the uniform range in x and y (2,), m."""
    kind: str = "gate"
    """What sensors take the gap at this point for."""


@dataclasses.dataclass(frozen=True)
class Layout:
    """Contribution of one block to the track; positions in the environment frame, m.

    Example:
        ```python
        from mqe_jax.terrain import Gate, Track

        layout = Track((Gate(3.0),)).layout()
        print([wall.name for wall in layout.walls])  # ['gate0_right', 'gate0_left']
        ```
    """

    walls: tuple[Wall, ...] = ()
    """Fixed and moving walls; `anchor` is an index into this layout's anchors."""
    barriers: tuple[Barrier, ...] = ()
    anchors: tuple[Anchor, ...] = ()
    spawn: tuple[tuple[float, float, float], ...] = ()
    """Spawn poses (x, y, yaw) of the robots, m and rad."""

    def room(self, places: Any) -> float:
        """Returns how far inside of all barriers places x, y, ... (P, ...) are, m."""
        inside = np.array([place[:2] for place in places], float).reshape(-1, 2)
        away = [(inside - barrier.point) @ barrier.normal for barrier in self.barriers]
        return float(np.min(away, initial=np.inf))


class Terrain(Protocol):
    """What a scene needs of its terrain, such as `mqe_jax.terrain.Track`."""

    @property
    def start(self) -> float:
        """X at which it begins, m."""
        ...

    @property
    def length(self) -> float:
        """Extent along x, m."""
        ...

    @property
    def width(self) -> float:
        """Extent along y, m."""
        ...

    @property
    def wall_height(self) -> float:
        """Height of every wall, m."""
        ...

    @property
    def style(self) -> Style:
        """Look of the walls."""
        ...

    @property
    def ground(self) -> Ground:
        """Look of the ground."""
        ...

    def layout(self) -> Layout:
        """Returns walls, anchors and spawn poses."""
        ...


def build_terrain(spec: mujoco.MjSpec, terrain: Terrain, *, visual: bool = True) -> Layout:
    """Adds ground and walls to a scene and returns their layout.

    Walls that move are mocap bodies `wall/<name>`.
    """
    layout = terrain.layout()
    world = spec.worldbody
    solid = {"contype": WALL_BIT, "conaffinity": 0}
    ground = {
        "contype": GROUND_BIT,
        "conaffinity": 0,
        "condim": 3,
        "rgba": terrain.ground.color,
        "group": GROUND_GROUP,
    }
    world.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0, 0, 1), **ground)
    if visual:
        terrain.ground.add(world)
    for barrier in layout.barriers:
        normal = np.array([*barrier.normal, 0.0])
        world.add_geom(
            name=f"barrier/{barrier.name}",
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=(0, 0, 1),
            pos=(*barrier.point, 0.0),
            zaxis=normal,
            group=HIDDEN_GROUP,
            **solid,
        )
        if visual:
            half = (_THICKNESS / 2, barrier.length / 2 + _THICKNESS, terrain.wall_height / 2)
            center = np.array([*barrier.point, terrain.wall_height / 2]) - normal * half[0]
            yaw = np.arctan2(normal[1], normal[0])
            side_wall(world, terrain.style, center, half, float(yaw))
    for wall in layout.walls:
        half = np.array(wall.size) / 2
        if wall.anchor is None:
            body = world
            position = wall.center
        else:
            anchor = layout.anchors[wall.anchor]
            start = np.add(wall.center, [*anchor.position, 0.0])
            body = world.add_body(name=f"wall/{wall.name}", mocap=True, pos=start)
            position = (0, 0, 0)
        body.add_geom(
            name=f"wall/{wall.name}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=half,
            pos=position,
            rgba=WALL_COLOR,
            group=HIDDEN_GROUP if visual and terrain.style == "fence" else WALL_GROUP,
            **solid,
        )
        if visual and wall.anchor is not None:
            inner = -np.sign(wall.center[1])
            gate_wall(body, terrain.style, half, inner)
            for name, z in (("bottom", -half[2]), ("top", half[2])):
                place = (0, inner * half[1], z)
                body.add_site(name=f"{GOAL_SITE}/{wall.name}/{name}", pos=place, group=SITE_GROUP)
    return layout
