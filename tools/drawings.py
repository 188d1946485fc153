"""Draws the pictures of docs/drawings from the code, the settings and results/.

`python tools/drawings.py [FOLDER [png]]` draws all of them. The same versions of the package and of
matplotlib write the same bytes.
"""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeAlias

import jax.numpy as jnp
import matplotlib
import numpy as np
from charts import (
    BLUE,
    FAINT,
    GREEN,
    GREY,
    INK,
    LINE,
    ORANGE,
    VIOLET,
    WIDTH,
    curves,
    demo,
    performance,
    sizes,
    students,
)
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch, Polygon, Rectangle

import mqe_jax
from mqe_jax.core.files import replacing
from mqe_jax.envs.match import Match
from mqe_jax.presets import resolve

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "drawings"

Size: TypeAlias = tuple[float, float]
Point: TypeAlias = Size | np.ndarray


def canvas(height: float) -> tuple[Figure, Axes]:
    """Returns an empty drawing whose coordinates are pixels, with the origin at the lower left."""
    figure = Figure((WIDTH / 100, height / 100))
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, WIDTH), ylim=(0, height))
    axes.set_axis_off()
    return figure, axes


def write(
    axes: Axes, at: Point, text: str, size: float = 11, color: str = INK, **look: object
) -> None:
    """Writes a text, by default centred on a point."""
    style = {"ha": "center", "va": "center", "linespacing": 1.35} | look
    axes.text(at[0], at[1], text, fontsize=size, color=color, **style)  # pyright: ignore[reportArgumentType]


def box(
    axes: Axes, corner: Size, size: Size, title: str, body: str, color: str, room: str = ""
) -> None:
    """Draws a box with a title, what it does, and the folder of its code."""
    x, y = corner
    width, height = size
    form = "round,pad=0,rounding_size=8"
    axes.add_patch(FancyBboxPatch(corner, width, height, form, fc=f"{color}18", ec=color, lw=1.6))
    left = (x + 12, y + height - 24)
    right = (x + width - 10, y + height - 24)
    write(axes, left, title, 14, color, ha="left", va="baseline", weight="bold")
    write(axes, (x + 12, y + height - 38), body, 10.5, ha="left", va="top")
    write(axes, right, room, 9.5, FAINT, ha="right", va="baseline", family="monospace")


def arrow(axes: Axes, start: Point, end: Point, color: str = INK, **look: object) -> None:
    """Draws an arrow."""
    style = {"arrowstyle": "-|>", "mutation_scale": 15, "lw": 1.8, "shrinkA": 0, "shrinkB": 0}
    style |= look
    axes.add_patch(FancyArrowPatch(start, end, color=color, **style))  # pyright: ignore[reportArgumentType]


def robot(
    axes: Axes, pose: tuple[float, float, float], color: str, scale: float, name: str = ""
) -> None:
    """Draws a robot from above, at x, y and yaw; `scale` is the length of its trunk."""
    x, y, yaw = pose
    outline = np.array([[-0.5, -0.25], [0.25, -0.25], [0.55, 0], [0.25, 0.25], [-0.5, 0.25]])
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    corners = scale * outline @ turn + (x, y)
    axes.add_patch(Polygon(corners, fc=color, ec="white", lw=1.2, zorder=4))
    if name:
        write(axes, (x, y), name, 9, "white", weight="bold", zorder=5)


