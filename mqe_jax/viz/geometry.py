"""Geometry of a scene: robot bodies, visible geoms, bounding boxes."""

import copy
from collections.abc import Iterable, Iterator, Sequence

import mujoco
import numpy as np

from mqe_jax.envs.sizes import HIGH, OUTSIDE
from mqe_jax.physics.appearance import GROUND_GROUP, HIDDEN_GROUP
from mqe_jax.physics.robots.index import trunk_bodies
from mqe_jax.physics.robots.robot import GO1_HEIGHT
from mqe_jax.viz.recording import Episode

COLLISION_GROUP = HIDDEN_GROUP
_SIGNS = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T  # of a box's corners


def height_factor(model: mujoco.MjModel) -> float:
    """Returns the height of the first robot's standing trunk over that of a Go1."""
    return float(model.body_pos[trunk_bodies(model)[0], 2]) / GO1_HEIGHT


def shown_bases(model: mujoco.MjModel) -> list[int]:
    """Returns the ids of the trunks of visible robots; a rendering model hides those left out."""
    return [body for body in trunk_bodies(model) if _drawn(model, body)]


def _drawn(model: mujoco.MjModel, body: int) -> bool:
    """Returns whether a visible geom belongs to a body or to one that hangs on it."""
    geoms = model.body_rootid[model.geom_bodyid] == model.body_rootid[body]
    return bool(np.any(model.geom_group[geoms] != HIDDEN_GROUP))


def _hide(model: mujoco.MjModel, bodies: Sequence[int]) -> None:
    """Hides bodies with all that hang on them."""
    roots = model.body_rootid[model.geom_bodyid]
    model.geom_group[np.isin(roots, model.body_rootid[np.array(bodies, int)])] = HIDDEN_GROUP


def moving_bodies(model: mujoco.MjModel, episode: Episode) -> list[int]:
    """Returns the ids of the visible bodies that move in the episode, without robots.

    They are objects and NPCs: free, sliding or mocap.
    """
    apart = np.ptp(episode.mocap_pos, axis=0).max(axis=1)
    moved = [
        body
        for body in np.flatnonzero(model.body_mocapid >= 0)
        if apart[model.body_mocapid[body]] > 0.05
    ]
    translations = [int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_SLIDE)]
    sliding = model.jnt_bodyid[np.isin(model.jnt_type, translations)]
    robots = np.isin(model.body_rootid[sliding], model.body_rootid[trunk_bodies(model)])
    bodies = {*map(int, moved), *sliding[~robots].tolist()}
    return sorted(body for body in bodies if _drawn(model, body))


def robot_color(model: mujoco.MjModel, trunk: int) -> tuple[float, ...]:
    """Returns a robot's colour (red, green, blue, alpha), of its trunk's first visible geom."""
    geoms = model.body_geomadr[trunk] + np.arange(model.body_geomnum[trunk])
    seen = [geom for geom in geoms if model.geom_group[geom] != COLLISION_GROUP]
    return tuple(map(float, model.geom_rgba[seen[0]]))


def pose(model: mujoco.MjModel, data: mujoco.MjData, episode: Episode, index: int) -> None:
    """Sets `data` to frame `index` of the episode."""
    data.qpos[:] = episode.qpos[index]
    if model.nmocap:
        data.mocap_pos[:] = episode.mocap_pos[index]
        data.mocap_quat[:] = episode.mocap_quat[index]
    mujoco.mj_kinematics(model, data)


def pose_frames(
    model: mujoco.MjModel, episode: Episode, frames: Iterable[int]
) -> Iterator[mujoco.MjData]:
    """Yields one workspace, set to each of some frames of an episode by `pose`."""
    data = mujoco.MjData(model)
    for index in frames:
        pose(model, data, episode, index)
        yield data


