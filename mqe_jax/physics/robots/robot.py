"""The `Robot` type: an immutable description of a quadruped with twelve joints.

All values are in SI units (metre, kilogram, second, radian, newton). Link frames have x forward, y
left and z up at zero joint angles. Legs are ordered FL, FR, RL, RR and joints hip, thigh, calf
everywhere in this package. One leg is described, the front left; the others are its mirror images.
"""

import dataclasses
import functools
from collections import Counter
from collections.abc import Sequence
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core.errors import InputError
from mqe_jax.physics.appearance import Color, mix

LEGS = ("FL", "FR", "RL", "RR")
JOINTS = ("hip", "thigh", "calf")
NUM_LEGS = len(LEGS)
NUM_JOINTS = NUM_LEGS * len(JOINTS)
JOINT_NAMES = tuple(f"{leg}_{joint}" for leg in LEGS for joint in JOINTS)
LINKS = ("trunk", *JOINTS)
# Body parts of collision shapes.
PARTS = ("trunk", "hip", "thigh", "calf", "foot")

# Sets of collision shapes: the whole body, or only trunk and feet.
CONTACTS: dict[str, tuple[str, ...]] = {"full": PARTS, "minimal": ("trunk", "foot")}

Vector = tuple[float, float, float]


class Mirror(NamedTuple):
    """The reflection of left and right of n values, such as those of the joints."""

    source: np.ndarray
    """Each value's counterpart on the other side (n,)."""
    sign: np.ndarray
    """Factor of the counterpart (n,), -1 or 1; -1 for hips."""

    def reflect(self, values: jax.Array) -> jax.Array:
        """Returns reflected values (..., n)."""
        return values[..., self.source] * self.sign


MIRROR = Mirror(
    source=np.arange(NUM_JOINTS).reshape(NUM_LEGS, -1)[[1, 0, 3, 2]].ravel(),
    sign=np.tile(np.array([-1.0, 1.0, 1.0], np.float32), NUM_LEGS),
)
"""The reflection of a quadruped's joints."""


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


@dataclasses.dataclass(frozen=True)
class Primitive:
    """A primitive in a link frame; on the right legs y is negated."""

    kind: Literal["sphere", "capsule", "cylinder", "box", "ellipsoid"]
    size: float | Vector
    """Radius of a sphere, capsule or cylinder; half-lengths (3,) of a box or ellipsoid, m."""
    position: Vector = (0.0, 0.0, 0.0)
    """Centre, or first end of a capsule's or cylinder's axis, m."""
    end: Vector | None = None
    """Second end of the axis, m; None for the other kinds."""


sphere = functools.partial(Primitive, "sphere")
capsule = functools.partial(Primitive, "capsule")
cylinder = functools.partial(Primitive, "cylinder")
box = functools.partial(Primitive, "box")
ellipsoid = functools.partial(Primitive, "ellipsoid")


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

    @property
    def geom_names(self) -> tuple[str, ...]:
        """Names of its geoms in the model of one robot, without the robot's prefix."""
        return (self.name,) if self.part == "trunk" else tuple(f"{leg}_{self.name}" for leg in LEGS)


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

    def mix_color(self, agent_color: Color) -> Color:
        """Returns the base colour mixed with the agent's colour."""
        return mix(self.color, agent_color, self.tint)


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
    """A quadruped; make a variant with `dataclasses.replace`.

    Arrays (12,) are in the order of `joint_names`.

    Example:
        ```python
        from mqe_jax.physics import robots

        print(robots.get("go2").stall_torque[:3])  # of hip, thigh and calf, N m
        ```
    """

    name: str
    """Short name, as in the registry."""
    title: str
    """Full name."""
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
    foot_radius: float
    """Radius of the foot, m."""
    default_joints: np.ndarray
    """Default joint angles: the targets of zero joint actions (12,), rad."""
    joint_lower: np.ndarray
    """Lower joint limits (12,), rad."""
    joint_upper: np.ndarray
    """Upper joint limits (12,), rad."""
    joint_speed_limit: np.ndarray
    """Speed limits of the motors (12,), rad/s (`mqe_jax.physics.robots.motors`)."""
    torque_limit: np.ndarray
    """Torque limits of the controller (12,), N m."""
    stall_torque: np.ndarray
    """Torques of the motors at rest (12,), N m; they fall linearly to zero at the speed limit."""
    rotor_inertia: np.ndarray
    """Inertia of the rotors at the joints (12,), kg m^2; simulated where `joint_mechanics` is
    set."""
    joint_damping: np.ndarray
    """Viscous friction of the joints (12,), N m s/rad; likewise."""
    friction_loss: np.ndarray
    """Dry friction of the joints (12,), N m; likewise."""
    joint_margin: float
    """Distance before a joint limit at which its constraint begins, rad: a joint at its motor's
    speed limit passes the limit by up to 0.25 rad within a physics step. A stiffer constraint needs
    more solver iterations."""
    kp: float
    """Proportional gain, N m/rad."""
    kd: float
    """Derivative gain, N m s/rad."""
    action_scale: np.ndarray
    """Scale of joint actions (12,), rad: joint target = default + scale x action."""
    stand_height: float
    """Height of the trunk origin at the default angles, m; the walk policy's target at a zero
    height command."""
    collision: tuple[CollisionShape, ...]
    visuals: tuple[VisualShape, ...]
    walk: WalkSettings

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
        counts = Counter(shape.name for shape in self.collision)
        repeated = [name for name, count in counts.items() if count > 1]
        if repeated:
            raise InputError(f"Robot.collision: duplicate names {', '.join(repeated)}")
        parts = [shape.part for shape in self.collision]
        if parts.count("foot") != 1 or "trunk" not in parts:
            raise InputError("Robot.collision: needs one foot shape and at least one trunk shape")

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints, in the order of all arrays."""
        return JOINT_NAMES

    @property
    def num_joints(self) -> int:
        """Number of joints J."""
        return len(self.joint_names)

    @property
    def mirror(self) -> Mirror:
        """The reflection of left and right."""
        return MIRROR

    def joint_targets(self, action: jax.Array, scale: float = 1.0) -> jax.Array:
        """Returns joint targets (..., 12), rad, of actions (..., 12).

        They are default + `scale` x the robot's scale x action.
        """
        return jnp.asarray(self.default_joints) + scale * self.action_scale * action

    def shapes(self, contacts: str = "full") -> tuple[CollisionShape, ...]:
        """Returns the collision shapes of a set, one of `CONTACTS`; InputError for another name."""
        if contacts not in CONTACTS:
            raise InputError(f"contacts: unknown set {contacts!r}; allowed: {', '.join(CONTACTS)}")
        return tuple(shape for shape in self.collision if shape.part in CONTACTS[contacts])
