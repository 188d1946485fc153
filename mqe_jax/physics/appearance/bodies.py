"""Visual geoms of the objects, in the frame of their bodies."""

import itertools
from typing import Any

import numpy as np

from mqe_jax.physics.appearance import DARK_WOOD, GLASS, INK, STEEL, WHITE, WOOD, YELLOW, Color, mix
from mqe_jax.physics.appearance.shapes import Kind, add_box, add_rod, add_visual

_PROUD = 0.004  # distance by which details stand out from the collision shape, m
_DIGITS = "1011111 0000011 1110110 1110011 0101011 1111001 1111101 1000011 1111111 1111011".split()
"""Inked segments of a digit: three across from the top, two on the left, two on the right."""


def crate(body: Any, half: np.ndarray) -> None:
    """Adds the beams of a wooden crate about a box of half extents (3,), m."""
    thick = 0.09 * half.min()
    for axis in range(3):
        other, third = (i for i in range(3) if i != axis)
        size = np.full(3, thick)
        size[axis] = half[axis] + _PROUD
        for a, b in itertools.product((-1, 1), repeat=2):
            place = np.zeros(3)
            place[other] = a * (half[other] - thick + _PROUD)
            place[third] = b * (half[third] - thick + _PROUD)
            add_box(body, DARK_WOOD, size, place)
    for axis, sign in ((0, 1), (1, -1)):  # diagonal braces
        size = np.full(3, 0.8 * thick)
        size[axis] = half[axis] + _PROUD / 2
        size[1 - axis] = np.hypot(half[1], half[2]) - 2 * thick
        angle = np.arctan2(half[2], half[1 - axis]) / 2
        quat = np.array([np.cos(angle), 0.0, 0.0, 0.0])
        quat[1 + axis] = sign * np.sin(angle)
        add_box(body, mix(WOOD, DARK_WOOD, 0.55), size, (0, 0, 0), quat=quat)


def football(body: Any, radius: float) -> None:
    """Adds the twelve dark patches of a football."""
    golden = (1 + np.sqrt(5)) / 2
    for i, a, b in itertools.product(range(3), (-1.0, 1.0), (-golden, golden)):
        point = np.roll([0.0, a, b], i)
        place = 0.66 * radius * point / np.linalg.norm(point)
        add_visual(body, Kind.mjGEOM_SPHERE, INK, size=(0.38 * radius, 0, 0), pos=place)


def drum(body: Any, radius: float, height: float) -> None:
    """Adds an upright cylinder like a barrel: staves, two hoops and a lid."""
    half = height / 2
    add_visual(body, Kind.mjGEOM_CYLINDER, WOOD, size=(radius, half, 0), pos=(0, 0, half))
    hoop = (radius + 0.006, 0.035, 0)
    for z in (0.16 * height, 0.84 * height):
        add_visual(body, Kind.mjGEOM_CYLINDER, STEEL, size=hoop, pos=(0, 0, z))
    lid = mix(WOOD, WHITE, 0.35)
    add_visual(body, Kind.mjGEOM_CYLINDER, lid, size=(0.93 * radius, 0.003, 0), pos=(0, 0, height))


def door(body: Any, half: np.ndarray) -> None:
    """Adds a revolving door of half extents (3,), m: glass in a frame about a post."""
    x, y, z = half
    bar = 0.045
    add_rod(body, STEEL, 0.055, (0, 0, -z), (0, 0, z + 0.03))
    for side in (-1, 1):
        add_box(body, GLASS, (0.25 * x, y / 2 - bar, z - bar), (0, side * y / 2, 0))
        add_box(body, YELLOW, (x, bar, z), (0, side * (y - bar), 0))
        add_box(body, INK, (1.03 * x, bar, 0.12 * z), (0, side * (y - bar), 0.45 * z))
        for height in (-1, 1):
            place = (0, side * y / 2, height * (z - bar / 1.5))
            add_box(body, STEEL, (0.8 * x, y / 2, bar / 1.5), place)


def plank(body: Any, half: np.ndarray, center: float) -> None:
    """Adds the slats and the edges of a wooden plank of half extents (3,), m.

    Its centre is at x `center`, m.
    """
    x, y, z = half
    edges = np.linspace(-x, x, 15)
    for i, (a, b) in enumerate(itertools.pairwise(edges)):
        tone = (mix(WOOD, WHITE, 0.12), WOOD)[i % 2]
        add_box(body, tone, ((b - a) / 2, y, z + 0.002), (center + (a + b) / 2, 0, 0))
    for side in (-1, 1):
        add_box(body, DARK_WOOD, (x, 0.025, z + _PROUD), (center, side * (y - 0.025), 0))


