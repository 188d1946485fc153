"""The `Robot` type: an immutable description of a robot with a free base and J joints.

All values are in SI units (metre, kilogram, second, radian, newton). The trunk's frame has x
forward, y left and z up. `mqe_jax.physics.robots.quadruped` describes one by the links of a leg,
`mqe_jax.physics.robots.mjcf` reads one from an MJCF; both fill the same body tree.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mqe_jax.core.errors import InputError
from mqe_jax.physics.appearance import Color, mix

GO1_HEIGHT = 0.30
"""Height of a standing Go1's trunk, m."""
TRUNK = "trunk"
"""Name of the first body, and part of its collision shapes."""
BASE = "base"
"""Name of the first body's free joint."""
FOOT = "foot"
"""Part of the feet's collision shapes."""
CONTACTS = ("full", "minimal")
"""Sets of collision shapes: the whole body, or only trunk and feet."""

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class Mirror(NamedTuple):
    """The reflection of left and right of n values, such as those of the joints."""

    source: np.ndarray
    """Each value's counterpart on the other side (n,)."""
    sign: np.ndarray
    """Factor of the counterpart (n,), -1 or 1; -1 for hips."""

    def reflect(self, values: jax.Array) -> jax.Array:
        """Returns reflected values (..., n)."""
        return values[..., self.source] * self.sign


@dataclasses.dataclass(frozen=True)
class Link:
    """Inertial parameters of one rigid link."""

    mass: float
    """Mass, kg."""
    com: Vector
    """Centre of mass in the link frame (3,), m."""
    inertia: tuple[float, float, float, float, float, float]
    """Inertia (xx, yy, zz, xy, xz, yz) about the centre of mass, in the axes of the link frame, kg
    m^2."""

    @classmethod
    def from_principal(
        cls, mass: float, com: Vector, moments: Vector, quaternion: Sequence[float]
    ) -> "Link":
        """Returns a link from its principal moments of inertia, kg m^2.

        `quaternion`, wxyz, is the orientation of their axes.
        """
        w, x, y, z = np.asarray(quaternion) / np.linalg.norm(quaternion)
        axes = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        return cls(mass, com, _six(axes @ np.diag(moments) @ axes.T))

    def reflect(self, x: int, y: int) -> "Link":
        """Returns the link reflected by the signs `x` and `y` (each 1 or -1)."""
        xx, yy, zz, xy, xz, yz = self.inertia
        cx, cy, cz = self.com
        return Link(self.mass, (x * cx, y * cy, cz), (xx, yy, zz, x * y * xy, x * xz, y * yz))

    def matrix(self) -> np.ndarray:
        """Returns the inertia tensor about the centre of mass (3, 3), kg m^2."""
        xx, yy, zz, xy, xz, yz = self.inertia
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])

    def weld(self, other: "Link", position: Vector) -> "Link":
        """Returns this link with `other` fixed to it at `position` (m, link frame, same axes)."""
        mass = self.mass + other.mass
        centers = (np.asarray(self.com), np.asarray(position) + np.asarray(other.com))
        com = (self.mass * centers[0] + other.mass * centers[1]) / mass
        tensor = np.zeros((3, 3))
        for link, center in zip((self, other), centers, strict=True):
            arm = center - com
            tensor += link.matrix() + link.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
        return Link(mass, (float(com[0]), float(com[1]), float(com[2])), _six(tensor))


def _six(tensor: np.ndarray) -> tuple[float, float, float, float, float, float]:
    xx, yy, zz, xy, xz, yz = tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]].tolist()
    return xx, yy, zz, xy, xz, yz


@dataclasses.dataclass(frozen=True, eq=False)
class Mesh:
    """The surface of a mesh in its own frame."""

    vertices: np.ndarray
    """Vertices (V, 3), m."""
    faces: np.ndarray
    """Indices of the vertices of its triangles (F, 3)."""