def architecture() -> Figure:
    """The loop of an environment step through four of the six boxes, and what training adds."""
    figure, axes = canvas(560)
    left = 40
    right = 414
    size = (216, 112)
    top = 436
    middle = 256
    bottom = 76
    body = "PPO: improves the policy.\nKnows no task, no robot,\nno physics."
    box(axes, (left, top), size, "Learner", body, VIOLET, "train/")
    body = "Act for the other team:\nscripted, trained, or\nearlier versions."
    box(axes, (right, top), size, "Opponents", body, VIOLET, "selfplay/")
    body = "Maps each robot's\nobservation to its action,\nin [-1, 1]."
    box(axes, (left, middle), size, "Policy", body, BLUE, "train/")
    body = "Turns an action into a\nvelocity command, then\ninto joint targets."
    box(axes, (right, middle), size, "Skill", body, BLUE, "skills/")
    body = "Sets the scene, observes,\nrewards, ends episodes."
    box(axes, (left, bottom), size, "Task", body, GREEN, "envs/")
    body = "MuJoCo C, MJX or Warp:\nfour steps of 5 ms."
    box(axes, (right, bottom), size, "Engine", body, GREEN, "physics/")
    inner = left + size[0]
    mid = WIDTH / 2
    down = right + 70

    def flow(start: Point, end: Point, color: str, text: str, at: Point, side: str) -> None:
        loop = color != VIOLET
        arrow(axes, start, end, color, lw=2.6 if loop else 1.8)
        write(axes, at, text, 11, color, ha=side, weight="bold" if loop else "normal")

    level = middle + 56
    flow((inner, level), (right, level), BLUE, "actions", (mid + 12, middle + 70), "center")
    text = "joint targets"
    flow((down, middle), (down, bottom + 112), BLUE, text, (down + 10, 222), "left")
    level = bottom + 56
    text = "poses,\nvelocities,\ncontacts"
    flow((right, level), (inner, level), GREEN, text, (mid + 12, 164), "center")
    at = left + 150
    flow((at, bottom + 112), (at, middle), GREEN, "observations", (at - 10, 222), "right")
    at = left + 40
    text = "observations,\nactions"
    flow((at, middle + 112), (at, top), VIOLET, text, (at + 10, 402), "left")
    at = left + 190
    flow((at, top), (at, middle + 112), VIOLET, "weights", (at + 10, 402), "left")
    level = top + 56
    text = "copies of\nthe policy"
    flow((inner, level), (right, level), VIOLET, text, (mid + 12, top + 78), "center")
    text = "actions of the\nother team"
    flow((down, top), (down, middle + 112), VIOLET, text, (down + 10, 402), "left")
    heights = [bottom + 56, bottom + 56, top + 56]
    axes.plot([left, 16, 16], heights, color=VIOLET, lw=1.8, solid_joinstyle="round")
    arrow(axes, (16, top + 56), (left, top + 56), VIOLET)
    write(axes, (29, middle + 56), "rewards", 11, VIOLET, rotation=90)
    write(axes, (mid + 12, 228), "one round:\n20 ms", 11.5, INK, weight="bold")
    note = "A step is a pure function of one environment's state. jax.vmap runs thousands\n"
    note += "at once, and jax.jit compiles a whole update into one program."
    write(axes, (mid, 34), note, 10.5, FAINT)
    return figure


def observation() -> Figure:
    """What agent 0 of Narrow Gate observes: the scene with its frame, and the numbers by block."""
    env = mqe_jax.make("go1gate", impl="c")
    figure, axes = canvas(480)
    scale = 100
    origin = (24, 310)

    def at(x: float, y: float) -> Size:
        return (origin[0] + scale * x, origin[1] + scale * y)

    colors = {"one_hot": GREY, "base": BLUE, "teammate": ORANGE, "gate": GREEN}
    width = env.params.track_width
    corner = at(0, -width / 2)
    axes.add_patch(Rectangle(corner, 6 * scale - 8, width * scale, fc="#f4f5f7", ec=LINE, lw=1))
    gate = (3.5, 0.3)
    for wall in env.compiled.layout.walls:
        x, y, _ = np.add(wall.center, (*gate, 0))
        low = max(y - wall.size[1] / 2, -width / 2)
        high = min(y + wall.size[1] / 2, width / 2)
        corner = at(x - wall.size[0] / 2, low)
        size = (wall.size[0] * scale, (high - low) * scale)
        axes.add_patch(Rectangle(corner, *size, fc="#c9ced6"))
    own = (1.3, -0.65, 0.35)
    mate = (1.9, 0.75, -0.1)
    for pose, color, name in ((own, BLUE, "0"), (mate, ORANGE, "1")):
        robot(axes, (*at(*pose[:2]), pose[2]), color, 60, name)
    axes.plot(*at(*gate), "o", color=GREEN, ms=9)
    start = at(0, 0)
    for point, color in ((own, BLUE), (mate, ORANGE), (gate, GREEN)):
        axes.plot(*zip(start, at(*point[:2]), strict=True), color=color, ls=(0, (4, 3)), lw=1.4)
    for tip, name, beside in ((at(0.75, 0), "x", (12, 0)), (at(0, 0.75), "y", (0, 14))):
        arrow(axes, start, tip, INK, lw=2.2)
        write(axes, np.add(tip, beside), name, 12, weight="bold")
    write(axes, at(0.12, 0.84), "environment frame", 10, FAINT, ha="left")
    write(axes, at(1.3, -1.2), "agent 0, which observes", 11, BLUE, weight="bold")
    write(axes, at(1.9, 1.2), "agent 1, its teammate", 11, ORANGE, weight="bold")
    write(axes, at(3.7, 0.3), "centre of the gap", 11, GREEN, weight="bold", ha="left")
    names = {
        "one_hot": ["1", "0"],
        "base": ["x", "y", "z", "roll", "pitch", "yaw"],
        "teammate": ["x", "y", "z", "roll", "pitch", "yaw"],
        "gate": ["x", "y"],
    }
    blocks = env.observation_layout.blocks
    widths = {name: len(cells) for name, cells in names.items()}
    assert {block.name: block.width for block in blocks} == widths
    cell = 37
    x = 24
    for block in blocks:
        color = colors[block.name]
        middle = (x + cell * block.width / 2, 116)
        write(axes, middle, block.name, 11, color, family="monospace", weight="bold")
        for text in names[block.name]:
            axes.add_patch(Rectangle((x, 66), cell, 38, fc=f"{color}22", ec=color, lw=1.2))
            write(axes, (x + cell / 2, 82), text, 9.5, va="baseline")
            x += cell
    total = f"The observation of agent 0: {env.observation_size} numbers, in m and rad.\n"
    total += "Agent 1 has 0 1 in front, and itself before its teammate."
    write(axes, (WIDTH / 2, 32), total, 10.5, FAINT)
    return figure


