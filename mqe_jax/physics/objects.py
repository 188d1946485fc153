"""Scene objects: settings classes that add one body each to a scene; SI units.

A task's parameters may nest them.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from mqe_jax.core.limits import Coordinate, Damping, Distance, Friction, Length, Mass
from mqe_jax.core.settings import settings_class
from mqe_jax.physics.appearance import HIDDEN_GROUP, STONE, WOOD, Color, bodies
from mqe_jax.physics.appearance.shapes import circle
from mqe_jax.physics.collision import GROUND_BIT, OBJECT_BIT, WALL_BIT

GRAVITY = 9.81  # m/s^2
Vector = tuple[Coordinate, Coordinate, Coordinate]
Size = tuple[Length, Length, Length]
_GEOM = mujoco.mjtGeom
_JOINT = mujoco.mjtJoint
_AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}
# Collides with ground, walls, other objects and robots.
_FREE = {"contype": OBJECT_BIT, "conaffinity": GROUND_BIT | WALL_BIT | OBJECT_BIT}
# The same without the ground: bodies whose joints fix their height.
_HELD = {"contype": OBJECT_BIT, "conaffinity": WALL_BIT | OBJECT_BIT}
# Supporting surfaces for robots and free objects.
_FLOOR = {"contype": GROUND_BIT, "conaffinity": 0}


class Circle(NamedTuple):
    """An outline about the origin of a body."""

    radius: float  # m


class Rectangle(NamedTuple):
    """An outline about the origin of a body."""

    length: float  # along the body's x, m
    width: float  # along its y, m


class Object:
    """Base of all objects."""

    @property
    def kind(self) -> str:
        """What sensors take it for."""
        return type(self).__name__.lower()

    @property
    def outline(self) -> Circle | Rectangle | None:
        """What planar sensors see of it; None if robots pass or stand on it."""
        return None

    def add(self, spec: mujoco.MjSpec, name: str, visual: bool) -> None:
        """Adds the body `name` to a scene, with its visual geoms if `visual`.

        It may add neither an actuator nor a mocap body.
        """
        raise NotImplementedError(f"object {type(self).__name__}: add() is not defined")


def add_body(
    spec: mujoco.MjSpec, name: str, position: Sequence[float], mass: float, inertia: Any
) -> Any:
    """Adds a body with an explicit inertia, and returns it.

    `position` is (3,), m, `mass` in kg, and `inertia` the principal moments (3,), kg m^2.
    """
    body = spec.worldbody.add_body(name=name, pos=position)
    body.explicitinertial = True
    body.mass = mass
    body.inertia = inertia
    body.ipos = (0, 0, 0)  # if unset, MuJoCo offsets the centre of mass by `position`
    return body


def add_slides(body: Any, axes: str, damping: float = 0.0) -> None:
    """Adds a slide for each axis, with a damping, N s/m."""
    for axis in axes:
        _add_joint(body, axis, _JOINT.mjJNT_SLIDE, damping, axis=_AXES[axis])


def add_solid(
    body: Any, kind: Any, color: Color, friction: float = 1.0, group: int = 1, **options: Any
) -> None:
    """Adds the collision geom of a body."""
    sliding = (friction, 0.005, 0.0001)
    solid = {"name": body.name, "type": kind, "rgba": color, "friction": sliding, "group": group}
    body.add_geom(condim=3, priority=1, mass=0.0, **solid, **options)


def _add_joint(body: Any, suffix: str, kind: Any, damping: float = 0.0, **options: Any) -> None:
    body.add_joint(name=f"{body.name}/{suffix}", type=kind, damping=(damping, 0, 0), **options)


@settings_class
class Box(Object):
    """A movable box.

    Coordinates: position 3, quaternion 4; velocity linear 3 (world), angular 3 (body).

    Example:
        ```python
        from mqe_jax.physics.objects import Box

        env = mqe_jax.make("go1pushbox", box=Box(mass=8.0))
        ```
    """

    size: Size = (1.0, 1.0, 1.0)
    """Full extents, m."""
    mass: Mass = 6.0
    """Mass, kg."""
    friction: Friction = 1.0
    """Sliding friction; takes precedence over the ground's."""

    @property
    def outline(self) -> Rectangle:
        return Rectangle(*self.size[:2])

    def add(self, spec: mujoco.MjSpec, name: str, visual: bool) -> None:
        x, y, z = np.square(self.size)
        inertia = np.array([y + z, x + z, x + y]) * self.mass / 12
        body = add_body(spec, name, (0, 0, 0), self.mass, inertia)
        _add_joint(body, "free", _JOINT.mjJNT_FREE)
        half = np.array(self.size) / 2
        add_solid(body, _GEOM.mjGEOM_BOX, WOOD, self.friction, size=half, **_FREE)
        if visual:
            bodies.crate(body, half)


