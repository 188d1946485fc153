"""The grounds of the tasks: running track, meadow, hall, pitch, water; sky and light."""

import dataclasses
import itertools
from collections.abc import Sequence

import mujoco
import numpy as np

from mqe_jax.physics.appearance import (
    CLAY,
    GRASS,
    INK,
    ROBOT_COLORS,
    STONE,
    WHITE,
    WOOD,
    YELLOW,
    Color,
    mix,
)
from mqe_jax.physics.appearance.shapes import (
    Ground,
    Point,
    Shape,
    circle,
    line,
    mark,
    outline,
    rectangle,
    rod,
    slab,
    tuft,
)

GROUND_MATERIAL = "ground"
_HORIZON = (0.86, 0.91, 0.96)
_ZENITH = (0.36, 0.58, 0.85)
_HALL: Color = (0.42, 0.46, 0.52, 1.0)
COURT: Color = (0.83, 0.68, 0.48, 1.0)  # parquet
_POST = 0.035  # radius of goal posts, m


def pads(poses: Sequence[Sequence[float]], colors: Sequence[int]) -> tuple[Shape, ...]:
    """Returns a frame in each robot's colour about its place at the start; poses x, y, yaw."""
    size = (0.9, 0.6)
    marks = []
    for (x, y, yaw, *_), color in zip(poses, colors, strict=False):
        paint = mix(ROBOT_COLORS[color % len(ROBOT_COLORS)], WHITE, 0.25)
        marks += [
            mark((x, y, 0.0), size, WHITE, 3, yaw),
            mark((x, y, 0.0), (size[0] - 0.08, size[1] - 0.08), paint, 4, yaw),
        ]
    return tuple(marks)


def finish(x: float, y: Point, squares: int = 14, z: float = 0.0) -> tuple[Shape, ...]:
    """Returns a chequered line across the track at x, between two y, m."""
    side = (y[1] - y[0]) / squares
    shapes = [rectangle((x, x + 2 * side), y, WHITE, 3, z)]
    for row in range(2):
        along = (x + row * side, x + (row + 1) * side)
        for i in range(row, squares, 2):
            across = (y[0] + i * side, y[0] + (i + 1) * side)
            shapes.append(rectangle(along, across, INK, 4, z))
    return tuple(shapes)


def track(
    x: Point, width: float, lanes: int, shapes: Sequence[Shape] = (), color: Color = CLAY
) -> Ground:
    """Returns a running track between two x, m, with white lines between its lanes."""
    edges = np.linspace(-width / 2, width / 2, lanes + 1)[1:-1].tolist()
    lines = [line((x[0], y), (x[1], y), width=0.04, level=2) for y in edges]
    return Ground(shapes=(rectangle(x, (-width / 2, width / 2), color), *lines, *shapes))


def halves(x: Point, y: Point) -> Ground:
    """Returns a floor with a line between the halves of the first and of the second team."""
    blue = mix(ROBOT_COLORS[0], STONE, 0.74)
    red = mix(ROBOT_COLORS[2], STONE, 0.74)
    middle = line((x[0], 0.0), (x[1], 0.0))
    return Ground(_HALL, (rectangle(x, (y[0], 0.0), blue), rectangle(x, (0.0, y[1]), red), middle))


def warehouse(x: Point, width: float, goal_x: float) -> Ground:
    """Returns a concrete floor between two x, m, with yellow lines.

    The zone beyond the gate at `goal_x` is painted.
    """
    half = width / 2 - 0.25
    floor = rectangle(x, (-width / 2, width / 2), (0.70, 0.69, 0.66, 1.0))
    zone = rectangle((goal_x, x[1]), (-width / 2, width / 2), (0.55, 0.72, 0.58, 1.0), 2)
    start = outline((x[0] + 0.25, goal_x - 0.4), (-half, half), YELLOW, 0.07)
    return Ground(_HALL, (floor, zone, *start))


