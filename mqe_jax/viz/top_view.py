"""Top view by matplotlib, for machines without a GL library."""

from collections.abc import Iterator

import mujoco
import numpy as np

from mqe_jax.viz.geometry import box_corners, extent, pose, robot_bases, robot_color, scenery_geoms
from mqe_jax.viz.recording import Episode


def draw_top(model: mujoco.MjModel, episode: Episode, size: tuple[int, int]) -> Iterator[np.ndarray]:
    """Yields top-view frames (H, W, 3) uint8 of an episode: walls, objects, robots with their trajectories."""
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
    data = mujoco.MjData(model)
    bases = robot_bases(model)
    scenery, robots = [], []
    for geom in scenery_geoms(model):
        moves = model.body_dofnum[model.body_rootid[model.geom_bodyid[geom]]] > 0
        face = "#c9ced6" if moves else "#3a3d45"
        patch = Polygon(np.zeros((3, 2)), facecolor=face, edgecolor="#23252b", lw=0.6, zorder=2)
        scenery.append((geom, axes.add_patch(patch)))
    body_shape = np.array([[-0.25, -0.13], [0.2, -0.13], [0.33, 0.0], [0.2, 0.13], [-0.25, 0.13]])
    for body in bases:
        colour = robot_color(model, body)
        (trail,) = axes.plot([], [], color=colour, lw=1.5, alpha=0.5, zorder=3)
        patch = axes.add_patch(Polygon(body_shape, facecolor=colour, edgecolor="#1b1d22", lw=1, zorder=4))
        robots.append((body, patch, trail, []))
    label = axes.text(0.99, 0.01, "", ha="right", va="bottom", transform=axes.transAxes, fontsize=9)
    for index in range(len(episode)):
        pose(model, data, episode, index)
        for geom, patch in scenery:
            points = box_corners(model, data, geom)[:, :2]
            patch.set_xy(points[ConvexHull(points).vertices])
        for body, patch, trail, way in robots:
            rotation = data.xmat[body].reshape(3, 3)
            yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
            turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
            patch.set_xy(body_shape @ turn + data.xpos[body][:2])
            way.append(data.xpos[body][:2].copy())
            trail.set_data(*np.array(way).T)
        label.set_text(f"{index * episode.dt:.1f} s")
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()
