"""Terrain: a track is a row of blocks along x, each as wide as the track.

A block is a small frozen dataclass with a length and a `layout` method. Walls whose positions
differ between environments are attached to an anchor, which is sampled at reset and is part of the
state (mocap bodies).

Frame: the environment's, x along the track from its start, y across it with 0 on the centre line, z
up; metres.
"""

import dataclasses
import math

import mujoco
import numpy as np

from mqe_jax.core.errors import InputError
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
LANE = 0.75  # m, distance between robots that start side by side, at least
ROW = 1.0  # m, distance between those that start one behind the other


def rows_of(robots: int, width: float) -> tuple[int, float]:
    """Returns how many robots start side by side, and how far the last row is behind the first.

    In metres.
    """
    rows = math.ceil(robots / max(int(width / LANE), 1))
    return math.ceil(robots / rows), ROW * (rows - 1)


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
    """Contribution of one block to the track; positions in the environment frame, m."""

    walls: tuple[Wall, ...] = ()
    """Fixed and moving walls; `anchor` is an index into this layout's anchors."""
    barriers: tuple[Barrier, ...] = ()
    anchors: tuple[Anchor, ...] = ()
    spawn: tuple[tuple[float, float, float], ...] = ()
    """Spawn poses (x, y, yaw) of the robots, m and rad."""


@dataclasses.dataclass(frozen=True)
class TerrainBlock:
    """Base of all blocks."""

    length: float = 1.0
    """Extent along x, m."""

    def layout(self, start: float, track: "Track", number: int) -> Layout:
        """Returns the walls and poses of the block that begins at x = `start`, m.

        `number` is its index in the track.
        """
        raise NotImplementedError(f"terrain block {type(self).__name__}: layout() is not defined")


@dataclasses.dataclass(frozen=True)
class SpawnArea(TerrainBlock):
    """Spawn poses side by side across the track, in rows, with a wall behind them."""

    length: float = 2.0
    spawn_x: float | None = None
    """X of the first row's spawn poses from the block's start, m; half its length if None."""
    spacing: float | None = None
    """Distance between neighbouring spawn poses, m; the track's width / robots in a row if None."""
    columns: int | None = None
    """Number of robots in a row; all of them if None. Further rows are behind the first one."""
    back_wall: bool = True
    """Whether there is a wall behind the robots."""

    def layout(self, start: float, track: "Track", number: int) -> Layout:
        x = start + (self.length / 2 if self.spawn_x is None else self.spawn_x)
        columns = self.columns or track.num_robots
        spacing = track.width / columns if self.spacing is None else self.spacing
        spawn = []
        for row, first in enumerate(range(0, track.num_robots, columns)):
            count = min(columns, track.num_robots - first)
            spawn += [(x - row * ROW, (i - (count - 1) / 2) * spacing, 0.0) for i in range(count)]
        barriers = ()
        if self.back_wall:
            barriers = (Barrier(f"back{number}", (start, 0.0), (1.0, 0.0), track.width),)
        return Layout(barriers=barriers, spawn=tuple(spawn))


@dataclasses.dataclass(frozen=True)
class Plane(TerrainBlock):
    """Ground without walls."""

    def layout(self, start: float, track: "Track", number: int) -> Layout:
        return Layout()


@dataclasses.dataclass(frozen=True)
class EndWall(TerrainBlock):
    """The wall at the end of the track."""

    length: float = 0.0

    def layout(self, start: float, track: "Track", number: int) -> Layout:
        return Layout(barriers=(Barrier(f"end{number}", (start, 0.0), (-1.0, 0.0), track.width),))


@dataclasses.dataclass(frozen=True)
class Gate(TerrainBlock):
    """A wall across the middle of the block with a gap."""

    length: float = 3.0
    width: float = 0.6
    """Width of the gap, m."""
    depth: float = 0.1
    """Thickness of the wall along x, m."""
    random: tuple[float, float] = (0.0, 0.0)
    """Half-widths of the range of the gap's centre, sampled at reset (x, y), m."""
    kind: str = "gate"
    """What sensors take the gap for."""

    def layout(self, start: float, track: "Track", number: int) -> Layout:
        gap = self.width
        height = track.wall_height
        if not 0 < gap < track.width:
            raise InputError(
                f"terrain block gate: width {gap} must be between 0 and the track's width "
                f"{track.width}"
            )
        center = (start + self.length / 2, 0.0)
        # Long enough to reach the side wall for every sampled gap position; the overhang is hidden
        # when rendering.
        reach = (track.width - gap) / 2 + self.random[1]
        aside = (gap + reach) / 2
        size = (self.depth, reach, height)
        right = Wall(f"gate{number}_right", (0.0, -aside, height / 2), size, anchor=0)
        left = Wall(f"gate{number}_left", (0.0, aside, height / 2), size, anchor=0)
        anchor = Anchor(f"gate{number}", center, self.random, self.kind)
        return Layout(walls=(right, left), anchors=(anchor,))