@dataclasses.dataclass(frozen=True)
class Primitive:
    """A primitive in a link frame, or a mesh, which is only drawn."""

    kind: Literal["sphere", "capsule", "cylinder", "box", "ellipsoid", "mesh"]
    size: float | Vector
    """Radius of a sphere, capsule or cylinder; half-lengths (3,) of a box or ellipsoid, m."""
    position: Vector = (0.0, 0.0, 0.0)
    """Centre, or first end of a capsule's or cylinder's axis, m."""
    end: Vector | None = None
    """Second end of the axis, m; None for the other kinds."""
    quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """Orientation, wxyz, of the kinds without an axis."""
    mesh: Mesh | None = None
    """Surface of a mesh."""

    def reflect(self) -> "Primitive":
        """Returns a primitive without orientation with y negated."""
        end = None if self.end is None else (self.end[0], -1 * self.end[1], self.end[2])
        x, y, z = self.position
        return dataclasses.replace(self, position=(x, -1 * y, z), end=end)

    @property
    def top(self) -> float:
        """Height of its highest point above the link's origin, m; exact if it is upright."""
        if self.mesh is not None:
            rows = np.zeros(9)
            mujoco.mju_quat2Mat(rows, np.array(self.quaternion))
            return float((self.mesh.vertices @ rows[6:]).max()) + self.position[2]
        end = self.end or self.position
        return max(self.position[2], end[2]) + float(np.atleast_1d(self.size)[-1])


sphere = functools.partial(Primitive, "sphere")
capsule = functools.partial(Primitive, "capsule")
cylinder = functools.partial(Primitive, "cylinder")
box = functools.partial(Primitive, "box")
ellipsoid = functools.partial(Primitive, "ellipsoid")


class Hinge(NamedTuple):
    """A hinge of a body, in the body's frame."""

    name: str
    axis: Vector
    position: Vector = (0.0, 0.0, 0.0)
    """A point of the axis, m."""


class Proportions(NamedTuple):
    """Sizes of a robot's body, as factors on those of the Go1."""

    height: float = 1.0
    """Of the standing trunk."""
    width: float = 1.0
    """Of all of the body."""
    length: float = 1.0
    """Likewise."""
    mass: float = 1.0


class Shape(NamedTuple):
    """A collision shape of a body."""

    name: str
    """Unique in the robot."""
    part: str
    """`TRUNK`, `FOOT`, or any other text."""
    primitive: Primitive


class Look(NamedTuple):
    """A massless, non-colliding shape of a body for rendering."""

    primitive: Primitive
    color: Color
    """Base colour."""
    tint: float = 0.0
    """Fraction of the agent's colour mixed into the base colour, in [0, 1]."""

    def mix_color(self, agent_color: Color) -> Color:
        """Returns the base colour mixed with the agent's colour."""
        return mix(self.color, agent_color, self.tint)


@dataclasses.dataclass(frozen=True)
class Body:
    """A rigid body of a robot, in the frame of its parent at zero joint angles."""

    name: str
    """Unique in the robot; that of the first is `TRUNK`."""
    parent: str
    """Name of a body before it; empty for the first."""
    position: Vector
    """Origin, m."""
    link: Link
    hinges: tuple[Hinge, ...] = ()
    """Its joints, which turn it in this order; the trunk has none."""
    shapes: tuple[Shape, ...] = ()
    looks: tuple[Look, ...] = ()
    quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """Orientation, wxyz."""


@dataclasses.dataclass(frozen=True)
class WalkSettings:
    """Settings of the walk policy and its training that depend on the robot."""

    weights: str
    """Robot whose shipped weights it uses: `mqe_jax/assets/SKILL_ROBOT.safetensors`."""
    stance_width: float
    """Default distance between left and right feet, m."""
    stance_length: float
    """Default distance between front and rear feet, m."""
    min_knee_height: float
    """Minimum knee height, m; below it the leg is counted as touching the ground with thigh or
    calf."""
    min_trunk_height: float
    """Minimum height of the trunk origin, m; below it the robot has fallen."""


