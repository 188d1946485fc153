"""What scenes look like: colours, and geoms without mass or contacts.

Only rendering models have these geoms. Lengths are in metres.
"""

import colorsys

from mqe_jax.physics.collision import MAX_ROBOTS

Color = tuple[float, float, float, float]  # red, green, blue, alpha in [0, 1]


# Robots by agent. In matches of one or two a side team 0 is blue and green, team 1 red and orange;
# see `team_colors`. The hues of the others, which bear numbers, are apart by the golden ratio.
UNNUMBERED = 4  # robots of a scene, at most, that differ by colour and bear no numbers
ROBOT_COLOR_NAMES = ("blue", "green", "red", "orange")
ROBOT_COLORS: tuple[Color, ...] = (
    (0.10, 0.47, 0.95, 1.0),
    (0.22, 0.72, 0.25, 1.0),
    (0.90, 0.20, 0.17, 1.0),
    (1.00, 0.58, 0.08, 1.0),
    *(
        (*colorsys.hsv_to_rgb(0.75 + 0.618034 * number, 0.75, 0.9), 1.0)
        for number in range(MAX_ROBOTS - UNNUMBERED)
    ),
)


def team_colors(size: int) -> tuple[int, ...]:
    """Returns the colours of two teams, as indices of `ROBOT_COLORS`.

    Each robot of a team of one or two has its own colour, larger teams have one colour each.
    """
    return {1: (0, 2), 2: (0, 1, 2, 3)}.get(size, (0,) * size + (2,) * size)


WHITE: Color = (0.96, 0.96, 0.94, 1.0)
INK: Color = (0.13, 0.15, 0.19, 1.0)
STEEL: Color = (0.55, 0.58, 0.62, 1.0)
NAVY: Color = (0.16, 0.22, 0.36, 1.0)
YELLOW: Color = (0.98, 0.76, 0.14, 1.0)
MEADOW: Color = (0.50, 0.62, 0.42, 1.0)
GRASS: Color = (0.47, 0.63, 0.36, 1.0)
CLAY: Color = (0.78, 0.52, 0.40, 1.0)
WOOD: Color = (0.80, 0.61, 0.40, 1.0)
DARK_WOOD: Color = (0.52, 0.36, 0.22, 1.0)
STONE: Color = (0.76, 0.75, 0.72, 1.0)
GLASS: Color = (0.72, 0.86, 0.95, 0.22)

VISUAL_GROUP = 2  # of visual geoms
GROUND_GROUP = 0  # of the floor and of what is painted on it
HIDDEN_GROUP = 3  # of collision shapes that are not shown
SITE_GROUP = 5  # of sites, which are not shown
GOAL_SITE = "goal"
"""First part of the names of sites that a camera keeps in view: gates, goals, finish lines."""


def mix(first: Color, second: Color, part: float) -> Color:
    """Returns the mean of two colours, `part` in [0, 1] of it the second."""
    r, g, b, a = ((1.0 - part) * x + part * y for x, y in zip(first, second, strict=True))
    return r, g, b, a
