"""The `Quadruped` type: a robot of four legs with three joints each, described by one leg.

Link frames have x forward, y left and z up at zero joint angles. Legs are ordered FL, FR, RL, RR
and joints hip, thigh, calf. One leg is described, the front left; the others are its mirror images.
"""

import dataclasses
from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core.errors import InputError
from mqe_jax.physics.appearance import Color
from mqe_jax.physics.robots.robot import (
    FOOT,
    TRUNK,
    Body,
    Hinge,
    Link,
    Look,
    Mirror,
    Primitive,
    Robot,
    Shape,
)

LEGS = ("FL", "FR", "RL", "RR")
JOINTS = ("hip", "thigh", "calf")
NUM_LEGS = len(LEGS)
NUM_JOINTS = NUM_LEGS * len(JOINTS)
JOINT_NAMES = tuple(f"{leg}_{joint}" for leg in LEGS for joint in JOINTS)
LINKS = ("trunk", *JOINTS)
# Body parts of collision shapes.
PARTS = ("trunk", "hip", "thigh", "calf", "foot")

MIRROR = Mirror(
    source=np.arange(NUM_JOINTS).reshape(NUM_LEGS, -1)[[1, 0, 3, 2]].ravel(),
    sign=np.tile(np.array([-1.0, 1.0, 1.0], np.float32), NUM_LEGS),
)
"""The reflection of a quadruped's joints."""


@dataclasses.dataclass(frozen=True)
class CollisionShape:
    """A collision shape: one geom on the trunk, or one on each leg."""

    part: str
    """Part that the shape belongs to: one of `PARTS`."""
    primitive: Primitive
    """Its geometry, in the frame of `link`."""
    name: str = ""
    """Unique in the robot; the part's name if empty. A leg's shapes are called `FL_<name>` and so
    on."""

    def __post_init__(self) -> None:
        if self.part not in PARTS:
            raise InputError(
                f"CollisionShape.part: unknown part {self.part!r}; allowed: {', '.join(PARTS)}"
            )
        if not self.name:
            object.__setattr__(self, "name", self.part)

    @property
    def link(self) -> str:
        """Link of the shape: the calf of a foot."""
        return "calf" if self.part == "foot" else self.part


