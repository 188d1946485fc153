"""The MuJoCo body tree of a robot."""

from typing import Any

import mujoco
import numpy as np

from mqe_jax.physics.appearance import HIDDEN_GROUP, ROBOT_COLORS, VISUAL_GROUP, bodies
from mqe_jax.physics.collision import robot_bits
from mqe_jax.physics.robots.robot import BASE, Hinge, Link, Primitive, Robot, parts_of

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


def _add_geom(spec: Any, body: Any, primitive: Primitive, **properties: Any) -> None:
    """Adds a primitive or a mesh to a body."""
    place: dict[str, Any] = {"pos": primitive.position, "quat": primitive.quaternion}
    if primitive.end is not None:
        place = {"fromto": (*primitive.position, *primitive.end)}
    if primitive.mesh is not None:
        mesh = spec.add_mesh(
            name=f"mesh{len(spec.meshes)}",
            uservert=primitive.mesh.vertices.ravel(),
            userface=primitive.mesh.faces.ravel(),
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
        )
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name, **place, **properties)
        return
    size = (*np.atleast_1d(primitive.size), 0.0, 0.0)[:3]
    body.add_geom(type=_GEOM_TYPES[primitive.kind], size=size, mass=0.0, **place, **properties)


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
    parts = parts_of(contacts)
    contype, conaffinity = robot_bits(number)
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    made = {"": spec.worldbody}
    for part in robot.tree:
        body = made[part.parent].add_body(name=part.name, pos=part.position, quat=part.quaternion)
        made[part.name] = body
        _add_inertial(body, part.link)
        if not part.parent:
            body.add_freejoint(name=BASE)
        for hinge in part.hinges:
            _add_hinge(body, robot, hinge, joint_mechanics)
        for shape in part.shapes:
            if not parts or shape.part in parts:
                _add_geom(
                    spec,
                    body,
                    shape.primitive,
                    name=shape.name,
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
        for look in part.looks if visual else ():
            _add_geom(
                spec,
                body,
                look.primitive,
                contype=0,
                conaffinity=0,
                rgba=look.mix_color(agent_color),
                group=VISUAL_GROUP,
            )
        if visual and numbered and not part.parent:
            back = max(each.primitive.top for each in part.looks or part.shapes)
            bodies.back_number(body, number + 1, back)
    for i, name in enumerate(robot.joint_names):
        limit = robot.torque_limit[i]
        actuator = spec.add_actuator(
            name=name,
            target=name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            forcelimited=True,
            forcerange=(-limit, limit),
        )
        actuator.gainprm[0] = 1.0 if torque_control else robot.kp
        actuator.biasprm[:3] = (0.0, 0.0, 0.0) if torque_control else (0.0, -robot.kp, -robot.kd)
    return spec


def _add_hinge(body: Any, robot: Robot, hinge: Hinge, mechanics: bool) -> None:
    index = robot.joint_names.index(hinge.name)
    added = body.add_joint(
        name=hinge.name,
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=hinge.axis,
        pos=hinge.position,
        limited=True,
        range=(robot.joint_lower[index], robot.joint_upper[index]),
        margin=robot.joint_margin,
        solref_limit=SOLREF,
    )
    if mechanics:
        added.armature = robot.rotor_inertia[index]
        added.damping[0] = robot.joint_damping[index]  # of the speed, not its powers
        added.frictionloss = robot.friction_loss[index]
