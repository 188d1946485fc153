"""Terrain: a track is a row of blocks along x, each as wide as the track.

A block is a small frozen dataclass with a length and a `layout` method. Walls whose positions
differ between environments are attached to an anchor, which is sampled at reset and is part of the
state (mocap bodies).

Frame: the environment's, x along the track from its start, y across it with 0 on the centre line, z
up; metres.
"""

import dataclasses
import math

from mqe_jax.core.errors import InputError
from mqe_jax.physics.appearance.shapes import Ground, Style
from mqe_jax.physics.walls import Anchor, Barrier, Layout, Wall

LANE = 0.75  # m, distance between robots that start side by side, at least
ROW = 1.0  # m, distance between those that start one behind the other


def rows_of(robots: int, width: float) -> tuple[int, float]:
    """Returns how many robots start side by side, and how far the last row is behind the first.

    In metres.
    """
    rows = math.ceil(robots / max(int(width / LANE), 1))
    return math.ceil(robots / rows), ROW * (rows - 1)


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
