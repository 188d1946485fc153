"""Collision bits: two geoms collide where the contype of one shares a bit with the other's conaffinity."""

GROUND_BIT, WALL_BIT, OBJECT_BIT = 1, 2, 4
MAX_ROBOTS = 16


def robot_bits(number: int) -> tuple[int, int]:
    """Returns (contype, conaffinity) of a robot's geoms, which collide with all but its own."""
    first = 2 * OBJECT_BIT
    own, robots = first << number, (first << MAX_ROBOTS) - first
    return own, GROUND_BIT | WALL_BIT | OBJECT_BIT | (robots & ~own)