def box_corners(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> np.ndarray:
    """Returns the corners (8, 3) of a geom's bounding box, world frame, m."""
    centre = model.geom_aabb[geom, :3]
    half = model.geom_aabb[geom, 3:]
    return data.geom_xpos[geom] + (centre + _SIGNS * half) @ data.geom_xmat[geom].reshape(3, 3).T


def body_boxes(model: mujoco.MjModel, bodies: Sequence[int]) -> np.ndarray:
    """Returns the corners (B, 8, 3) of the boxes about bodies' visible geoms, in body frames, m."""
    boxes = []
    rotation = np.zeros(9)
    for body in bodies:
        points = [np.zeros((1, 3))]
        for geom in model.body_geomadr[body] + np.arange(model.body_geomnum[body]):
            if model.geom_group[geom] == COLLISION_GROUP:
                continue
            mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
            corners = model.geom_aabb[geom, :3] + _SIGNS * model.geom_aabb[geom, 3:]
            points.append(model.geom_pos[geom] + corners @ rotation.reshape(3, 3).T)
        shown = np.concatenate(points[1:] or points)
        low = shown.min(axis=0)
        high = shown.max(axis=0)
        boxes.append((low + high) / 2 + _SIGNS * (high - low) / 2)
    return np.array(boxes).reshape(-1, 8, 3)


def pose_boxes(data: mujoco.MjData, bodies: Sequence[int], boxes: np.ndarray) -> np.ndarray:
    """Returns the corners (B, 8, 3) of boxes in the world frame, m, from those in body frames."""
    rotation = data.xmat[list(bodies)].reshape(-1, 3, 3)
    return data.xpos[list(bodies), None] + boxes @ rotation.transpose(0, 2, 1)


def scenery_geoms(model: mujoco.MjModel) -> list[int]:
    """Returns the ids of the visible geoms of neither ground nor robots.

    Ground includes what is painted on it.
    """
    unseen = np.isin(model.geom_group, [GROUND_GROUP, COLLISION_GROUP])
    robots = model.body_rootid[trunk_bodies(model)]
    of_robots = np.isin(model.body_rootid[model.geom_bodyid], robots)
    return np.flatnonzero(~unseen & ~of_robots).tolist()


def extent(model: mujoco.MjModel, episode: Episode) -> tuple[np.ndarray, np.ndarray]:
    """Returns the lowest and highest corner (3,), m, of the scene and all robot trajectories."""
    data = mujoco.MjData(model)
    points = []
    for index in np.unique(np.linspace(0, len(episode) - 1, 30).astype(int)):
        pose(model, data, episode, int(index))
        for body in shown_bases(model):
            points += [data.xpos[body] - [0.4, 0.4, 0.3], data.xpos[body] + [0.4, 0.4, 0.2]]
    for geom in scenery_geoms(model):
        points += list(box_corners(model, data, geom))
    if not points:
        points = [np.full(3, -1.0), np.full(3, 1.0)]
    return np.min(points, axis=0), np.max(points, axis=0)


def rendering_model(model: mujoco.MjModel, episode: Episode) -> mujoco.MjModel:
    """Returns a rendering copy of the model, in which mocap walls end at the track's side walls.

    A gate's walls are long enough for every sampled gap position. The copy hides the overhang
    beyond the side walls, and robots and sliding objects that take no part in the episode.
    """
    model = copy.deepcopy(model)
    data = next(pose_frames(model, episode, [0]))
    _hide(model, [body for body in trunk_bodies(model) if data.xpos[body, 2] > HIGH])
    box = int(mujoco.mjtGeom.mjGEOM_BOX)
    shown = [geom for geom in scenery_geoms(model) if int(model.geom_type[geom]) == box]
    fixed = [geom for geom in shown if int(model.geom_bodyid[geom]) == 0]
    if not fixed:
        return model
    corners = np.concatenate([box_corners(model, data, geom) for geom in fixed])
    sliding = model.jnt_bodyid[model.jnt_type == int(mujoco.mjtJoint.mjJNT_SLIDE)]
    end = corners[:, 0].max() + OUTSIDE / 2
    _hide(model, [body for body in sliding if data.xpos[body, 0] > end])
    sides = corners[:, 1]
    for geom in shown:
        if model.body_mocapid[model.geom_bodyid[geom]] < 0:
            continue
        wall = box_corners(model, data, geom)[:, 1]
        low = max(wall.min(), sides.min() + 0.005)
        high = min(wall.max(), sides.max() - 0.005)
        if low < high and (low, high) != (wall.min(), wall.max()):
            model.geom_pos[geom, 1] += (low + high) / 2 - data.geom_xpos[geom, 1]
            model.geom_sameframe[geom] = 0  # otherwise MuJoCo reuses the body's pose
            model.geom_size[geom, 1] = model.geom_aabb[geom, 4] = (high - low) / 2
    return model
