"""Collision bits: two shapes touch where the contype of one has a bit of the other's conaffinity."""

from __future__ import annotations

GROUND_BIT, WALL_BIT, OBJECT_BIT = 1, 2, 4
MAX_ROBOTS = 16


def robot_bit(number: int) -> int:
    """Returns the contype bit of robot `number`, which only other robots' shapes answer to: none touches itself."""
    return 8 << number
