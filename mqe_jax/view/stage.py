"""The 3-D scene in the browser: environments side by side, one batch of instances per mesh."""

from typing import Any

import mujoco
import numpy as np
import trimesh
from mjviser.conversions import is_fixed_body, merge_geoms

from mqe_jax.envs import QuadrupedEnv
from mqe_jax.envs.sizes import HIGH
from mqe_jax.physics.appearance import GROUND_GROUP
from mqe_jax.viz.geometry import COLLISION_GROUP, extent, pose, pose_frames, rendering_model
from mqe_jax.viz.recording import Episode

_GAP = 0.6  # m between environments
_SKY = 2.4  # intensity of the light
_SUN = 2.7
_OPAQUE = 0.5  # opacity below which geoms are left out: meshes of several colours have none
_PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)
_BOX = int(mujoco.mjtGeom.mjGEOM_BOX)


Batch = tuple[Any, list[int]]
"""Handle of N x bodies instances of one mesh, and the bodies that share it."""


class Stage:
    """Renders N environments under one movable root frame.

    It keeps a followed body at the origin.
    """

    span = 0.0  # diagonal of the box about the followed bodies, m

    def __init__(self, server: Any, model: mujoco.MjModel, frame: Episode) -> None:
        self._server = server
        self._model = model
        self._data = mujoco.MjData(self._model)
        self._count = len(frame)
        single = frame.cut(slice(1))
        low, high = extent(rendering_model(self._model, single), single)
        self.centre = (low + high) / 2
        self.size = high - low
        shift = (high[1] - low[1] + _GAP) * (np.arange(self._count) - (self._count - 1) / 2)
        self.offset = np.zeros((self._count, 3))
        self.offset[:, 1] = shift
        self._mocap: np.ndarray | None = None
        self.bodies = followable(self._model)
        self._root = server.scene.add_frame("/world", show_axes=False)
        self._add_light()
        self._add_floor(low, high)
        fixed, moving, self._walls = _sort_geoms(self._model)
        still = [self._add_batch(f"fixed/{body}", geoms, [body]) for body, geoms in fixed.items()]
        self.place(still, *self.poses(frame))
        self._batches = [
            self._add_batch(f"moving/{bodies[0]}", moving[bodies[0]], bodies)
            for bodies in self._group(moving)
        ]
        self._wall_handles = [self._add_wall(geom) for geom in self._walls]
        self.draw(frame)

    def draw(self, frame: Episode, followed: tuple[int, list[int]] | None = None) -> None:
        """Renders the environments' poses, with the middle of `followed` at the origin.

        `followed` are an environment and bodies of it. Robots that take no part in the episode are
        not followed.
        """
        positions, turns = self.poses(frame)
        with self._server.atomic():
            places = positions[followed] if followed else np.zeros((0, 3))
            places = places[places[:, 2] < HIGH]
            if len(places):
                self.span = float(np.linalg.norm(np.ptp(places, axis=0)))
                x, y, _ = (places.min(axis=0) + places.max(axis=0)) / 2
                self._root.position = (-x, -y, 0.0)
            self.place(self._batches, positions, turns)
            self._draw_walls(frame)

    def poses(self, frame: Episode) -> tuple[np.ndarray, np.ndarray]:
        """Returns positions (N, bodies, 3) and quaternions (N, bodies, 4) of all bodies."""
        positions = np.zeros((self._count, self._model.nbody, 3))
        turns = np.zeros((self._count, self._model.nbody, 4))
        for i in range(self._count):
            pose(self._model, self._data, frame, i)
            positions[i] = self._data.xpos + self.offset[i]
            turns[i] = self._data.xquat
        return positions, turns

    def place(self, batches: list[Batch], positions: np.ndarray, turns: np.ndarray) -> None:
        """Moves batches to the poses of their bodies, as `poses` returns them."""
        for handle, bodies in batches:
            handle.batched_positions = positions[:, bodies].reshape(-1, 3).astype(np.float32)
            handle.batched_wxyzs = turns[:, bodies].reshape(-1, 4).astype(np.float32)

    def overview(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns camera position and look-at point (3,), m, for the whole scene."""
        size = np.hypot(self.size[0], self.size[1] * self._count)
        return chase(self.centre * [1.0, 0.0, 0.0], 1.4 * float(size))

    def release(self) -> None:
        """Stops following bodies."""
        self._root.position = (0.0, 0.0, 0.0)

    def _draw_walls(self, frame: Episode) -> None:
        """Renders the moving walls if their poses have changed, clipped at the side walls."""
        unchanged = self._mocap is not None and np.array_equal(self._mocap, frame.mocap_pos)
        if unchanged or not self._walls:
            return
        self._mocap = frame.mocap_pos.copy()
        frames = [frame.cut(slice(i, i + 1)) for i in range(self._count)]
        boxes = [_wall_boxes(self._model, one, self._walls) for one in frames]
        centres, turns, sizes = (np.stack(part, 1) for part in zip(*boxes, strict=True))
        for index, handle in enumerate(self._wall_handles):
            handle.batched_positions = (centres[index] + self.offset).astype(np.float32)
            handle.batched_wxyzs = turns[index].astype(np.float32)
            handle.batched_scales = sizes[index].astype(np.float32)

    def _add_light(self) -> None:
        """Lights the scene as clips are lit; viser's lights and surroundings wash colours out."""
        scene = self._server.scene
        scene.configure_default_lights(False)
        scene.configure_environment_map(None)
        scene.add_light_hemisphere("/sky", ground_color=(150, 150, 140), intensity=_SKY)
        scene.add_light_directional(
            "/sun", position=(-3.0, -4.0, 9.0), intensity=_SUN, cast_shadow=False
        )

    def _add_floor(self, low: np.ndarray, high: np.ndarray) -> None:
        model = self._model
        length = float(high[0] - low[0]) + 4.0
        width = float(high[1] - low[1]) + 2 * float(self.offset[-1, 1]) + 4.0
        middle = ((low[0] + high[0]) / 2, (low[1] + high[1]) / 2)
        floors = (model.geom_type == _PLANE) & (model.geom_group == GROUND_GROUP)
        colour = tuple(round(255 * float(c)) for c in model.geom_rgba[floors][0, :3])
        self._server.scene.add_box(
            "/world/floor",
            color=colour,
            dimensions=(length, width, 0.02),
            position=(*middle, -0.012),
            cast_shadow=False,
        )

    def _group(self, moving: dict[int, list[int]]) -> list[list[int]]:
        """Returns the moving bodies, in groups of the same geoms, which share a mesh."""
        names = ("type", "dataid", "matid", "size", "pos", "quat", "rgba")
        fields = [np.round(getattr(self._model, f"geom_{name}"), 5) + 0.0 for name in names]
        groups: dict[bytes, list[int]] = {}
        for body, geoms in moving.items():
            look = b"".join(field[geoms].tobytes() for field in fields)
            groups.setdefault(look, []).append(body)
        return list(groups.values())

    def _add_batch(self, name: str, geoms: list[int], bodies: list[int]) -> Batch:
        count = self._count * len(bodies)
        handle = self._server.scene.add_batched_meshes_trimesh(
            f"/world/{name}",
            merge_geoms(self._model, geoms),
            batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
            batched_positions=np.zeros((count, 3)),
            lod="off",
        )
        return handle, bodies

    def _add_wall(self, geom: int) -> Any:
        box = trimesh.creation.box((2.0, 2.0, 2.0))
        return self._server.scene.add_batched_meshes_simple(
            f"/world/walls/{geom}",
            np.asarray(box.vertices),
            np.asarray(box.faces),
            batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (self._count, 1)),
            batched_positions=np.zeros((self._count, 3)),
            batched_scales=np.ones((self._count, 3), np.float32),
            batched_colors=tuple(int(255 * c) for c in self._model.geom_rgba[geom, :3]),
            lod="off",
            flat_shading=True,
        )