@dataclasses.dataclass(frozen=True)
class VisualShape:
    """A massless, non-colliding shape for rendering."""

    link: str
    """Link that the shape is fixed to: trunk, hip, thigh or calf."""
    primitive: Primitive
    """Its geometry, in the frame of `link`."""
    color: Color = (0.0, 0.0, 0.0, 1.0)
    """Base colour."""
    tint: float = 0.0
    """Fraction of the agent's colour mixed into the base colour, in [0, 1]."""
    both: bool = False
    """Whether its mirror image is on the right side of the trunk too."""

    def __post_init__(self) -> None:
        if self.link not in LINKS:
            raise InputError(
                f"VisualShape.link: unknown link {self.link!r}; allowed: {', '.join(LINKS)}"
            )


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Quadruped(Robot):
    """A quadruped with twelve joints, described by its front left leg."""

    trunk: Link
    hip: Link
    """The front left hip; y is mirrored for the right legs, x for the rear ones."""
    thigh: Link
    """The front left thigh; y is mirrored for the right legs."""
    calf: Link
    """The front left calf with its foot; y is mirrored for the right legs."""
    leg_root: tuple[float, float]
    """Hip joint of the front left leg in the trunk frame (x, y), m."""
    hip_length: float
    """Distance from hip joint to thigh joint, outward, m."""
    thigh_length: float
    """Distance from thigh joint to calf joint, downward, m."""
    foot_position: tuple[float, float]
    """Centre of the foot in the calf frame (x, z), m."""
    collision: tuple[CollisionShape, ...]
    visuals: tuple[VisualShape, ...]

    def __post_init__(self) -> None:
        super().__post_init__()
        counts = Counter(shape.name for shape in self.collision)
        repeated = [name for name, count in counts.items() if count > 1]
        if repeated:
            raise InputError(f"Robot.collision: duplicate names {', '.join(repeated)}")
        parts = [shape.part for shape in self.collision]
        if parts.count(FOOT) != 1 or TRUNK not in parts:
            raise InputError("Robot.collision: needs one foot shape and at least one trunk shape")

    @property
    def joint_names(self) -> tuple[str, ...]:
        return JOINT_NAMES

    @property
    def mirror(self) -> Mirror:
        return MIRROR

    @property
    def limb(self) -> int:
        return len(JOINTS)

    @property
    def radius(self) -> float:
        """Distance of the hips from the trunk's origin, m."""
        return float(np.hypot(*self.leg_root))

    @property
    def tree(self) -> tuple[Body, ...]:
        bodies = [self._body(TRUNK, "", (0.0, 0.0, self.stand_height), self.trunk, "", 1)]
        for leg in LEGS:
            front = 1 if leg[0] == "F" else -1
            left = 1 if leg[1] == "L" else -1
            root = (front * self.leg_root[0], left * self.leg_root[1], 0.0)
            places = (root, (0.0, left * self.hip_length, 0.0), (0.0, 0.0, -self.thigh_length))
            links = (
                self.hip.reflect(front, left),
                self.thigh.reflect(1, left),
                self.calf.reflect(1, left),
            )
            parent = TRUNK
            for joint, place, link in zip(JOINTS, places, links, strict=True):
                bodies.append(self._body(joint, parent, place, link, f"{leg}_", left))
                parent = bodies[-1].name
        return tuple(bodies)

    def _body(
        self,
        part: str,
        parent: str,
        position: tuple[float, float, float],
        link: Link,
        leg: str,
        left: int,
    ) -> Body:
        """Returns the body of a link, on the left side (1) or mirrored (-1)."""

        def place(primitive: Primitive, side: int) -> Primitive:
            return primitive if side > 0 else primitive.reflect()

        name = f"{leg}{part}"
        axis = (1.0, 0.0, 0.0) if part == "hip" else (0.0, 1.0, 0.0)
        return Body(
            name=name,
            parent=parent,
            position=position,
            link=link,
            hinges=(Hinge(name, axis),) if parent else (),
            shapes=tuple(
                Shape(f"{leg}{shape.name}", shape.part, place(shape.primitive, left))
                for shape in self.collision
                if shape.link == part
            ),
            looks=tuple(
                Look(place(shape.primitive, side), shape.color, shape.tint)
                for shape in self.visuals
                if shape.link == part
                for side in ((left, -left) if shape.both else (left,))
            ),
        )

    def foot_positions(self, joint_position: jax.Array) -> jax.Array:
        return self._leg_points(joint_position, self.foot_position)

    def knee_positions(self, joint_position: jax.Array) -> jax.Array:
        return self._leg_points(joint_position, (0.0, 0.0))

    def _leg_points(self, joint_position: jax.Array, point: tuple[float, float]) -> jax.Array:
        """Computes a point (x, z) of each calf frame, m, in the trunk frame (..., 4, 3), m."""
        angles = joint_position.reshape(*joint_position.shape[:-1], NUM_LEGS, 3)
        hip, thigh, calf = jnp.moveaxis(angles, -1, 0)
        front = jnp.array([1.0, 1.0, -1.0, -1.0])
        left = jnp.array([1.0, -1.0, 1.0, -1.0])
        ahead, up = point
        x = -self.thigh_length * jnp.sin(thigh) + up * jnp.sin(thigh + calf)
        z = -self.thigh_length * jnp.cos(thigh) + up * jnp.cos(thigh + calf)
        if ahead:
            x += ahead * jnp.cos(thigh + calf)
            z -= ahead * jnp.sin(thigh + calf)
        y = left * self.hip_length
        x_trunk = front * self.leg_root[0] + x
        y_trunk = left * self.leg_root[1] + y * jnp.cos(hip) - z * jnp.sin(hip)
        z_trunk = y * jnp.sin(hip) + z * jnp.cos(hip)
        return jnp.stack([x_trunk, y_trunk, z_trunk], axis=-1)
