"""What the scene shows over the robots: contact forces, collision shapes, what a robot senses."""

from collections.abc import Iterator, Sequence
from typing import Any

import mujoco
import numpy as np
from mjviser.conversions import merge_geoms

from mqe_jax.sensors.marks import Marks
from mqe_jax.view.stage import Batch, Stage
from mqe_jax.viz.geometry import COLLISION_GROUP, pose
from mqe_jax.viz.recording import Episode

_METRES_PER_NEWTON = 0.004  # of an arrow
_LONGEST = 1.0  # length of an arrow, m
_FORCE = (224, 60, 40)
_SHAPE = (224, 138, 44)
_BACKGROUND = np.array([0.7, 0.7, 0.65])  # colour of faded lines and points, as viser's are opaque
_AREA = 0.3  # opacity of an area


class Overlay:
    """Contacts and a robot's marks of one environment, and collision shapes of all.

    They are below the movable root frame of a stage.
    """

    def __init__(self, server: Any, model: mujoco.MjModel, stage: Stage) -> None:
        """Draws nothing yet."""
        self._server = server
        self._model = model
        self._data = mujoco.MjData(model)
        self._stage = stage
        self._offset = stage.offset
        self._arrows: Any = None
        self._sensed: list[Any] = []
        self._shapes: list[Batch] = []

    def draw_shapes(self, frame: Episode, shown: bool) -> None:
        """Draws the collision shapes of robots and objects, as wire frames, or removes them."""
        if shown and not self._shapes:
            self._shapes = [
                (self._add(body, geoms), [body]) for body, geoms in self._bodies().items()
            ]
        if shown:
            self._stage.place(self._shapes, *self._stage.poses(frame))
            return
        for handle, _ in self._shapes:
            handle.remove()
        self._shapes = []

    def draw_contacts(
        self, frame: Episode, index: int, qvel: np.ndarray, ctrl: np.ndarray, shown: bool
    ) -> None:
        """Draws the contacts of environment `index` in place of the last ones, if they are
        `shown`.
        """
        if self._arrows is not None:
            self._arrows.remove()
            self._arrows = None
        if not shown:
            return
        selected = frame.cut(slice(index, index + 1))
        arrows = contact_arrows(self._model, self._data, selected, qvel, ctrl)
        if len(arrows):
            self._arrows = self._server.scene.add_arrows(
                "/world/contacts",
                (arrows + self._offset[index]).astype(np.float32),
                _FORCE,
                shaft_radius=0.012,
                head_radius=0.03,
                head_length=0.05,
            )

    def draw_marks(self, marks: Sequence[Marks], index: int, agent: int) -> None:
        """Draws the marks of an agent of environment `index`, in place of the last ones."""
        with self._server.atomic():
            for handle in self._sensed:
                handle.remove()
            self._sensed = []
            for mark in marks:
                self._sensed += self._add_marks(mark, index, agent)

    def _add_marks(self, mark: Marks, index: int, agent: int) -> Iterator[Any]:
        """Yields the handles of what it draws: lines, points, an area."""
        scene = self._server.scene
        name = f"/world/sensed/{mark.label}"
        offset = self._offset[index]
        ends, colors = _shown(mark, mark.lines[index, agent], mark.line_opacity[index, agent])
        if len(ends):
            thick: Any = {"thickness": 4.0 if mark.bold else 1.5, "thickness_units": "screen"}
            colors = np.repeat(colors[:, None], 2, axis=1)
            yield scene.add_line_segments(
                f"{name}/lines", (ends + offset).astype(np.float32), colors, **thick
            )
        spots, colors = _shown(mark, mark.points[index, agent], mark.point_opacity[index, agent])
        if len(spots):
            look: Any = {"point_size": 0.05, "precision": "float32"}
            yield scene.add_point_cloud(
                f"{name}/points", (spots + offset).astype(np.float32), colors, **look
            )
        corners = mark.area.shape[2]
        if corners:
            faces = np.array([(0, k, k + 1) for k in range(1, corners - 1)])
            color = tuple(int(255 * part) for part in mark.color)
            area = (mark.area[index, agent] + offset).astype(np.float32)
            yield scene.add_mesh_simple(
                f"{name}/area", area, faces, color=color, opacity=_AREA, side="double"
            )

    def _bodies(self) -> dict[int, list[int]]:
        found: dict[int, list[int]] = {}
        for geom in np.flatnonzero(self._model.geom_group == COLLISION_GROUP):
            body = int(self._model.geom_bodyid[geom])
            if body:
                found.setdefault(body, []).append(int(geom))
        return found

    def _add(self, body: int, geoms: list[int]) -> Any:
        mesh = merge_geoms(self._model, geoms)
        count = len(self._offset)
        return self._server.scene.add_batched_meshes_simple(
            f"/world/shapes/{body}",
            np.asarray(mesh.vertices),
            np.asarray(mesh.faces),
            batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
            batched_positions=np.zeros((count, 3)),
            batched_colors=_SHAPE,
            lod="off",
            wireframe=True,
        )


def _shown(mark: Marks, places: Any, opacity: Any) -> tuple[np.ndarray, np.ndarray]:
    """Returns the places of visible lines or points, and their colours (n, 3), 0 to 255."""
    part = opacity[opacity > 0, None]
    colors = 255 * (part * np.array(mark.color) + (1 - part) * _BACKGROUND)
    return places[opacity > 0], colors.astype(np.uint8)


def contact_arrows(
    model: mujoco.MjModel, data: mujoco.MjData, frame: Episode, qvel: np.ndarray, ctrl: np.ndarray
) -> np.ndarray:
    """Returns the start and end (C, 2, 3), m, of an arrow per contact: its point and its force.

    250 N are one metre; arrows are not longer. The model has the physics' actuators; `data` is a
    workspace, `frame` one pose, with velocities (nv,) and actuator targets (nu,).
    """
    pose(model, data, frame, 0)
    data.qvel[:] = qvel
    data.ctrl[:] = ctrl
    mujoco.mj_forward(model, data)
    arrows = np.zeros((data.ncon, 2, 3))
    force = np.zeros(6)
    for i in range(data.ncon):
        contact = data.contact[i]
        mujoco.mj_contactForce(model, data, i, force)
        turn = contact.frame.reshape(3, 3).T
        arrow = _METRES_PER_NEWTON * (turn @ force[:3])
        if model.geom_bodyid[contact.geom2] == 0:  # the force acts on the second geom: the world
            arrow = -arrow
        length = max(float(np.linalg.norm(arrow)), 1e-9)
        arrows[i, 0] = contact.pos
        arrows[i, 1] = contact.pos + arrow * min(1.0, _LONGEST / length)
    return arrows
