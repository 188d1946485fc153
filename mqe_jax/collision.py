"""Collision bits: two shapes collide where the contype of one has a bit of the other's conaffinity."""

from __future__ import annotations

GROUND_BIT, WALL_BIT, OBJECT_BIT = 1, 2, 4
MAX_ROBOTS = 16


def robot_bits(number: int) -> tuple[int, int]:
    """Returns (contype, conaffinity) of all shapes of robot `number`.

    Its contype is a bit of its own; its conaffinity has the bits of ground, walls, objects and every other robot. So
    all collision shapes of different robots collide; a robot never collides with itself.
    """
    first = 2 * OBJECT_BIT
    own, robots = first << number, (first << MAX_ROBOTS) - first
    return own, GROUND_BIT | WALL_BIT | OBJECT_BIT | (robots & ~own)
