"""Free cameras whose image contains some points; what an image contains; the legend of a clip."""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mqe_jax.envs import QuadrupedEnv
from mqe_jax.physics.appearance import GOAL_SITE, HIDDEN_GROUP
from mqe_jax.physics.robots.index import trunk_bodies
from mqe_jax.sensors.marks import Marks
from mqe_jax.viz.geometry import (
    body_boxes,
    moving_bodies,
    pose_boxes,
    pose_frames,
    robot_color,
    shown_bases,
)
from mqe_jax.viz.recording import Episode

_ROOM = 1.07  # factor of the distance at which the points would reach the image's edges


@dataclass(frozen=True)
class Camera:
    """A free camera, in MuJoCo's convention; angles in degrees."""

    lookat: tuple[float, float, float]
    """Point in the centre of the view, m."""
    distance: float
    """Distance from that point, m."""
    azimuth: float = 60.0
    """0 looks along +x, 90 along +y."""
    elevation: float = -46.0
    """-90 looks straight down."""

    @property
    def axes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Directions forward, right and up (3,)."""
        azimuth = np.radians(self.azimuth)
        elevation = np.radians(self.elevation)
        level = np.cos(elevation)
        forward = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
        right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
        return forward, right, np.cross(right, forward)

    @property
    def position(self) -> np.ndarray:
        """Position (3,), m."""
        return np.array(self.lookat) - self.distance * self.axes[0]


def fit(
    model: mujoco.MjModel,
    corners: np.ndarray,
    camera: Camera,
    aspect: float,
    distances: tuple[float, float],
) -> Camera:
    """Returns a camera of the same direction whose image contains and centres `corners` (P, 3)."""
    forward, right, up = camera.axes
    tangent = float(np.tan(np.radians(model.vis.global_.fovy) / 2))  # of half the field of view
    lookat = (corners.min(axis=0) + corners.max(axis=0)) / 2
    distance = 1.0
    for _ in range(25):  # adjust the distance, then centre the projection
        offset = corners - lookat
        # The image contains a corner if |offset right| <= depth tan aspect and |offset up| <= depth
        # tan.
        aside = np.maximum(np.abs(offset @ right) / aspect, np.abs(offset @ up))
        distance = (aside / tangent - offset @ forward).max()
        depth = distance + offset @ forward
        across = offset @ right / depth
        along = offset @ up / depth
        shift = (across.max() + across.min()) * right + (along.max() + along.min()) * up
        lookat = lookat + distance * shift / 4
    distance = float(np.clip(_ROOM * distance, *distances))
    return replace(camera, lookat=tuple(lookat.tolist()), distance=distance)


def smooth(views: Sequence[Camera], width: int) -> list[Camera]:
    """Returns cameras smoothed by a triangular window of `2 width + 1` frames."""
    values = np.array([[*camera.lookat, camera.distance] for camera in views])
    padded = np.pad(values, ((width, width), (0, 0)), mode="edge")
    rising = np.arange(1, 2 * width + 2)
    weights = np.minimum(rising, rising[::-1]) / (width + 1) ** 2
    means = np.stack([np.convolve(column, weights, mode="valid") for column in padded.T], axis=1)
    rows = zip(views, means.tolist(), strict=True)
    return [
        replace(camera, lookat=(x, y, z), distance=distance) for camera, (x, y, z, distance) in rows
    ]


_INK = (28, 32, 40)
_PAPER = (246, 246, 242)


def entries(env: QuadrupedEnv) -> list[tuple[str, list[tuple[int, ...]]]]:
    """Returns the labels of the legend, and the colours of their robots, each once.

    Colours are 0 to 255. Teams are as in `env.teams`; other robots follow.
    """
    model = env.mj_model
    colors = [_rgb(robot_color(model, body)) for body in trunk_bodies(model)]
    names = ("team",) if len(env.teams) == 1 else ("team 0", "team 1")
    rows = [
        (name, list(dict.fromkeys(colors[agent] for agent in team)))
        for name, team in zip(names, env.teams, strict=True)
    ]
    scripted = colors[sum(map(len, env.teams)) :]
    if scripted:
        rows.append(("scripted", scripted))
    return rows


def _rgb(color: Sequence[float]) -> tuple[int, ...]:
    """Returns a colour's red, green and blue, 0 to 255."""
    return tuple(round(255 * part) for part in color[:3])


