"""Bodies of a compiled MJCF as the body tree of a `Robot`."""

import dataclasses
from collections.abc import Sequence
from typing import Literal

import mujoco
import numpy as np

from mqe_jax.core.errors import brief
from mqe_jax.physics.robots.fitting import ROW, cloud, fit, volume
from mqe_jax.physics.robots.robot import (
    FOOT,
    TRUNK,
    Body,
    Hinge,
    Link,
    Look,
    Mesh,
    Primitive,
    Shape,
)
from mqe_jax.physics.robots.skeleton import Foot, Skeleton, four, triple

_GEOM = mujoco.mjtGeom
_KINDS: dict[int, Literal["sphere", "capsule", "cylinder", "box", "ellipsoid", "mesh"]] = {
    int(_GEOM.mjGEOM_SPHERE): "sphere",
    int(_GEOM.mjGEOM_CAPSULE): "capsule",
    int(_GEOM.mjGEOM_CYLINDER): "cylinder",
    int(_GEOM.mjGEOM_BOX): "box",
    int(_GEOM.mjGEOM_ELLIPSOID): "ellipsoid",
    int(_GEOM.mjGEOM_MESH): "mesh",
}
_ROUND = (int(_GEOM.mjGEOM_SPHERE), int(_GEOM.mjGEOM_CAPSULE))
_UP = np.array([0.0, 0.0, 1.0])
SLACK = 0.7  # share of the volume of capsules about all at which each shape has its own
SHORT = 0.05  # m, between two joints for which there is no capsule
SLIM = 0.06  # radius over length of a capsule between two joints
FEW = 2  # round shapes of a body that are kept as they are; more become one


