"""The MuJoCo body tree of a robot."""

from __future__ import annotations

import dataclasses
from typing import Any

import mujoco

from mqe_jax.collision import GROUND_BIT, OBJECT_BIT, WALL_BIT, robot_bit
from mqe_jax.errors import InputError
from mqe_jax.robots.robot import JOINT_NAMES, JOINTS, LEGS, PARTS, Color, Link, Primitive, Robot

# Robot colours by agent: 1 blue, 2 green, 3 red, 4 orange.
COLORS: tuple[Color, ...] = (
    (0.13, 0.59, 0.95, 1.0),
    (0.36, 0.80, 0.26, 1.0),
    (0.93, 0.28, 0.20, 1.0),
    (0.98, 0.60, 0.12, 1.0),
)

_GEOM_TYPES = {
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID,
}


@dataclasses.dataclass(frozen=True)
class Contacts:
    """Which parts of a robot touch what; every further pair costs time on every engine.

    Attributes:
        ground: parts that touch floors, ramps and platforms.
        wall: parts that touch walls and gates.
        robot: parts that touch the `robot_target` parts of other robots.
        object: parts that touch movable objects and NPCs.
        robot_target: parts that the `robot` parts of other robots touch. Both with all parts: full contact.
    """

    ground: tuple[str, ...] = ("trunk", "foot")
    wall: tuple[str, ...] = ("trunk", "foot")
    robot: tuple[str, ...] = ("trunk", "foot", "calf")
    object: tuple[str, ...] = ("trunk", "foot", "calf")
    robot_target: tuple[str, ...] = ("trunk",)

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            for part in getattr(self, field.name):
                if part not in PARTS:
                    raise InputError(f"Contacts.{field.name}: unknown part {part!r}; allowed: {', '.join(PARTS)}")

    def parts(self) -> tuple[str, ...]:
        """Returns the parts that need a collision shape, in the order of `PARTS`."""
        used = {*self.ground, *self.wall, *self.robot, *self.object}
        used |= set(self.robot_target) if self.robot else set()
        return tuple(part for part in PARTS if part in used)


def _collision_bits(part: str, robot: int, num_robots: int, contacts: Contacts) -> tuple[int, int]:
    """Returns (contype, conaffinity) of one part of one robot."""
    affinity = 0
    affinity |= GROUND_BIT if part in contacts.ground else 0
    affinity |= WALL_BIT if part in contacts.wall else 0
    affinity |= OBJECT_BIT if part in contacts.object else 0
    if part in contacts.robot:
        affinity |= sum(robot_bit(other) for other in range(num_robots) if other != robot)
    return robot_bit(robot) if contacts.robot and part in contacts.robot_target else 0, affinity


def _add_inertial(body: Any, link: Link) -> None:
    body.explicitinertial = True
    body.mass = link.mass
    body.ipos = link.com
    body.fullinertia = link.inertia


def _add_geom(body: Any, primitive: Primitive, left: int, **properties: Any) -> None:
    """Adds a primitive to the body of a link, with y negated where `left` is -1."""
    x, y, z = primitive.position
    place: dict[str, Any] = {"pos": (x, left * y, z)}
    if primitive.end is not None:
        place = {"fromto": (x, left * y, z, primitive.end[0], left * primitive.end[1], primitive.end[2])}
    size = (*primitive.size, 0.0, 0.0)[:3]
    body.add_geom(type=_GEOM_TYPES[primitive.kind], size=size, mass=0.0, **place, **properties)


def build_robot(
    robot: Robot,
    number: int,
    num_robots: int,
    contacts: Contacts,
    *,
    visual: bool = True,
    friction: float = 1.0,
    torque_control: bool = False,
    color: int | None = None,
) -> mujoco.MjSpec:
    """Builds one robot with a free base as an `MjSpec`, to be attached to a scene under a prefix.

    Args:
        robot: which one.
        number: its place among the robots of the scene, for its collision bits.
        num_robots: robots in the scene.
        contacts: which parts touch what.
        visual: whether to add the visual geoms.
        friction: sliding friction of its shapes, which takes precedence over the other shape's.
        torque_control: actuators take torques (N m) instead of PD joint targets (rad).
        color: index of its colour in `COLORS`; `number` if None.
    """
    agent_color = COLORS[(number if color is None else color) % len(COLORS)]
    shapes = robot.shapes(contacts.parts())
    spec = mujoco.MjSpec()
    spec.compiler.degree = False

    def add_shapes(body: Any, link: str, leg: str, left: int) -> None:
        for shape in shapes:
            if shape.link == link:
                contype, conaffinity = _collision_bits(shape.part, number, num_robots, contacts)
                _add_geom(
                    body,
                    shape.primitive,
                    left,
                    name=f"{leg}{shape.name}",
                    contype=contype,
                    conaffinity=conaffinity,
                    group=3,
                    condim=3,
                    priority=2,
                    friction=(friction, 0.005, 0.0001),
                    rgba=(0.9, 0.3, 0.3, 0.4),
                )
        for visual_shape in robot.visuals if visual else ():
            if visual_shape.link == link:
                rgba = visual_shape.tinted(agent_color)
                _add_geom(body, visual_shape.primitive, left, rgba=rgba, contype=0, conaffinity=0, group=2)

    trunk = spec.worldbody.add_body(name="trunk", pos=(0.0, 0.0, robot.stand_height))
    trunk.add_freejoint(name="base")
    _add_inertial(trunk, robot.trunk)
    add_shapes(trunk, "trunk", "", 1)
    for leg in LEGS:
        front = 1 if leg[0] == "F" else -1
        left = 1 if leg[1] == "L" else -1
        hip = trunk.add_body(name=f"{leg}_hip", pos=(front * robot.leg_root[0], left * robot.leg_root[1], 0.0))
        _add_inertial(hip, robot.hip.mirrored(front, left))
        thigh = hip.add_body(name=f"{leg}_thigh", pos=(0.0, left * robot.hip_length, 0.0))
        _add_inertial(thigh, robot.thigh.mirrored(1, left))
        calf = thigh.add_body(name=f"{leg}_calf", pos=(0.0, 0.0, -robot.thigh_length))
        _add_inertial(calf, robot.calf.mirrored(1, left))
        for body, joint, axis in zip((hip, thigh, calf), JOINTS, ((1, 0, 0), (0, 1, 0), (0, 1, 0)), strict=True):
            index = JOINT_NAMES.index(f"{leg}_{joint}")
            limits = (robot.joint_lower[index], robot.joint_upper[index])
            hinge = mujoco.mjtJoint.mjJNT_HINGE
            body.add_joint(name=f"{leg}_{joint}", type=hinge, axis=axis, limited=True, range=limits)
            add_shapes(body, joint, f"{leg}_", left)
    gain, bias = (1.0, (0.0, 0.0, 0.0)) if torque_control else (robot.kp, (0.0, -robot.kp, -robot.kd))
    for name, limit in zip(JOINT_NAMES, robot.torque_limit, strict=True):
        actuator = spec.add_actuator(
            name=name,
            target=name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            forcelimited=True,
            forcerange=(-limit, limit),
        )
        actuator.gainprm[0] = gain
        actuator.biasprm[:3] = bias
    return spec