def legend(
    env: QuadrupedEnv, size: tuple[int, int], marks: Sequence[Marks] = ()
) -> Callable[[np.ndarray], np.ndarray]:
    """Returns a function that draws the legend into a frame (H, W, 3) uint8, at the lower left.

    It names teams and `marks`; a single robot without marks has none.
    """
    labels = entries(env) + [(mark.label, [_rgb(mark.color)]) for mark in marks]
    if sum(len(dots) for _, dots in labels) < 2:
        return lambda frame: frame
    unit = max(size[1] / 360, 0.6)
    font = ImageFont.load_default(13 * unit)
    width = sum(font.getlength(label) + unit * (14 * len(dots) + 16) for label, dots in labels)
    plate = Image.new("RGB", (round(width + 4 * unit), round(22 * unit)), _PAPER)
    draw = ImageDraw.Draw(plate)
    x = 8 * unit
    middle = 11 * unit
    for label, dots in labels:
        for color in dots:
            draw.ellipse((x, middle - 5 * unit, x + 10 * unit, middle + 5 * unit), fill=color)
            x += 14 * unit
        draw.text((x, middle), label, fill=_INK, font=font, anchor="lm")
        x += font.getlength(label) + 16 * unit
    picture = np.asarray(plate)
    gap = round(8 * unit)

    def draw_legend(frame: np.ndarray) -> np.ndarray:
        height = min(picture.shape[0], frame.shape[0] - gap)
        width = min(picture.shape[1], frame.shape[1] - gap)
        frame = frame.copy()
        frame[-gap - height : len(frame) - gap, gap : gap + width] = picture[:height, :width]
        return frame

    return draw_legend


_SPAN = 0.18  # distance from a trunk's centre of the points to look for in front and behind, m
_NEAR_GOAL = 3.0  # distance from the goal that the objects reach within which sites belong to it, m
_CLEAR = 0.5  # opacity below which a geom hides nothing


def targets(model: mujoco.MjModel, episode: Episode) -> list[int]:
    """Returns the ids of the bodies that a clip shows: robots, then moving objects and NPCs."""
    return [*shown_bases(model), *moving_bodies(model, episode)]


def goal_points(model: mujoco.MjModel, episode: Episode) -> np.ndarray:
    """Returns the goals' points (P, 3), m.

    Of several goals, it returns those of the one next to the objects at the end.
    """
    data = next(pose_frames(model, episode, [len(episode) - 1]))
    names = [model.site(site).name for site in range(model.nsite)]
    sites = [site for site, name in enumerate(names) if name.startswith(f"{GOAL_SITE}/")]
    points = data.site_xpos[sites].reshape(-1, 3)
    objects = moving_bodies(model, episode)
    if not len(points) or not objects:
        return points
    place = data.xpos[objects].mean(axis=0)
    closest = points[np.linalg.norm(points - place, axis=1).argmin()]
    return points[np.linalg.norm(points - closest, axis=1) < _NEAR_GOAL]


def hidden(model: mujoco.MjModel, episode: Episode, views: Sequence[Camera]) -> np.ndarray:
    """Returns the part of each target that is hidden from each frame's camera (T, targets).

    Walls and objects hide. Robots hide nothing. Three points are looked for: along a robot's trunk,
    and one above the other in an object.
    """
    model = copy.deepcopy(model)
    model.geom_group[model.geom_rgba[:, 3] < _CLEAR] = HIDDEN_GROUP
    bodies = targets(model, episode)
    trunks = len(shown_bases(model))
    local = body_boxes(model, bodies)
    groups = np.array([group != HIDDEN_GROUP for group in range(mujoco.mjNGROUP)], np.uint8)
    rows = []
    for camera, data in zip(views, pose_frames(model, episode, range(len(views))), strict=True):
        boxes = pose_boxes(data, bodies, local)
        span = 0.35 * np.ptp(boxes, axis=1) * (0, 0, 1)
        span[:trunks] = _SPAN * data.xmat[bodies[:trunks]].reshape(-1, 3, 3)[:, :, 0]
        points = boxes.mean(axis=1) + np.array([-1, 0, 1])[:, None, None] * span  # (3, targets, 3)
        struck = _struck(model, data, camera.position, points.reshape(-1, 3), groups).reshape(3, -1)
        owner = model.body_rootid[model.geom_bodyid[struck]]
        seen = (struck < 0) | (owner == model.body_rootid[bodies]) | np.isin(owner, bodies[:trunks])
        rows.append(1.0 - seen.mean(axis=0))
    return np.array(rows)


def _struck(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    eye: np.ndarray,
    points: np.ndarray,
    groups: np.ndarray,
) -> np.ndarray:
    """Returns the first geom on each way from `eye` (3,) to `points` (P, 3); -1 without a hit."""
    ways = points - eye
    lengths = np.linalg.norm(ways, axis=1)
    geoms = np.full(len(points), -1, np.int32)
    distances = np.zeros(len(points))
    units = (ways / lengths[:, None]).ravel()
    mujoco.mj_multiRay(
        model, data, eye, units, groups, 1, -1, geoms, distances, None, len(points), mujoco.mjMAXVAL
    )
    return np.where(distances < lengths, geoms, -1)