@dataclasses.dataclass(frozen=True, eq=False)
class Robot:
    """A robot; make a variant with `dataclasses.replace`.

    Arrays (J,) are in the order of `joint_names`.

    Example:
        ```python
        from mqe_jax.physics import robots

        print(robots.get("go2").stall_torque[:3])  # of hip, thigh and calf, N m
        ```
    """

    _: dataclasses.KW_ONLY
    name: str
    """Short name, as in the registry."""
    title: str
    """Full name."""
    default_joints: np.ndarray
    """Default joint angles: the targets of zero joint actions (J,), rad."""
    joint_lower: np.ndarray
    """Lower joint limits (J,), rad."""
    joint_upper: np.ndarray
    """Upper joint limits (J,), rad."""
    joint_speed_limit: np.ndarray
    """Speed limits of the motors (J,), rad/s (`mqe_jax.physics.robots.motors`)."""
    torque_limit: np.ndarray
    """Torque limits of the controller (J,), N m."""
    stall_torque: np.ndarray
    """Torques of the motors at rest (J,), N m; they fall linearly to zero at the speed limit."""
    rotor_inertia: np.ndarray
    """Inertia of the rotors at the joints (J,), kg m^2; simulated where `joint_mechanics` is
    set."""
    joint_damping: np.ndarray
    """Viscous friction of the joints (J,), N m s/rad; likewise."""
    friction_loss: np.ndarray
    """Dry friction of the joints (J,), N m; likewise."""
    joint_margin: float
    """Distance before a joint limit at which its constraint begins, rad: a joint at its motor's
    speed limit passes the limit by up to 0.25 rad within a physics step. A stiffer constraint needs
    more solver iterations."""
    kp: float
    """Proportional gain, N m/rad."""
    kd: float
    """Derivative gain, N m s/rad."""
    action_scale: np.ndarray
    """Scale of joint actions (J,), rad: joint target = default + scale x action."""
    foot_radius: float
    """Radius of the foot, m."""
    stand_height: float
    """Height of the trunk origin at the default angles, m; the walk policy's target at a zero
    height command."""
    walk: WalkSettings
    digest: str = ""
    """SHA-256 of the files that the robot was read from; empty without any."""
    source: str = ""
    """File that the robot was read from; empty without one."""
    notes: tuple[str, ...] = ()
    """What its files leave open, and what is used instead, a line each."""

    def __post_init__(self) -> None:
        for name in (field.name for field in dataclasses.fields(self) if field.type is np.ndarray):
            array = np.array(getattr(self, name), float)
            if array.shape != (self.num_joints,):
                raise InputError(
                    f"Robot.{name}: shape {array.shape}; expected ({self.num_joints},)"
                )
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        above = self.joint_lower < self.default_joints
        below = self.default_joints < self.joint_upper
        if not np.all(above & below):
            raise InputError(
                f"Robot.default_joints: {self.default_joints} must lie between the joint limits"
            )

    # Defined by each kind:

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints, in the order of all arrays."""
        raise NotImplementedError

    @property
    def tree(self) -> tuple[Body, ...]:
        """Its bodies, each after its parent; the first is the trunk."""
        raise NotImplementedError

    @property
    def mirror(self) -> Mirror:
        """The reflection of left and right."""
        raise NotImplementedError

    @property
    def limb(self) -> int:
        """Number of joints of each limb, if all limbs are alike and follow each other.

        Otherwise J.
        """
        raise NotImplementedError

    @property
    def radius(self) -> float:
        """Radius about the trunk's origin of the circle that stands for the robot to sensors, m."""
        raise NotImplementedError

    def foot_positions(self, joint_position: jax.Array) -> jax.Array:
        """Computes the feet's centres (..., F, 3), m, in the trunk frame, of angles (..., J)."""
        raise NotImplementedError

    def knee_positions(self, joint_position: jax.Array) -> jax.Array:
        """Computes the origins (..., F, 3) of the bodies that the last joint of a leg moves."""
        raise NotImplementedError

    @property
    def proportions(self) -> Proportions:
        """Sizes that tasks and the training of skills follow; those shipped are as the Go1."""
        return Proportions()

    # Common to all:

    @property
    def num_joints(self) -> int:
        """Number of joints J."""
        return len(self.joint_names)

    @property
    def call(self) -> str:
        """What the parameter `robot` accepts for it: its file, or its name."""
        return self.source or self.name

    @property
    def identity(self) -> str:
        """Its name, and the digest of its files if it was read from any."""
        return f"{self.name}@{self.digest[:16]}" if self.digest else self.name

    @property
    def body_names(self) -> tuple[str, ...]:
        """Names of its bodies, the trunk first."""
        return tuple(body.name for body in self.tree)

    def geom_names(self, *parts: str) -> tuple[str, ...]:
        """Returns the names of collision shapes, all or those of some parts."""
        shapes = [shape for body in self.tree for shape in body.shapes]
        return tuple(shape.name for shape in shapes if not parts or shape.part in parts)

    def joint_targets(self, action: jax.Array, scale: float = 1.0) -> jax.Array:
        """Returns joint targets (..., J), rad, of actions (..., J).

        They are default + `scale` x the robot's scale x action.
        """
        return jnp.asarray(self.default_joints) + scale * self.action_scale * action


def parts_of(contacts: str) -> tuple[str, ...]:
    """Returns the parts of a set of collision shapes, one of `CONTACTS`; () for all.

    InputError for another name.
    """
    if contacts not in CONTACTS:
        raise InputError(f"contacts: unknown set {contacts!r}; allowed: {', '.join(CONTACTS)}")
    return (TRUNK, FOOT) if contacts == "minimal" else ()
