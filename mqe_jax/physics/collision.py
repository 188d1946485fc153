"""Collision bits of geoms.

Two geoms collide if the contype of one shares a bit with the conaffinity of the other.
"""

from mqe_jax.core.limits import Robots, bounds

GROUND_BIT = 1
WALL_BIT = 2
OBJECT_BIT = 4
MAX_ROBOTS = int(bounds(Robots)[1])
_FIRST = 2 * OBJECT_BIT  # of the bits that number the robots
_ALL = (1 << MAX_ROBOTS.bit_length()) - 1


def robot_bits(number: int) -> tuple[int, int]:
    """Returns (contype, conaffinity) of a robot's geoms, which collide with all but its own.

    The contype is the robot's number in binary, the conaffinity its complement: of two different
    numbers one has a bit that the other lacks.
    """
    own = number + 1
    return _FIRST * own, GROUND_BIT | WALL_BIT | OBJECT_BIT | _FIRST * (_ALL & ~own)
