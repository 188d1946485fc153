"""What scenes look like: colours, and geoms without mass or contacts.

Only rendering models have these geoms. Lengths are in metres.
"""

import colorsys
import itertools

import numpy as np

from mqe_jax.physics.collision import MAX_ROBOTS

Color = tuple[float, float, float, float]  # red, green, blue, alpha in [0, 1]


def _perceived(colors: np.ndarray) -> np.ndarray:
    """Returns sRGB colours (N, 3) in Oklab (N, 3), whose distances are about those that people see.

    Lightness counts half, for it changes with the light on a robot. Source:
    bottosson.github.io/posts/oklab.
    """
    linear = np.where(colors > 0.04045, ((colors + 0.055) / 1.055) ** 2.4, colors / 12.92)
    to_cones = np.array(
        [[0.4122, 0.5363, 0.0514], [0.2119, 0.6807, 0.1074], [0.0883, 0.2817, 0.6300]]
    )
    to_lab = np.array(
        [[0.2105, 0.7936, -0.0041], [1.9780, -2.4286, 0.4506], [0.0259, 0.7828, -0.8087]]
    )
    return np.cbrt(linear @ to_cones.T) @ to_lab.T * (0.5, 1.0, 1.0)


def _palette(first: tuple[Color, ...], count: int) -> tuple[Color, ...]:
    """Returns `count` colours: the first ones, then vivid ones.

    Each further one is the vivid colour that differs most from all before it.
    """
    levels = itertools.product(np.arange(30) / 30, ((0.85, 0.95), (0.9, 0.6), (0.45, 1.0)))
    vivid = np.array([colorsys.hsv_to_rgb(hue, *level) for hue, level in levels])
    candidates = _perceived(vivid)
    colors = list(first)
    differences = candidates[:, None] - _perceived(np.array(first)[:, :3])
    apart = np.linalg.norm(differences, axis=-1).min(axis=1)
    while len(colors) < count:
        best = int(apart.argmax())
        red, green, blue = vivid[best].round(3).tolist()
        colors.append((red, green, blue, 1.0))
        apart = np.minimum(apart, np.linalg.norm(candidates - candidates[best], axis=-1))
    return tuple(colors)


# Robots by agent. In matches of one or two a side team 0 is blue and green, team 1 red and orange;
# see `team_colors`.
ROBOT_COLOR_NAMES = ("blue", "green", "red", "orange")
ROBOT_COLORS: tuple[Color, ...] = _palette(
    (
        (0.10, 0.47, 0.95, 1.0),
        (0.22, 0.72, 0.25, 1.0),
        (0.90, 0.20, 0.17, 1.0),
        (1.00, 0.58, 0.08, 1.0),
    ),
    MAX_ROBOTS,
)
UNNUMBERED = 4  # robots of a scene, at most, that differ by colour and bear no numbers


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