class Shapes:
    """Makes the bodies of a skeleton with feet."""

    def __init__(self, of: Skeleton, feet: Sequence[Foot], alone: bool) -> None:
        """`alone` says that a foot has one collision shape."""
        self.of = of
        self.model = of.model
        self.soles = {foot.geom: foot for foot in feet}
        self.alone = alone
        self.bare: list[str] = []
        self.notes: list[str] = []
        self.meshes: set[str] = set()  # to which collision shapes are fitted

    def bodies(self) -> list[Body]:
        """Returns the bodies, the trunk first; sets `notes`."""
        bodies = [self._body(body) for body in self.of.ids]
        missing = self.of.source.missing
        if missing:
            self.notes.append(
                f"mesh: {len(missing)} files are missing, such as {brief(missing[0])!r}; the robot "
                "is drawn by its other shapes"
            )
        if self.bare:
            self.notes.append(
                f"bodies {brief(', '.join(self.bare))}: have no collision shapes; capsules about "
                "what is drawn of them, or about their joints, are used"
            )
        return bodies

    def _body(self, body: int) -> Body:
        model = self.model
        own = self.of.names[body]
        link = Link.from_principal(
            float(model.body_mass[body]),
            triple(model.body_ipos[body]),
            triple(model.body_inertia[body]),
            model.body_iquat[body].tolist(),
        )
        first = model.body_jntadr[body]
        hinges = ()
        if body != self.of.root:
            hinges = tuple(
                Hinge(self.of.joint_name(j), triple(model.jnt_axis[j]), triple(model.jnt_pos[j]))
                for j in range(first, first + model.body_jntnum[body])
            )
        base = body == self.of.root
        return Body(
            name=own,
            parent="" if base else self.of.names[int(model.body_parentid[body])],
            position=triple(model.body_pos[body]),
            quaternion=(1.0, 0.0, 0.0, 0.0) if base else four(model.body_quat[body]),
            link=link,
            hinges=hinges,
            shapes=tuple(self._shapes(body, own)),
            looks=tuple(self._looks(body)),
        )

    def _shapes(self, body: int, own: str) -> list[Shape]:
        """Returns a body's collision shapes: those that all engines support as they are."""
        solid = [g for g in self.of.geoms(body, True) if g not in self.soles]
        feet = [g for g in self.of.geoms(body, True) if g in self.soles]
        drawn = [] if feet else self.of.geoms(body, False)
        plain = all(self.model.geom_type[g] in _ROUND for g in solid)
        if solid and plain and len(solid) <= FEW:
            found = [self._primitive(g) for g in solid]
        elif solid or drawn:
            clouds = [cloud(self.model, g) for g in solid or drawn]
            found = fit(np.concatenate(clouds))
            alone = [each for points in clouds for each in fit(points, 1)]
            if len(alone) <= ROW and volume(alone) < SLACK * volume(found):
                found = alone
            self.meshes |= {self._mesh(g) for g in solid or drawn} - {""}
        else:
            found = self._bones(body)
        if not solid and found:
            self.bare.append(own)
        part = TRUNK if body == self.of.root else own
        shapes = []
        for geom in feet:
            soles = [self._primitive(geom)]
            if self.model.geom_type[geom] not in _ROUND:
                soles = fit(cloud(self.model, geom), 1 if self.alone else ROW)
            found = [_above(each, self.soles[geom].center) for each in found]
            names = (f"{own}_{FOOT}{len(shapes) + i}" for i in range(len(soles)))
            shapes += [Shape(*each) for each in zip(names, [FOOT] * len(soles), soles, strict=True)]
        return [Shape(f"{own}_{i}", part, each) for i, each in enumerate(found)] + shapes

    def _bones(self, body: int) -> list[Primitive]:
        """Returns shapes of a body that has none, between its joints and those of its children.

        That of the trunk is about the first joints of all limbs, those of other bodies are slim.
        """
        model = self.model
        ends = [
            model.body_pos[child]
            for child in self.of.ids
            if int(model.body_parentid[child]) == body
        ]
        ends += [np.array(foot.center) for foot in self.soles.values() if foot.body == body]
        points = np.array(ends).reshape(-1, 3)
        if body == self.of.root:
            half = 0.1 * max(float(np.ptp(points, axis=0).max()), 0.05)
            return fit(np.concatenate([points - half * _UP, points + half * _UP]))
        length = float(np.linalg.norm(points, axis=1).max(initial=0.0))
        if length < SHORT:
            return []
        far = points[np.argmax(np.linalg.norm(points, axis=1))]
        return [Primitive("capsule", SLIM * length, (0.0, 0.0, 0.0), triple(far))]

    def _mesh(self, geom: int) -> str:
        """Returns the name of a geom's mesh; empty for other geoms."""
        if self.model.geom_type[geom] != _GEOM.mjGEOM_MESH:
            return ""
        return self.model.mesh(int(self.model.geom_dataid[geom])).name

    def _looks(self, body: int) -> list[Look]:
        tint = 0.6 if body == self.of.root else 0.15
        found = []
        for geom in self.of.geoms(body, False) or self.of.geoms(body, True):
            material = int(self.model.geom_matid[geom])
            rgba = self.model.mat_rgba[material] if material >= 0 else self.model.geom_rgba[geom]
            found.append(Look(self._primitive(geom), four(rgba), tint))
        return found

    def _primitive(self, geom: int) -> Primitive:
        """Returns a geom as a primitive."""
        model = self.model
        kind = _KINDS.get(int(model.geom_type[geom]))
        if kind is None:
            name = model.geom(geom).name
            raise self.of.error(f"geom {name!r}: its type is not read; use a primitive or a mesh")
        size = model.geom_size[geom]
        place = triple(model.geom_pos[geom])
        turn = four(model.geom_quat[geom])
        if kind in ("capsule", "cylinder"):
            rows = np.zeros(9)
            mujoco.mju_quat2Mat(rows, np.array(turn))
            along = size[1] * rows.reshape(3, 3)[:, 2]
            ends = (triple(place - along), triple(place + along))
            return Primitive(kind, float(size[0]), *ends)
        if kind == "mesh":
            mesh = int(model.geom_dataid[geom])
            first = model.mesh_vertadr[mesh]
            start = model.mesh_faceadr[mesh]
            surface = Mesh(
                model.mesh_vert[first : first + model.mesh_vertnum[mesh]],
                model.mesh_face[start : start + model.mesh_facenum[mesh]],
            )
            return Primitive(kind, 0.0, place, quaternion=turn, mesh=surface)
        radius = float(size[0]) if kind == "sphere" else triple(size)
        return Primitive(kind, radius, place, quaternion=turn)


def _above(shape: Primitive, sole: tuple[float, float, float]) -> Primitive:
    """Returns a capsule whose ends are no nearer to the centre of a foot than its radius."""
    if shape.end is None:
        return shape
    radius = float(np.atleast_1d(shape.size)[0])
    ends = np.array([shape.position, shape.end])
    gaps = np.linalg.norm(ends - np.array(sole), axis=1)
    near = int(np.argmin(gaps))
    along = ends[1 - near] - ends[near]
    share = (radius - gaps[near]) / max(float(np.linalg.norm(along)), radius)
    ends[near] += np.clip(share, 0.0, 0.9) * along
    return dataclasses.replace(shape, position=triple(ends[0]), end=triple(ends[1]))