@settings_class
class Ball(Object):
    """A football with rolling resistance. Coordinates and velocity as in `Box`."""

    radius: Length = 0.1
    """Radius, m."""
    mass: Mass = 0.318
    """Mass, kg."""
    damping: Damping = 0.1
    """Linear damping, N s/m."""
    angular_damping: Damping = 0.0003
    """Angular damping, N m s/rad."""

    @property
    def outline(self) -> Circle:
        return Circle(self.radius)

    def add(self, spec: mujoco.MjSpec, name: str, visual: bool) -> None:
        # A thin shell on three slides and a ball joint, as a free joint has only one damping.
        inertia = 2 / 3 * self.mass * self.radius**2
        body = add_body(spec, name, (0, 0, 0), self.mass, (inertia,) * 3)
        add_slides(body, "xyz", self.damping)
        _add_joint(body, "turn", _JOINT.mjJNT_BALL, self.angular_damping)
        white = (0.95, 0.95, 0.95, 1.0)
        add_solid(body, _GEOM.mjGEOM_SPHERE, white, size=(self.radius, 0, 0), **_FREE)
        if visual:
            bodies.football(body, self.radius)


@settings_class
class Cylinder(Object):
    """An upright cylinder that slides along y only, with the ground's friction.

    Coordinate: y, m; velocity likewise.
    """

    x: Coordinate = 1.6
    """X of the axis, m."""
    radius: Length = 1.2
    """Radius, m."""
    height: Length = 0.5
    """Height, m."""
    mass: Mass = 3.0
    """Mass, kg."""
    friction: Friction = 1.0
    """Sliding friction between cylinder and ground."""
    reach: Length = 1.8
    """Maximum |y|, m."""

    @property
    def outline(self) -> Circle:
        return Circle(self.radius)

    def add(self, spec: mujoco.MjSpec, name: str, visual: bool) -> None:
        body = add_body(spec, name, (self.x, 0.0, 0.0), self.mass, (1.0, 1.0, 1.0))
        _add_joint(
            body,
            "y",
            _JOINT.mjJNT_SLIDE,
            axis=_AXES["y"],
            frictionloss=self.friction * self.mass * GRAVITY,
            limited=True,
            range=(-self.reach, self.reach),
        )
        add_solid(
            body,
            _GEOM.mjGEOM_CAPSULE,
            WOOD,
            group=HIDDEN_GROUP,
            size=(self.radius, 0, 0),
            fromto=(0, 0, 0, 0, 0, self.height),
            **_HELD,
        )
        if visual:
            bodies.drum(body, self.radius, self.height)


@settings_class
class Door(Object):
    """A revolving door: a panel on a vertical hinge at its centre.

    Coordinate: angle, rad, 0 along y.
    """

    position: tuple[Coordinate, Coordinate] = (2.6, 0.0)
    """Position of the hinge (x, y), m."""
    size: Size = (0.08, 1.95, 0.8)
    """Thickness, width and height, m."""
    mass: Mass = 4.0
    """Mass, kg."""
    inertia: Mass = 1.232
    """Inertia about the hinge, kg m^2."""
    damping: Damping = 0.5
    """Damping of the hinge, N m s/rad."""

    @property
    def outline(self) -> Rectangle:
        return Rectangle(*self.size[:2])

    def add(self, spec: mujoco.MjSpec, name: str, visual: bool) -> None:
        place = (*self.position, self.size[2] / 2)
        body = add_body(spec, name, place, self.mass, (1.0, 0.5, self.inertia))
        _add_joint(body, "turn", _JOINT.mjJNT_HINGE, self.damping, axis=_AXES["z"])
        half = np.array(self.size) / 2
        add_solid(
            body,
            _GEOM.mjGEOM_BOX,
            WOOD,
            group=HIDDEN_GROUP if visual else 1,
            size=half,
            **_HELD,
        )
        if visual:
            bodies.door(body, half)


