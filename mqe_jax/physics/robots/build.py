"""The MuJoCo body tree of a robot."""

from typing import Any

import mujoco
import numpy as np

from mqe_jax.physics.appearance import HIDDEN_GROUP, ROBOT_COLORS, VISUAL_GROUP, bodies
from mqe_jax.physics.collision import robot_bits
from mqe_jax.physics.robots.robot import JOINT_NAMES, JOINTS, LEGS, Link, Primitive, Robot

_GEOM_TYPES = {
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID,
}


# Contact settings of the robots' collision geoms, which take precedence over those of the other
# geom. SOLREF is a time constant, s, which joint limits share, and a damping ratio. The time
# constant is the shortest that is stable at a physics step of 0.005 s. Contacts begin MARGIN before
# the surfaces meet: a foot that lands at 1.5 m/s moves 7.5 mm in a physics step.
SOLREF = (0.01, 1.0)
SOLIMP = (0.9, 0.95, 0.001, 0.5, 2.0)
MARGIN = 0.003  # m


def _add_inertial(body: Any, link: Link) -> None:
    body.explicitinertial = True
    body.mass = link.mass
    body.ipos = link.com
    body.fullinertia = link.inertia


def _add_geom(body: Any, primitive: Primitive, left: int, **properties: Any) -> None:
    """Adds a primitive to the body of a link, with y negated if `left` is -1."""
    x, y, z = primitive.position
    place: dict[str, Any] = {"pos": (x, left * y, z)}
    if primitive.end is not None:
        end_x, end_y, end_z = primitive.end
        place = {"fromto": (x, left * y, z, end_x, left * end_y, end_z)}
    size = (*np.atleast_1d(primitive.size), 0.0, 0.0)[:3]
    body.add_geom(type=_GEOM_TYPES[primitive.kind], size=size, mass=0.0, **place, **properties)


def _back(robot: Robot) -> float:
    """Returns the height of the highest visual shape of the trunk above the trunk's origin, m."""

    def top(shape: Primitive) -> float:
        end = shape.end or shape.position
        return max(shape.position[2], end[2]) + np.atleast_1d(shape.size)[-1]

    return max(top(shape.primitive) for shape in robot.visuals if shape.link == "trunk")


def build_robot(
    robot: Robot,
    number: int,
    *,
    contacts: str = "full",
    visual: bool = True,
    friction: float = 1.0,
    torque_control: bool = False,
    joint_mechanics: bool = False,
    color: int | None = None,
    numbered: bool = False,
) -> mujoco.MjSpec:
    """Builds one robot with a free base as an `MjSpec`, to be attached to a scene under a prefix.

    `number` is its index in the scene, for its collision bits and, without `color`, its colour in
    `ROBOT_COLORS`. The others are those of `Scene`; with `torque_control` actuators take torques (N
    m) instead of joint targets (rad). If `numbered`, the index + 1 is on its back.
    """
    agent_color = ROBOT_COLORS[(number if color is None else color) % len(ROBOT_COLORS)]
    shapes = robot.shapes(contacts)
    contype, conaffinity = robot_bits(number)
    spec = mujoco.MjSpec()
    spec.compiler.degree = False

    def add_shapes(body: Any, link: str, leg: str, left: int) -> None:
        for shape in shapes:
            if shape.link == link:
                _add_geom(
                    body,
                    shape.primitive,
                    left,
                    name=f"{leg}{shape.name}",
                    contype=contype,
                    conaffinity=conaffinity,
                    group=HIDDEN_GROUP,
                    condim=3,
                    priority=2,
                    friction=(friction, 0.005, 0.0001),
                    solref=SOLREF,
                    solimp=SOLIMP,
                    margin=MARGIN,
                    rgba=(0.9, 0.3, 0.3, 0.4),
                )
        for visual_shape in robot.visuals if visual else ():
            if visual_shape.link == link:
                for side in (left, -left) if visual_shape.both else (left,):
                    _add_geom(
                        body,
                        visual_shape.primitive,
                        side,
                        contype=0,
                        conaffinity=0,
                        rgba=visual_shape.mix_color(agent_color),
                        group=VISUAL_GROUP,
                    )

    trunk = spec.worldbody.add_body(name="trunk", pos=(0.0, 0.0, robot.stand_height))
    trunk.add_freejoint(name="base")
    _add_inertial(trunk, robot.trunk)
    add_shapes(trunk, "trunk", "", 1)
    if visual and numbered:
        bodies.back_number(trunk, number + 1, _back(robot))
    for leg in LEGS:
        front = 1 if leg[0] == "F" else -1
        left = 1 if leg[1] == "L" else -1
        root = (front * robot.leg_root[0], left * robot.leg_root[1], 0.0)
        hip = trunk.add_body(name=f"{leg}_hip", pos=root)
        _add_inertial(hip, robot.hip.reflect(front, left))
        thigh = hip.add_body(name=f"{leg}_thigh", pos=(0.0, left * robot.hip_length, 0.0))
        _add_inertial(thigh, robot.thigh.reflect(1, left))
        calf = thigh.add_body(name=f"{leg}_calf", pos=(0.0, 0.0, -robot.thigh_length))
        _add_inertial(calf, robot.calf.reflect(1, left))
        axes = ((1, 0, 0), (0, 1, 0), (0, 1, 0))
        for body, joint, axis in zip((hip, thigh, calf), JOINTS, axes, strict=True):
            index = JOINT_NAMES.index(f"{leg}_{joint}")
            hinge = body.add_joint(
                name=f"{leg}_{joint}",
                type=mujoco.mjtJoint.mjJNT_HINGE,
                axis=axis,
                limited=True,
                range=(robot.joint_lower[index], robot.joint_upper[index]),
                margin=robot.joint_margin,
                solref_limit=SOLREF,
            )
            if joint_mechanics:
                hinge.armature = robot.rotor_inertia[index]
                hinge.damping[0] = robot.joint_damping[index]  # of the speed, not its powers
                hinge.frictionloss = robot.friction_loss[index]
            add_shapes(body, joint, f"{leg}_", left)
    gain = robot.kp
    bias = (0.0, -robot.kp, -robot.kd)
    if torque_control:
        gain = 1.0
        bias = (0.0, 0.0, 0.0)
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
