"""Scene objects: boxes, balls, sheep, doors, planks, platforms.

An object is a small frozen dataclass that adds one body named `object/<name>` to a scene; `index_objects` returns the
addresses of its coordinates in a compiled scene. The control laws of scripted NPCs are in `npc`.

Frame: the environment's; metre, kilogram, second, radian, newton.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from mqe_jax.collision import GROUND_BIT, OBJECT_BIT, WALL_BIT

GRAVITY = 9.81  # m/s^2
Color = tuple[float, float, float, float]
Vector = tuple[float, float, float]
_GEOM, _JOINT = mujoco.mjtGeom, mujoco.mjtJoint
_AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}
# Collides with ground, walls, other objects and robots.
_FREE = {"contype": OBJECT_BIT, "conaffinity": GROUND_BIT | WALL_BIT | OBJECT_BIT}
# The same without the ground: bodies whose joints fix their height.
_HELD = {"contype": OBJECT_BIT, "conaffinity": WALL_BIT | OBJECT_BIT}
# Supporting surfaces for robots and free objects.
_FLOOR = {"contype": GROUND_BIT, "conaffinity": 0}


@dataclasses.dataclass(frozen=True)
class Object:
    """Base of all objects."""

    name: str
    """Name, unique in the scene."""

    def add(self, spec: mujoco.MjSpec, visual: bool) -> None:
        """Adds the body to a scene, with its purely visual geoms if `visual`."""
        raise NotImplementedError(f"object {type(self).__name__}: add() is not defined")

    def _body(
        self, spec: mujoco.MjSpec, position: Sequence[float], mass: float, inertia: Sequence[float] | np.ndarray
    ) -> Any:
        body = spec.worldbody.add_body(name=f"object/{self.name}", pos=position)
        body.explicitinertial, body.mass, body.inertia = True, mass, inertia
        body.ipos = (0, 0, 0)  # if unset, MuJoCo offsets the centre of mass by `position`
        return body

    def _joint(self, body: Any, suffix: str, kind: Any, damping: float = 0.0, **options: Any) -> None:
        body.add_joint(name=f"object/{self.name}/{suffix}", type=kind, damping=(damping, 0, 0), **options)

    def _slides(self, body: Any, axes: str, damping: float = 0.0) -> None:
        for axis in axes:
            self._joint(body, axis, _JOINT.mjJNT_SLIDE, damping, axis=_AXES[axis])

    def _solid(self, body: Any, kind: Any, color: Color, friction: float = 1.0, group: int = 1, **options: Any) -> None:
        body.add_geom(
            name=f"object/{self.name}",
            type=kind,
            condim=3,
            friction=(friction, 0.005, 0.0001),
            rgba=color,
            priority=1,
            group=group,
            mass=0.0,
            **options,
        )


def _visual_geom(body: Any, kind: Any, color: Color, **options: Any) -> None:
    body.add_geom(type=kind, rgba=color, contype=0, conaffinity=0, group=2, mass=0.0, **options)


@dataclasses.dataclass(frozen=True)
class Box(Object):
    """A movable box. Coordinates: position 3, quaternion 4; velocity linear 3 (world), angular 3 (body)."""

    size: Vector = (1.0, 1.0, 1.0)
    """Full extents, m."""
    mass: float = 6.0
    """Mass, kg."""
    friction: float = 1.0
    """Sliding friction; takes precedence over the ground's."""

    def add(self, spec: mujoco.MjSpec, visual: bool) -> None:
        """Adds the box."""
        x, y, z = np.square(self.size)
        body = self._body(spec, (0, 0, 0), self.mass, np.array([y + z, x + z, x + y]) * self.mass / 12)
        self._joint(body, "free", _JOINT.mjJNT_FREE)
        half = np.array(self.size) / 2
        self._solid(body, _GEOM.mjGEOM_BOX, (0.93, 0.93, 0.93, 1.0), self.friction, size=half, **_FREE)