def match_frames() -> Figure:
    """One moment of two matches as each team observes it: after a half turn, after a reflection."""
    figure, axes = canvas(590)
    football = ((4.6, 1.9, -0.5), (10.2, -0.6, 2.9))
    door = ((1.4, -0.55, 0.5), (0.95, 0.85, 0.1))
    title = "Football: team 1 sees the field after a half turn"
    write(axes, (WIDTH / 2, 572), title, 12, weight="bold")
    for team in (0, 1):
        _seen_by(axes, "go1football-1vs1", team, football, (16 + team * 316, 350), 22.0)
    title = "Revolving Door: team 1 sees the field reflected"
    write(axes, (WIDTH / 2, 280), title, 12, weight="bold")
    for team in (0, 1):
        _seen_by(axes, "go1revolvingdoor", team, door, (16 + team * 316, 76), 51.0)
    text = "Each team finds itself on the same side, so one policy can play both."
    write(axes, (WIDTH / 2, 26), text, 11, FAINT)
    return figure


def _seen_by(
    axes: Axes, task: str, team: int, poses: Sequence[Sequence[float]], corner: Size, scale: float
) -> None:
    """Draws a match for two from above in the frame of a team.

    `poses` are x, y, yaw in the frame of team 0.
    """
    env = mqe_jax.make(task, impl="c")
    assert isinstance(env, Match)
    length, width = np.ptp([x.point for x in env.compiled.layout.barriers], axis=0).tolist()

    def at(point: Point) -> Size:
        return (corner[0] + scale * point[0], corner[1] + scale * (point[1] + width / 2))

    def seen(x: float, y: float) -> np.ndarray:
        return np.asarray(env.view_points(jnp.array([x, y, 0.0])))[team, :2]

    axes.add_patch(Rectangle(corner, length * scale, width * scale, fc="#eef2ee", ec=LINE, lw=1))
    for wall in env.compiled.layout.walls:
        x, y = np.add(wall.center[:2], env.compiled.layout.anchors[wall.anchor or 0].position)
        middle = at(seen(x, y))
        size = np.array(wall.size[:2]) * scale
        axes.add_patch(Rectangle((middle - size / 2).tolist(), *size, fc="#c9ced6"))
    if "ball" in env.objects:
        axes.plot(*at(seen(6.6, 1.2)), "o", color="white", mec=INK, ms=8, zorder=5)
    if "door" in env.objects:
        tip = 0.97 * np.array([np.sin(0.5), np.cos(0.5)])
        tips = [at(seen(2.6 + sign * tip[0], sign * tip[1])) for sign in (-1, 1)]
        axes.plot(*zip(*tips, strict=True), color=INK, lw=4, solid_capstyle="round")
    info = jnp.array([(x, y, 0.3, 0.0, 0.0, yaw) for x, y, yaw in poses])
    for number, (x, y, _, _, _, yaw) in enumerate(np.asarray(env.views(info))[team]):
        robot(axes, (*at((x, y)), yaw), (BLUE, ORANGE)[number], 44)
        name = "self" if number == team else "opponent"
        write(axes, np.add(at((x, y)), (0, -26)), name, 10.5, (BLUE, ORANGE)[number], weight="bold")
    color = (BLUE, ORANGE)[team]
    start = np.add(corner, (10 if "ball" in env.objects else 210, 10))
    for along, name in ((np.array([34, 0]), "x"), (np.array([0, 34]), "y")):
        arrow(axes, start, start + along, mutation_scale=10)
        write(axes, start + 1.3 * along, name, 10, weight="bold")
    below = np.add(corner, (length * scale / 2, -15))
    write(axes, below, f"as team {team} observes it", 11, color, weight="bold")