def meadow(x_range: Point, width: float, goal_x: float) -> Ground:
    """Returns grass between two x, m, with tufts and flowers.

    A pen is beyond the gate at `goal_x`.
    """
    begin, end = x_range
    random = np.random.default_rng(4)
    pen: Color = (0.72, 0.68, 0.42, 1.0)
    shapes: list[Shape] = [
        rectangle((begin, goal_x), (-width / 2, width / 2), GRASS),
        rectangle((goal_x, end), (-width / 2, width / 2), pen),
    ]
    tones = ((0.44, 0.60, 0.33, 1.0), (0.50, 0.66, 0.38, 1.0))
    patches: list[tuple[float, float, float]] = []
    for number in range(round(6 * (goal_x - begin))):
        radius = random.uniform(0.1, 0.35)
        x = random.uniform(begin + 0.4, goal_x - 0.5)
        y = random.uniform(-0.44, 0.44) * width
        apart = [np.hypot(x - a, y - b) > radius + other for a, b, other in patches]
        if all(apart):
            patches.append((x, y, radius))
            shapes.append(mark((x, y, 0.0), (radius,), tones[number % 2], 2))
    for number in range(round(3.0 * (end - begin))):
        x = random.uniform(begin + 0.2, end - 0.2)
        y = random.choice([-1, 1]) * random.uniform(0.52, 0.85) * width
        if number % 3 == 0:  # a flower
            color = ((0.98, 0.93, 0.55, 1.0), WHITE)[number % 2]
            shapes.append(tuft((x, y, 0.06), (0.045, 0.045, 0.04), color))
        else:
            shapes.append(tuft((x, y, 0.0), (0.16, 0.12, 0.10), tones[0]))
    return Ground(shapes=tuple(shapes))


def pitch(x: Point, width: float, goal: tuple[float, float, float]) -> Ground:
    """Returns a football pitch between two goal lines x, m.

    `goal` is the width, height and depth of both goals, m.
    """
    half = width / 2
    mouth, height, depth = goal
    middle = sum(x) / 2
    stripes = itertools.pairwise(np.linspace(x[0] - depth, x[1] + depth, 13).tolist())
    tones = ((0.33, 0.57, 0.29, 1.0), (0.38, 0.63, 0.33, 1.0))
    shapes: list[Shape] = [
        rectangle(stripe, (-half, half), tones[i % 2]) for i, stripe in enumerate(stripes)
    ]
    shapes += outline(x, (0.1 - half, half - 0.1), width=0.07)
    shapes += [
        line((middle, 0.1 - half), (middle, half - 0.1), width=0.07),
        mark((middle, 0.0, 0.0), (0.12,), level=3),
        *circle((middle, 0.0), 1.3, width=0.07),
    ]
    points = []
    for goal_x, away, color in ((x[0], -1, ROBOT_COLORS[0]), (x[1], 1, ROBOT_COLORS[2])):
        box = (goal_x - away * 1.7, goal_x)
        shapes += outline((min(box), max(box)), (-1.2 * mouth, 1.2 * mouth), width=0.07)
        shapes += _goal(goal_x, away * depth, mouth / 2, height, color)
        points += [(goal_x, side * mouth / 2, height) for side in (-1.0, 1.0)]
    return Ground((0.36, 0.52, 0.32, 1.0), tuple(shapes), tuple(points))


def _goal(x: float, depth: float, half: float, height: float, color: Color) -> list[Shape]:
    """Returns the frame and the net of a goal, whose back is at `x + depth`."""
    inner = half - _POST
    back = x + 0.96 * depth
    frame: list[Shape] = [
        rod((x, -inner, 0.0), (x, -inner, height), _POST, color),
        rod((x, inner, 0.0), (x, inner, height), _POST, color),
        rod((x, -inner, height), (x, inner, height), _POST, color),
    ]
    thread = 0.008
    net = (0.93, 0.93, 0.93, 1.0)
    for y in np.linspace(-inner, inner, 10).tolist():
        frame += [
            rod((back, y, 0.0), (back, y, height), thread, net),
            rod((x, y, height), (back, y, height), thread, net),
        ]
    for part in (0.25, 0.5, 0.75, 1.0):
        z = part * height
        along = x + part * (back - x)
        frame += [
            rod((back, -inner, z), (back, inner, z), thread, net),
            rod((along, -inner, height), (along, inner, height), thread, net),
        ]
    return frame


def climb(
    length: float, width: float, top: tuple[float, float, float], size: tuple[float, float, float]
) -> Ground:
    """Returns a running track with a finish line on a platform.

    `top` is the centre of the platform's top, `size` its extents, m.
    """
    x, y, z = top
    near = x - size[0] / 2
    far = x + size[0] / 2
    across = (y - size[1] / 2, y + size[1] / 2)
    base = rectangle((near, far), across, WHITE, 1, z)
    shapes = (base, *finish(near, across, 10, z))
    points = ((near, y, z), (far, y, z))
    return dataclasses.replace(track((0.0, length), width, 4, shapes), goals=points)