@dataclasses.dataclass(frozen=True)
class Ball(Object):
    """A football with rolling resistance. Coordinates and velocity as in `Box`."""

    radius: float = 0.1
    """Radius, m."""
    mass: float = 0.318
    """Mass, kg."""
    damping: float = 0.1
    """Linear damping, N s/m."""
    angular_damping: float = 0.0003
    """Angular damping, N m s/rad."""

    def add(self, spec: mujoco.MjSpec, visual: bool) -> None:
        """Adds the ball, a thin shell, on three slides and a ball joint.

        A free joint is unsuitable, because it has a single damping coefficient for all six degrees of freedom.
        """
        body = self._body(spec, (0, 0, 0), self.mass, (2 / 3 * self.mass * self.radius**2,) * 3)
        self._slides(body, "xyz", self.damping)
        self._joint(body, "turn", _JOINT.mjJNT_BALL, self.angular_damping)
        self._solid(body, _GEOM.mjGEOM_SPHERE, (0.95, 0.95, 0.95, 1.0), size=(self.radius, 0, 0), **_FREE)
        if visual:  # dark patches make the rotation visible
            for axis in _AXES.values():
                for side in (-1, 1):
                    _visual_geom(
                        body,
                        _GEOM.mjGEOM_SPHERE,
                        (0.1, 0.1, 0.12, 1.0),
                        size=(0.5 * self.radius, 0, 0),
                        pos=np.array(axis) * side * 0.56 * self.radius,
                    )


@dataclasses.dataclass(frozen=True)
class Cylinder(Object):
    """An upright cylinder that slides along y only. Coordinate: y, m; velocity likewise.

    Its collision geom is a capsule whose cylindrical part has the cylinder's height; ground friction is modelled as
    friction loss of the slide, which needs no contacts.
    """

    position: tuple[float, float] = (0.0, 0.0)
    """Position of the axis at y = 0 (x, y), m."""
    radius: float = 1.2
    """Radius, m."""
    height: float = 0.5
    """Height, m."""
    mass: float = 3.0
    """Mass, kg."""
    friction: float = 1.0
    """Sliding friction between cylinder and ground."""
    reach: float = 1.8
    """Maximum |y|, m."""

    def add(self, spec: mujoco.MjSpec, visual: bool) -> None:
        """Adds the cylinder."""
        body = self._body(spec, (*self.position, 0.0), self.mass, (1.0, 1.0, 1.0))
        self._joint(
            body,
            "y",
            _JOINT.mjJNT_SLIDE,
            axis=_AXES["y"],
            limited=True,
            range=(-self.reach, self.reach),
            frictionloss=self.friction * self.mass * GRAVITY,
        )
        white = (0.95, 0.95, 0.95, 1.0)
        self._solid(
            body,
            _GEOM.mjGEOM_CAPSULE,
            white,
            group=3,
            size=(self.radius, 0, 0),
            fromto=(0, 0, 0, 0, 0, self.height),
            **_HELD,
        )
        if visual:
            half = self.height / 2
            _visual_geom(body, _GEOM.mjGEOM_CYLINDER, white, size=(self.radius, half, 0), pos=(0, 0, half))


@dataclasses.dataclass(frozen=True)
class Door(Object):
    """A revolving door: a panel on a vertical hinge at its centre. Coordinate: angle, rad, 0 along y."""

    position: tuple[float, float] = (0.0, 0.0)
    """Position of the hinge (x, y), m."""
    size: Vector = (0.08, 1.95, 0.8)
    """Thickness, width and height, m."""
    mass: float = 4.0
    """Mass, kg."""
    inertia: float = 1.232
    """Inertia about the hinge, kg m^2."""
    damping: float = 0.5
    """Damping of the hinge, N m s/rad."""

    def add(self, spec: mujoco.MjSpec, visual: bool) -> None:
        """Adds the door."""
        body = self._body(spec, (*self.position, self.size[2] / 2), self.mass, (1.0, 0.5, self.inertia))
        self._joint(body, "turn", _JOINT.mjJNT_HINGE, self.damping, axis=_AXES["z"])
        self._solid(body, _GEOM.mjGEOM_BOX, (0.93, 0.93, 0.93, 1.0), size=np.array(self.size) / 2, **_HELD)