@settings_class
class Seesaw(Object):
    """A balanced plank on a hinge across the track.

    Coordinate: pitch, rad, negative with the near end down.
    """

    hinge: Vector = (5.6, 0.0, 0.545)
    """Position of the hinge (x, y, z), m."""
    size: Size = (4.123, 1.0, 0.03)
    """Length, width and thickness of the plank, m."""
    behind: Coordinate = 0.103
    """Distance of the plank's centre from the hinge, towards the near end, m."""
    mass: Mass = 100.0
    """Mass, kg; the centre of mass is at the hinge, so that the plank is in equilibrium at every
    angle."""
    inertia: Mass = 100.0
    """Inertia about the hinge, kg m^2."""
    limit: Length = 0.254
    """Maximum |angle|, rad; at the lower limit the near end is on the ground."""
    damping: Damping = 1000.0
    """Damping of the hinge, N m s/rad: a Go1 (111 N) at the far end, 1.9 m from it, turns it at
    0.21 rad/s."""

    def add(self, spec: mujoco.MjSpec, name: str, visual: bool) -> None:
        body = add_body(spec, name, self.hinge, self.mass, (self.inertia,) * 3)
        _add_joint(
            body,
            "pitch",
            _JOINT.mjJNT_HINGE,
            self.damping,
            axis=_AXES["y"],
            limited=True,
            range=(-self.limit, self.limit),
        )
        half = np.array(self.size) / 2
        add_solid(body, _GEOM.mjGEOM_BOX, WOOD, size=half, pos=(-self.behind, 0, 0), **_FLOOR)
        if visual:
            bodies.plank(body, half, -self.behind)
            bodies.trestle(spec.worldbody, self.hinge, half[1])


@settings_class
class Platform(Object):
    """A fixed block that supports robots. No coordinates."""

    center: Vector = (0.0, 0.0, 1.0)
    """Centre of the top face (x, y, z), m."""
    size: Size = (1.0, 1.0, 1.0)
    """Full extents, m."""
    column: Distance = 0.0
    """Radius of the supporting column, m; none if 0."""

    @property
    def outline(self) -> Circle | None:
        """The column."""
        return Circle(self.column) if self.column else None

    def add(self, spec: mujoco.MjSpec, name: str, visual: bool) -> None:
        x, y, top = self.center
        body = spec.worldbody.add_body(name=name, pos=(x, y, top - self.size[2] / 2))
        add_solid(body, _GEOM.mjGEOM_BOX, STONE, size=np.array(self.size) / 2, **_FLOOR)
        if not self.column:
            return
        foot = top - self.size[2]
        body.add_geom(
            name=f"{name}/column",
            type=_GEOM.mjGEOM_CAPSULE,
            group=HIDDEN_GROUP,
            mass=0.0,
            condim=3,
            priority=1,
            contype=WALL_BIT,
            conaffinity=0,
            size=(self.column, 0, 0),
            fromto=(0, 0, -top + self.size[2] / 2, 0, 0, -self.size[2] / 2 - self.column),
        )
        if visual:
            bodies.column(spec.worldbody, self.column, (x, y, foot))


@settings_class
class Ring(Object):
    """A circle marked on the ground, without collision geoms. No coordinates."""

    center: Vector = (0.0, 0.0, 0.0)
    """Centre (x, y, z), m."""
    radius: Length = 1.7
    """Radius, m."""
    width: Length = 0.04
    """Width of the line, m."""

    def add(self, spec: mujoco.MjSpec, name: str, visual: bool) -> None:
        body = spec.worldbody.add_body(name=name, pos=self.center)
        if visual:
            for part in circle((0.0, 0.0), self.radius, width=self.width):
                part.add(body)


@settings_class
class Sheep(Object):
    """An upright sheep that slides without friction or rotation (see `flock`).

    Coordinates: x, y; velocity likewise.
    """

    radius: Length = 0.2
    """Radius, m."""
    height: Length = 0.5
    """Height, m."""
    mass: Mass = 5.0
    """Mass, kg."""

    @property
    def outline(self) -> Circle:
        return Circle(self.radius)

    def add(self, spec: mujoco.MjSpec, name: str, visual: bool) -> None:
        # The capsule's lower end is below the ground, so it is cylindrical at ground level.
        body = add_body(spec, name, (0, 0, 0), self.mass, (0.1, 0.1, 0.1))
        add_slides(body, "xy")
        add_solid(
            body,
            _GEOM.mjGEOM_CAPSULE,
            STONE,
            group=HIDDEN_GROUP if visual else 1,
            size=(self.radius, 0, 0),
            fromto=(0, 0, 0, 0, 0, self.height - self.radius),
            **_HELD,
        )
        if visual:
            bodies.sheep(body, self.radius, self.height)
