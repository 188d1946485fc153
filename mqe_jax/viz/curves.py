"""Drawings by matplotlib: curves of a training, and a top view for machines without GL."""

import io
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from mqe_jax.core.files import replacing
from mqe_jax.core.literal import to_label
from mqe_jax.sensors.marks import Marks
from mqe_jax.viz.geometry import (
    box_corners,
    extent,
    pose_frames,
    robot_color,
    scenery_geoms,
    shown_bases,
)
from mqe_jax.viz.recording import Episode

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_REWARDS = ("average_step_reward", "episode_return")
_INK = "#23252b"
_RUN = "#2f7fd6"
_SECOND = "#3fae49"


def smooth(
    values: ArrayLike, fraction: float = 0.02, weights: ArrayLike | None = None
) -> list[float]:
    """Returns the running mean over a window of `fraction` of the rows, of finite values only.

    `weights` are those of the rows, by default equal.
    """
    values = np.asarray(values, np.float64)
    weight = np.ones(len(values)) if weights is None else np.asarray(weights, np.float64)
    finite = np.isfinite(values)
    values = np.where(finite, values, 0.0)
    weight = np.where(finite, weight, 0.0)
    width = max(1, round(len(values) * fraction))
    windows = [slice(max(0, end - width), end) for end in range(1, len(values) + 1)]
    totals = [weight[window].sum() for window in windows]
    sums = [(values[window] * weight[window]).sum() for window in windows]
    return [float(x / total) if total else math.nan for x, total in zip(sums, totals, strict=True)]


def plot_curves(
    tables: Sequence[Mapping[str, np.ndarray]],
    title: str,
    evaluations: Sequence[Mapping[str, Any]] = (),
) -> "Figure":
    """Returns a figure of average step reward (else return) and success over environment steps.

    `tables` are columns of metrics.csv by name, of each seed, and `evaluations` those of all seeds.
    Success with assistance is dotted; evaluations, which have none, are points.
    """
    from matplotlib.figure import Figure

    class Plot(Figure):
        def _repr_png_(self) -> bytes:  # in a notebook, whatever its backend
            file = io.BytesIO()
            self.savefig(file, format="png", dpi=80)
            return file.getvalue()

    figure = Plot((7.2, 4.2), dpi=150, layout="constrained")
    axes = figure.add_subplot()
    axes.set_title(to_label(title), color=_INK, loc="left")
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    tables = [table for table in tables if len(table.get("env_steps", ()))]
    if not tables:
        return figure
    name = next((name for name in _REWARDS if name in tables[0]), "updates")
    for table in tables:
        steps = table["env_steps"] / 1e6
        reward = table[name]
        axes.plot(steps, reward, color=_RUN, lw=0.6, alpha=0.3)
        axes.plot(steps, smooth(reward), color=_RUN, lw=1.8)
    last = max(table["env_steps"][-1] for table in tables) / 1e6
    axes.set(xlabel="environment steps (millions)", xlim=(0, last))
    axes.set_ylabel(name.replace("_", " "), color=_RUN)
    if any(np.isfinite(table.get("success", math.nan)).any() for table in tables):
        right = axes.twinx()
        notes = []
        if any(_plot_success(right, table) for table in tables):
            notes.append("dotted: with assistance")
        if evaluations:
            notes.append("points: evaluated")
        for each in evaluations:
            rate = each["sampled"].get("success_rate")
            height = math.nan if rate is None else 100 * rate
            right.plot(each["env_steps"] / 1e6, height, "o", color=_SECOND, ms=4)
        right.set(ylim=(0, 101))  # a line at 100% is beside the frame
        right.set_ylabel("\n".join(["success rate in training (%)", *notes]), color=_SECOND)
        right.spines[["top", "left"]].set_visible(False)
    return figure


def _plot_success(axes: Any, table: Mapping[str, np.ndarray]) -> bool:
    """Draws a seed's success in training, dotted with assistance; returns whether there is any.

    An update counts as much as episodes ended in it.
    """
    steps = table["env_steps"] / 1e6
    rate = 100 * np.asarray(smooth(table["success"], weights=table.get("episodes")))
    assisted = np.asarray(table.get("assistance", np.zeros(len(steps)))) > 0
    for shown, style in ((assisted, ":"), (~assisted, "-")):
        axes.plot(steps, np.where(shown, rate, math.nan), style, color=_SECOND, lw=1.4, alpha=0.9)
    return bool(assisted.any())


def save_figure(figure: "Figure", path: Path) -> None:
    """Writes a figure atomically, in a folder that it creates."""
    with replacing(path) as temporary:
        figure.savefig(temporary)


def draw_top(
    model: mujoco.MjModel,
    episode: Episode,
    size: tuple[int, int],
    shown: slice = slice(None),
) -> Iterator[np.ndarray]:
    """Yields top-view frames (H, W, 3) uint8 of an episode, or the `shown` ones.

    They show walls, objects, robots, and what the first robot senses.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Polygon
    from scipy.spatial import ConvexHull

    low, high = extent(model, episode)
    dpi = 100
    figure = Figure((size[0] / dpi, size[1] / dpi), dpi=dpi, facecolor="#eceef2")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.01, 0.01, 0.98, 0.98))
    axes.set(xlim=(low[0] - 0.3, high[0] + 0.3), ylim=(low[1] - 0.3, high[1] + 0.3), aspect="equal")
    axes.axis("off")
    scenery = []
    robots = []
    for geom in scenery_geoms(model):
        moves = model.body_dofnum[model.body_rootid[model.geom_bodyid[geom]]] > 0
        face = "#c9ced6" if moves else "#3a3d45"
        patch = Polygon(np.zeros((3, 2)), facecolor=face, edgecolor=_INK, lw=0.6, zorder=2)
        scenery.append((geom, axes.add_patch(patch)))
    body_shape = np.array([[-0.25, -0.13], [0.2, -0.13], [0.33, 0.0], [0.2, 0.13], [-0.25, 0.13]])
    for body in shown_bases(model):
        colour = robot_color(model, body)
        patch = Polygon(body_shape, facecolor=colour, edgecolor="#1b1d22", lw=1, zorder=4)
        robots.append((body, axes.add_patch(patch)))
    frames = range(len(episode))[shown]
    for index, data in zip(frames, pose_frames(model, episode, frames), strict=True):
        marks = []
        for mark in episode.marks:
            marks += _sensed(axes, mark, index)
        for geom, patch in scenery:
            points = box_corners(model, data, geom)[:, :2]
            patch.set_xy(points[ConvexHull(points).vertices])
        for body, patch in robots:
            rotation = data.xmat[body].reshape(3, 3)
            yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
            turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
            patch.set_xy(body_shape @ turn + data.xpos[body][:2])
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()
        for artist in marks:
            artist.remove()


def _sensed(axes: Any, mark: Marks, index: int) -> list[Any]:
    """Draws the first agent's marks in a frame."""
    from matplotlib.collections import LineCollection

    segments = [*np.asarray(mark.lines[index][0, ..., :2])]
    colors = [(*mark.color, alpha) for alpha in mark.line_opacity[index][0]]
    lines = LineCollection(segments, colors=colors, lw=2 if mark.bold else 0.8, zorder=3)
    x, y, _ = mark.points[index][0].T
    colors = [(*mark.color, alpha) for alpha in mark.point_opacity[index][0]]
    points = axes.scatter(x, y, s=6, c=colors, zorder=3)
    x, y, _ = mark.area[index][0].T
    area = axes.fill(x, y, color=mark.color, alpha=0.3, lw=0, zorder=1)
    return [axes.add_collection(lines), points, *area]