@dataclasses.dataclass(frozen=True)
class Seesaw(Object):
    """A balanced plank on a hinge across the track. Coordinate: pitch, rad, negative with the near end down."""

    hinge: Vector = (5.6, 0.0, 0.545)
    """Position of the hinge (x, y, z), m."""
    size: Vector = (4.123, 1.0, 0.03)
    """Length, width and thickness of the plank, m."""
    behind: float = 0.103
    """Distance of the plank's centre from the hinge, towards the near end, m."""
    mass: float = 100.0
    """Mass, kg; the centre of mass is at the hinge, so that the plank is in equilibrium at every angle."""
    inertia: float = 100.0
    """Inertia about the hinge, kg m^2."""
    limit: float = 0.254
    """Maximum |angle|, rad; at the lower limit the near end is on the ground."""
    damping: float = 1000.0
    """Damping of the hinge, N m s/rad; limits its speed: a Go1 (111 N) at the far end, 1.9 m from the hinge, turns it
    at 0.21 rad/s.
    """

    def add(self, spec: mujoco.MjSpec, visual: bool) -> None:
        """Adds the plank, and its posts as visual geoms."""
        body = self._body(spec, self.hinge, self.mass, (self.inertia,) * 3)
        self._joint(
            body,
            "pitch",
            _JOINT.mjJNT_HINGE,
            self.damping,
            axis=_AXES["y"],
            limited=True,
            range=(-self.limit, self.limit),
        )
        half, white = np.array(self.size) / 2, (0.95, 0.95, 0.95, 1.0)
        self._solid(body, _GEOM.mjGEOM_BOX, white, size=half, pos=(-self.behind, 0, 0), **_FLOOR)
        if visual:
            x, y, z = self.hinge
            grey = (0.55, 0.55, 0.58, 1.0)
            for side in (-1, 1):
                edge, post = y + side * half[1], y + side * (half[1] + 0.06)
                _visual_geom(
                    spec.worldbody,
                    _GEOM.mjGEOM_CYLINDER,
                    grey,
                    size=(0.05, 0, 0),
                    fromto=(x, edge, z, x, edge + side * 0.08, z),
                )
                _visual_geom(spec.worldbody, _GEOM.mjGEOM_BOX, grey, size=(0.05, 0.02, z / 2), pos=(x, post, z / 2))


@dataclasses.dataclass(frozen=True)
class Platform(Object):
    """A fixed block that supports robots. No coordinates."""

    center: Vector = (0.0, 0.0, 1.0)
    """Centre of the top face (x, y, z), m."""
    size: Vector = (1.0, 1.0, 1.0)
    """Full extents, m."""
    column: float = 0.0
    """Radius of the supporting column, m; none if 0."""

    def add(self, spec: mujoco.MjSpec, visual: bool) -> None:
        """Adds the block."""
        x, y, top = self.center
        body = spec.worldbody.add_body(name=f"object/{self.name}", pos=(x, y, top - self.size[2] / 2))
        self._solid(body, _GEOM.mjGEOM_BOX, (0.95, 0.95, 0.95, 1.0), size=np.array(self.size) / 2, **_FLOOR)
        if not self.column:
            return
        foot = top - self.size[2]
        body.add_geom(
            name=f"object/{self.name}/column",
            type=_GEOM.mjGEOM_CAPSULE,
            group=3,
            mass=0.0,
            condim=3,
            priority=1,
            contype=WALL_BIT,
            conaffinity=0,
            size=(self.column, 0, 0),
            fromto=(0, 0, -top + self.size[2] / 2, 0, 0, -self.size[2] / 2 - self.column),
        )
        if visual:
            _visual_geom(
                spec.worldbody,
                _GEOM.mjGEOM_CYLINDER,
                (0.75, 0.75, 0.78, 1.0),
                size=(self.column, foot / 2, 0),
                pos=(x, y, foot / 2),
            )


@dataclasses.dataclass(frozen=True)
class Ring(Object):
    """A circle marked on the ground, without collision geoms. No coordinates."""

    center: Vector = (0.0, 0.0, 0.0)
    """Centre (x, y, z), m."""
    radius: float = 1.7
    """Radius, m."""
    width: float = 0.04
    """Width of the line, m."""

    def add(self, spec: mujoco.MjSpec, visual: bool) -> None:
        """Adds the line as short visual segments."""
        body = spec.worldbody.add_body(name=f"object/{self.name}", pos=self.center)
        if not visual:
            return
        pieces = 72
        half = np.pi * self.radius / pieces * 1.05
        for angle in np.arange(pieces) * 2 * np.pi / pieces:
            _visual_geom(
                body,
                _GEOM.mjGEOM_BOX,
                (0.2, 0.2, 0.22, 1.0),
                size=(self.width / 2, half, 0.004),
                pos=(self.radius * np.cos(angle), self.radius * np.sin(angle), 0.0),
                quat=(np.cos(angle / 2), 0, 0, np.sin(angle / 2)),
            )