def chase(look_at: np.ndarray, distance: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns camera position and look-at point (3,), m, from behind and above at a distance, m."""
    return look_at + distance * np.array([-0.62, -0.28, 0.73]), look_at


def start_frame(env: QuadrupedEnv, num_envs: int) -> Episode:
    """Returns the robots at their start, the mean of the initial states, in `num_envs` frames.

    It compiles nothing.
    """
    index = env.index
    data = mujoco.MjData(env.compiled.model)
    qpos = data.qpos.copy()
    has = env.robots.has_joint
    qpos[index.joint_qpos[has]] = env.robots.table("default_joints")[has]
    heights = np.asarray(env.by_height(np.full(len(has), env.params.spawn_height)))
    for row, (x, y, yaw), z in zip(index.base_qpos, env.spawn_poses(), heights, strict=True):
        qpos[row] = (x, y, z, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2))
    poses = [np.stack([x] * num_envs) for x in (qpos, data.mocap_pos, data.mocap_quat)]
    return Episode(*poses, dt=env.dt)


def followable(model: mujoco.MjModel) -> dict[str, int]:
    """Returns the bodies that a camera can follow: robots and movable objects, by label."""
    labels = {}
    for joint in range(model.njnt):
        body = int(model.jnt_bodyid[joint])
        if int(model.body_rootid[body]) == body:
            kind, _, name = model.body(body).name.partition("/")
            if kind.startswith("robot"):
                name = f"robot {int(kind[5:]) + 1}"
            labels[name or kind] = body
    return labels


def _sort_geoms(
    model: mujoco.MjModel,
) -> tuple[dict[int, list[int]], dict[int, list[int]], list[int]]:
    """Returns the visible geoms of fixed and of moving bodies, by body, and mocap bodies' boxes."""
    fixed: dict[int, list[int]] = {}
    moving: dict[int, list[int]] = {}
    walls = []
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        kind = int(model.geom_type[geom])
        if int(model.geom_group[geom]) == COLLISION_GROUP or kind == _PLANE:
            continue
        if model.geom_rgba[geom, 3] < _OPAQUE:
            continue
        if model.body_mocapid[body] >= 0 and kind == _BOX:
            walls.append(geom)
        elif is_fixed_body(model, body):
            fixed.setdefault(body, []).append(geom)
        else:
            moving.setdefault(body, []).append(geom)
    return fixed, moving, walls


def _wall_boxes(
    model: mujoco.MjModel, episode: Episode, geoms: list[int]
) -> tuple[np.ndarray, ...]:
    """Returns centre (G, 3), quaternion (G, 4) and half sizes (G, 3) of the walls.

    They end at the side walls.
    """
    clipped = rendering_model(model, episode)
    data = next(pose_frames(clipped, episode, [0]))
    turns = np.zeros((len(geoms), 4))
    for row, geom in enumerate(geoms):
        mujoco.mju_mat2Quat(turns[row], data.geom_xmat[geom])
    return data.geom_xpos[geoms].copy(), turns, clipped.geom_size[geoms].copy()