def league() -> Figure:
    """Whom a policy meets in a league, equally often: itself, earlier versions, fixed opponents."""
    config = resolve("go1tug", "league")
    steps = config.league.snapshot_steps / 1e6
    quarter = 0.25 * config.league.snapshot_steps / 1e6
    own = {"newest": BLUE, "older": VIOLET, "uniform": VIOLET}
    names = sorted(config.opponents, key=lambda name: [*own].index(name) if name in own else -1)
    figure, axes = canvas(450)
    row = 34
    top = 392
    left = 226
    width = 150
    title = f"{config.num_envs} matches at once"
    write(axes, (left + width / 2, top + 22), title, 12, weight="bold")
    for number, name in enumerate(names):
        color = own.get(name, GREEN)
        y = top - row * (number + 1)
        axes.add_patch(Rectangle((left, y + 3), width, row - 6, fc=f"{color}22", ec=color, lw=1.2))
        write(axes, (left + width / 2, y + row / 2), f"against {name}", 10.5, color)
    box(axes, (16, 40), (150, 346), "Policy", "plays team 0\nand learns", BLUE)
    right = 424
    fixed = "scripted, idle, random,\nor a trained team\nfrom a file"
    pool = f"{config.league.members} earlier versions.\n"
    pool += "older: one that it beats\nless often than others\nuniform: any of them"
    count = sum(name not in own for name in names)
    ends = {
        GREEN: ("Fixed opponents", fixed, 252, 134, range(count)),
        BLUE: ("The policy itself", "as it is now", 184, 60, [count]),
        VIOLET: ("Pool", pool, 26, 150, range(count + 1, len(names))),
    }
    for color, (title, body, bottom, height, rows) in ends.items():
        box(axes, (right, bottom), (200, height), title, body, color)
        for number in rows:
            y = top - row * (number + 0.5)
            start = (right, min(y, bottom + height - 10))
            arrow(axes, start, (left + width, y), color, lw=1.3, mutation_scale=10)
    arrow(axes, (166, 270), (left, 270), BLUE)
    write(axes, (196, 284), "acts", 10.5, BLUE)
    arrow(axes, (left, 210), (166, 210), BLUE)
    write(axes, (196, 224), "learns", 10.5, BLUE)
    arrow(axes, (166, 56), (right, 56), VIOLET)
    note = f"a copy every {steps:g} M steps,\nor every {quarter:g} M while it wins\n"
    note += f"{100 * config.league.snapshot_win_rate:.0f}% against the pool"
    write(axes, (295, 90), note, 10, VIOLET)
    return figure


DRAWINGS: dict[str, Callable[[], Figure]] = {
    "architecture": architecture,
    "observation": observation,
    "match_frames": match_frames,
    "league": league,
    "curves": curves,
    "demo": demo,
    "students": students,
    "sizes": sizes,
    "performance": performance,
}


def main(folder: Path = FOLDER, form: str = "svg") -> None:
    """Writes all drawings into a folder, as svg or png files."""
    folder.mkdir(parents=True, exist_ok=True)
    metadata = {"Date": None} if form == "svg" else {}
    for name, draw in DRAWINGS.items():
        file = folder / f"{name}.{form}"
        with matplotlib.rc_context({"svg.hashsalt": name}), replacing(file) as temporary:
            draw().savefig(temporary, format=form, metadata=metadata)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER, *sys.argv[2:3])