@dataclasses.dataclass(frozen=True)
class Sheep(Object):
    """An upright sheep that slides over the ground without rotating. Coordinates: x, y; velocity likewise.

    Ground friction is part of `flock`, which needs no contacts.
    """

    radius: float = 0.2
    """Radius, m."""
    height: float = 0.5
    """Height, m."""
    mass: float = 5.0
    """Mass, kg."""

    def add(self, spec: mujoco.MjSpec, visual: bool) -> None:
        """Adds the sheep: a capsule whose lower end is below the ground, so that it is cylindrical at ground level."""
        body = self._body(spec, (0, 0, 0), self.mass, (0.1, 0.1, 0.1))
        self._slides(body, "xy")
        fleece = (0.96, 0.95, 0.90, 1.0)
        self._solid(
            body,
            _GEOM.mjGEOM_CAPSULE,
            fleece,
            group=3 if visual else 1,
            size=(self.radius, 0, 0),
            fromto=(0, 0, 0, 0, 0, self.height - self.radius),
            **_HELD,
        )
        if visual:
            dark = (0.16, 0.14, 0.13, 1.0)
            top, wide = self.height, self.radius
            _visual_geom(
                body, _GEOM.mjGEOM_ELLIPSOID, fleece, size=(wide, 0.75 * wide, 0.32 * top), pos=(0, 0, 0.62 * top)
            )
            _visual_geom(body, _GEOM.mjGEOM_SPHERE, fleece, size=(0.35 * wide, 0, 0), pos=(0.85 * wide, 0, 0.92 * top))
            _visual_geom(
                body,
                _GEOM.mjGEOM_ELLIPSOID,
                dark,
                size=(0.45 * wide, 0.3 * wide, 0.3 * wide),
                pos=(1.15 * wide, 0, 0.82 * top),
            )
            for x in (-0.5, 0.5):
                for y in (-0.35, 0.35):
                    _visual_geom(
                        body,
                        _GEOM.mjGEOM_CAPSULE,
                        dark,
                        size=(0.12 * wide, 0, 0),
                        fromto=(x * wide, y * wide, 0.02, x * wide, y * wide, 0.4 * top),
                    )


@dataclasses.dataclass(frozen=True)
class ObjectIndex:
    """Addresses of one object in a compiled model; host integers."""

    qpos: np.ndarray
    """Addresses of its coordinates in qpos (C,)."""
    qvel: np.ndarray
    """Addresses of its velocities in qvel (V,)."""
    body: int
    """Body id."""
    geom: int
    """Id of its collision geom, -1 if it has none."""


def index_objects(model: mujoco.MjModel, objects: Sequence[Object]) -> Mapping[str, ObjectIndex]:
    """Looks up the addresses of all objects of a compiled model by name."""
    found = {}
    for item in objects:
        body = model.body(f"object/{item.name}")
        joints = range(body.jntadr[0], body.jntadr[0] + body.jntnum[0]) if body.jntnum[0] else ()
        widths = {_JOINT.mjJNT_FREE: (7, 6), _JOINT.mjJNT_BALL: (4, 3)}
        qpos, qvel = [], []
        for joint in joints:
            coordinates, speeds = widths.get(_JOINT(model.jnt_type[joint]), (1, 1))
            qpos.extend(model.jnt_qposadr[joint] + np.arange(coordinates))
            qvel.extend(model.jnt_dofadr[joint] + np.arange(speeds))
        as_int = lambda rows: np.asarray(rows, np.int32)  # noqa: E731
        geom = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, f"object/{item.name}")
        found[item.name] = ObjectIndex(as_int(qpos), as_int(qvel), int(body.id), geom)
    return found
