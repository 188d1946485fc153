"""What the image of a camera contains: robots, objects and goals inside its frame and not hidden behind others."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import mujoco
import numpy as np

from mqe_jax.appearance import GOAL_SITE, HIDDEN_GROUP
from mqe_jax.viz.framing import Camera
from mqe_jax.viz.geometry import body_boxes, moving_bodies, pose, posed, robot_bases
from mqe_jax.viz.recording import Episode

_SPAN = 0.18  # distance from a trunk's centre of the points that are looked for in front and behind, m
_NEAR_GOAL = 3.0  # distance from the goal that the objects reach within which sites belong to it, m
_CLEAR = 0.5  # opacity below which a geom hides nothing


def targets(model: mujoco.MjModel, episode: Episode) -> list[int]:
    """Returns the ids of the bodies that a clip shows: robots, then moving objects and NPCs."""
    return [*robot_bases(model), *moving_bodies(model, episode)]


def goal_points(model: mujoco.MjModel, episode: Episode) -> np.ndarray:
    """Returns the goals' points (P, 3), m; of several goals those of the one next to the objects at the end."""
    data = mujoco.MjData(model)
    pose(model, data, episode, len(episode) - 1)
    sites = [site for site in range(model.nsite) if model.site(site).name.startswith(f"{GOAL_SITE}/")]
    points, objects = data.site_xpos[sites].reshape(-1, 3), moving_bodies(model, episode)
    if not len(points) or not objects:
        return points
    place = data.xpos[objects].mean(axis=0)
    closest = points[np.linalg.norm(points - place, axis=1).argmin()]
    return points[np.linalg.norm(points - closest, axis=1) < _NEAR_GOAL]


def hidden(model: mujoco.MjModel, episode: Episode, views: Sequence[Camera]) -> np.ndarray:
    """Returns the part of each target that walls and objects hide from the camera of each frame (T, targets).

    Three points are looked for: along a robot's trunk, and one above the other in an object. Robots hide nothing.
    """
    model = copy.deepcopy(model)
    model.geom_group[model.geom_rgba[:, 3] < _CLEAR] = HIDDEN_GROUP
    data, bodies = mujoco.MjData(model), targets(model, episode)
    trunks, local = len(robot_bases(model)), body_boxes(model, bodies)
    groups = np.array([group != HIDDEN_GROUP for group in range(mujoco.mjNGROUP)], np.uint8)
    rows = []
    for index, camera in enumerate(views):
        pose(model, data, episode, index)
        boxes = posed(data, bodies, local)
        span = 0.35 * np.ptp(boxes, axis=1) * (0, 0, 1)
        span[:trunks] = _SPAN * data.xmat[bodies[:trunks]].reshape(-1, 3, 3)[:, :, 0]
        points = boxes.mean(axis=1) + np.array([-1, 0, 1])[:, None, None] * span  # (3, targets, 3)
        struck = _struck(model, data, camera.position, points.reshape(-1, 3), groups).reshape(3, -1)
        owner = model.body_rootid[model.geom_bodyid[struck]]
        seen = (struck < 0) | (owner == model.body_rootid[bodies]) | np.isin(owner, bodies[:trunks])
        rows.append(1.0 - seen.mean(axis=0))
    return np.array(rows)


def _struck(
    model: mujoco.MjModel, data: mujoco.MjData, eye: np.ndarray, points: np.ndarray, groups: np.ndarray
) -> np.ndarray:
    """Returns the first geom on each way from `eye` (3,) to `points` (P, 3); -1 if there is none."""
    ways = points - eye
    lengths = np.linalg.norm(ways, axis=1)
    geoms, distances = np.full(len(points), -1, np.int32), np.zeros(len(points))
    units = (ways / lengths[:, None]).ravel()
    mujoco.mj_multiRay(model, data, eye, units, groups, 1, -1, geoms, distances, None, len(points), mujoco.mjMAXVAL)
    return np.where(distances < lengths, geoms, -1)