def dohyo(
    top: tuple[float, float, float], size: tuple[float, float, float], radius: float
) -> Ground:
    """Returns a sumo stage on a platform, with a ring of a radius, m.

    `top` is the centre of the platform's top, `size` its extents, m.
    """
    x, y, z = top
    length, width, _ = size
    sand = (0.90, 0.77, 0.55, 1.0)
    edge = (0.72, 0.55, 0.36, 1.0)
    shapes: list[Shape] = [
        rectangle((x - length / 2, x + length / 2), (y - width / 2, y + width / 2), edge, 1, z),
        mark((x, y, z), (radius,), sand, 2),
    ]
    sides = [(x - length / 2, y, 0.02, width + 0.04), (x + length / 2, y, 0.02, width + 0.04)]
    sides += [(x, y - width / 2, length + 0.04, 0.02), (x, y + width / 2, length + 0.04, 0.02)]
    shapes += [slab((a, b, z / 2), (along, across, z), edge) for a, b, along, across in sides]
    for side, color in ((-1, ROBOT_COLORS[0]), (1, ROBOT_COLORS[2])):
        start = y + side * 0.45
        end = y + side * (width / 2 - 0.2)
        shapes += [
            line((x - 0.4, start), (x + 0.4, start), width=0.07, z=z),
            line((x - 0.9, end), (x + 0.9, end), mix(color, WHITE, 0.15), 0.14, z=z),
        ]
    points = tuple(
        (x + a * radius, y + b * radius, z) for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1))
    )
    return Ground(_HALL, tuple(shapes), points)


def river(platforms: Point, ends: Point, widths: tuple[float, float, float], top: float) -> Ground:
    """Returns a river with a bridge of planks between two platforms of stone with the teams' flags.

    `platforms` are their centres' x, `ends` those of the bridge, `widths` the platforms' extents
    along x and y and the bridge's width, `top` their height, m.
    """
    random = np.random.default_rng(2)
    blue: Color = (0.36, 0.62, 0.74, 1.0)
    foam = mix(blue, WHITE, 0.35)
    shapes: list[Shape] = [rectangle((ends[0] - 1.0, ends[1] + 1.0), (-40.0, 40.0), blue)]
    for _ in range(70):
        x = random.uniform(ends[0] - 0.8, ends[1] + 0.8)
        y = random.uniform(-6.0, 6.0)
        wave = (random.uniform(0.04, 0.06), random.uniform(0.3, 0.8))
        shapes.append(mark((x, y, 0.0), wave, foam, 2))
    length, width, bridge = widths
    tones = (WOOD, mix(WOOD, WHITE, 0.18))
    for i, plank in enumerate(itertools.pairwise(np.linspace(*ends, 24).tolist())):
        shapes.append(rectangle(plank, (-bridge / 2, bridge / 2), tones[i % 2], 1, top))
    points = []
    y_range = (-width / 2, width / 2)
    for x, color in zip(platforms, (0, 2), strict=True):
        x_range = (x - length / 2, x + length / 2)
        shapes.append(rectangle(x_range, y_range, mix(ROBOT_COLORS[color], STONE, 0.55), 1, top))
        inner_x = (x_range[0] + 0.06, x_range[1] - 0.06)
        shapes += outline(inner_x, (y_range[0] + 0.06, y_range[1] - 0.06), z=top)
        points += [(x, y, top) for y in y_range]
    return Ground(shapes=tuple(shapes), goals=tuple(points))


def add_light(spec: mujoco.MjSpec, middle: tuple[float, float, float]) -> None:
    """Adds a light that casts shadows, a sky, and the material of the ground.

    Renderers give this material to the ground's geoms.
    """
    spec.worldbody.add_light(
        pos=middle,
        dir=(0.2, 0.3, -1),
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        castshadow=True,
        diffuse=(0.6, 0.6, 0.6),
    )
    visual = spec.visual
    visual.headlight.ambient = (0.45, 0.45, 0.45)
    visual.headlight.diffuse = (0.35, 0.35, 0.35)
    visual.quality.shadowsize = 4096
    visual.global_.offwidth = 1920
    visual.global_.offheight = 1080
    visual.rgba.haze = (*_HORIZON, 1.0)
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=_ZENITH,
        rgb2=_HORIZON,
        width=128,
        height=768,
    )
    spec.add_texture(
        name=GROUND_MATERIAL,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        mark=mujoco.mjtMark.mjMARK_RANDOM,
        random=0.2,
        rgb1=(1.0, 1.0, 1.0),
        rgb2=(1.0, 1.0, 1.0),
        markrgb=(0.93, 0.93, 0.93),
        width=256,
        height=256,
    )
    material = spec.add_material(
        name=GROUND_MATERIAL, texuniform=True, texrepeat=(1.0, 1.0), specular=0.0
    )
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = GROUND_MATERIAL