@dataclasses.dataclass(frozen=True)
class Track:
    """A row of blocks between two side walls.

    Example:
        ```python
        from mqe_jax.terrain import EndWall, Gate, SpawnArea, Track

        track = Track((SpawnArea(2.0), Gate(3.0, width=0.7), EndWall()), width=4.0)
        print(track.layout().anchors[0].position)  # (3.5, 0.0), the middle of the gap
        ```
    """

    blocks: tuple[TerrainBlock, ...] = ()
    """Blocks in order along x."""
    width: float = 3.0
    """Distance between the side walls, m."""
    start: float = 0.0
    """X at which the first block begins, m."""
    num_robots: int = 2
    """Number of spawn poses of a `SpawnArea`."""
    wall_height: float = 0.5
    """Height of every wall, m."""
    walled: bool = True
    """Whether there are side walls."""
    style: Style = "boards"
    """Look of the walls."""
    ground: Ground = dataclasses.field(default_factory=Ground)
    """Look of the ground."""

    def __post_init__(self) -> None:
        if self.width <= 0:
            raise InputError(f"Track.width: {self.width} must be positive")

    @property
    def length(self) -> float:
        """Sum of the blocks' lengths, m."""
        return sum(block.length for block in self.blocks)

    def layout(self) -> Layout:
        """Returns the layout of all blocks; anchors are numbered over the whole track."""
        walls = []
        barriers = []
        anchors = []
        spawn = []
        start = self.start
        for number, block in enumerate(self.blocks):
            part = block.layout(start, self, number)
            for wall in part.walls:
                anchor = None if wall.anchor is None else wall.anchor + len(anchors)
                walls.append(dataclasses.replace(wall, anchor=anchor))
            barriers += part.barriers
            anchors += part.anchors
            spawn += part.spawn
            start += block.length
        if self.walled:
            middle = (self.start + start) / 2
            half = self.width / 2
            barriers.append(Barrier("side_right", (middle, -half), (0.0, 1.0), start - self.start))
            barriers.append(Barrier("side_left", (middle, half), (0.0, -1.0), start - self.start))
        return Layout(tuple(walls), tuple(barriers), tuple(anchors), tuple(spawn))


def build_terrain(spec: mujoco.MjSpec, track: Track, *, visual: bool = True) -> Layout:
    """Adds a track's ground and walls to a scene and returns their layout.

    Walls that move are mocap bodies `wall/<name>`.
    """
    layout = track.layout()
    world = spec.worldbody
    solid = {"contype": WALL_BIT, "conaffinity": 0}
    ground = {
        "contype": GROUND_BIT,
        "conaffinity": 0,
        "condim": 3,
        "rgba": track.ground.color,
        "group": GROUND_GROUP,
    }
    world.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0, 0, 1), **ground)
    if visual:
        track.ground.add(world)
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
            half = (_THICKNESS / 2, barrier.length / 2 + _THICKNESS, track.wall_height / 2)
            center = np.array([*barrier.point, track.wall_height / 2]) - normal * half[0]
            yaw = np.arctan2(normal[1], normal[0])
            side_wall(world, track.style, center, half, float(yaw))
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
            group=HIDDEN_GROUP if visual and track.style == "fence" else WALL_GROUP,
            **solid,
        )
        if visual and wall.anchor is not None:
            inner = -np.sign(wall.center[1])
            gate_wall(body, track.style, half, inner)
            for name, z in (("bottom", -half[2]), ("top", half[2])):
                place = (0, inner * half[1], z)
                body.add_site(name=f"{GOAL_SITE}/{wall.name}/{name}", pos=place, group=SITE_GROUP)
    return layout