def trestle(world: Any, hinge: tuple[float, float, float], half_width: float) -> None:
    """Adds the posts of a seesaw and its axle to the world; `hinge` is the axle's middle, m."""
    x, y, z = hinge
    end = half_width + 0.09
    add_rod(world, STEEL, 0.04, (x, y - end, z), (x, y + end, z))
    for side, lean in itertools.product((-1, 1), (-0.3, 0.3)):
        post = y + side * (end - 0.03)
        add_rod(world, DARK_WOOD, 0.035, (x + lean, post, 0), (x, post, z))


def column(world: Any, radius: float, top: tuple[float, float, float]) -> None:
    """Adds a column with a foot and a head to the world.

    It stands on the ground below the middle of its `top` (3,), m.
    """
    x, y, z = top
    add_rod(world, STEEL, radius, (x, y, 0), (x, y, z))
    add_rod(world, INK, 1.6 * radius, (x, y, 0), (x, y, 0.05))
    add_rod(world, INK, 1.4 * radius, (x, y, z - 0.06), (x, y, z - 0.001))


def sheep(body: Any, radius: float, height: float) -> None:
    """Adds an upright sheep: curls of wool, a dark face with ears, four legs."""
    wool: Color = (0.97, 0.95, 0.89, 1.0)
    face: Color = (0.22, 0.19, 0.18, 1.0)
    middle = 0.62 * height

    def curl(size: float, place: tuple[float, float, float]) -> None:
        add_visual(body, Kind.mjGEOM_SPHERE, wool, size=(size * radius, 0, 0), pos=place)

    trunk = (radius, 0.72 * radius, 0.30 * height)
    add_visual(body, Kind.mjGEOM_ELLIPSOID, wool, size=trunk, pos=(0, 0, middle))
    for x, count, wide in ((-0.75, 5, 0.52), (-0.25, 7, 0.72), (0.3, 7, 0.70), (0.75, 5, 0.50)):
        for angle in np.linspace(-0.35, np.pi + 0.35, count):
            y = wide * radius * np.cos(angle)
            z = middle + 0.25 * height * np.sin(angle)
            curl(0.31, (x * radius, y, z))
    head = np.array([0.40, 0.26, 0.30]) * radius
    place = (1.25 * radius, 0, 0.80 * height)
    add_visual(body, Kind.mjGEOM_ELLIPSOID, face, size=head, pos=place)
    curl(0.27, (1.08 * radius, 0, 0.92 * height))
    curl(0.2, (-1.2 * radius, 0, 0.7 * height))
    for side in (-1, 1):
        place = (1.08 * radius, side * 0.34 * radius, 0.84 * height)
        ear = np.array([0.1, 0.22, 0.08]) * radius
        add_visual(body, Kind.mjGEOM_ELLIPSOID, face, size=ear, pos=place)
        for x in (-0.5 * radius, 0.5 * radius):
            y = side * 0.35 * radius
            add_rod(body, face, 0.11 * radius, (x, y, 0.0), (x, y, 0.45 * height))


def back_number(trunk: Any, number: int, top: float) -> None:
    """Adds a robot's number to its trunk, on a white cloth `top` m above the trunk's origin.

    It reads from behind the robot.
    """
    digits = str(number)
    half = (0.09, 0.042)  # of a digit, along x and y
    thick = 0.014  # of a segment
    pitch = 2 * half[1] + 3 * thick
    add_box(trunk, WHITE, (0.13, 0.02 + pitch * len(digits) / 2, 0.003), (0, 0, top))
    middles = (half[0] / 2, -half[0] / 2)  # of the segments along x
    for place, digit in enumerate(digits):
        middle = ((len(digits) - 1) / 2 - place) * pitch
        across = [(x, 0.0, (thick, half[1] + thick)) for x in (half[0], 0.0, -half[0])]
        along = [(x, y, (middles[0] + thick, thick)) for y in (half[1], -half[1]) for x in middles]
        for inked, (x, y, (length, width)) in zip(_DIGITS[int(digit)], across + along, strict=True):
            if inked == "1":
                add_box(trunk, INK, (length, width, 0.003), (x, middle + y, top + 0.002))
