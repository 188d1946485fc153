"""The Unitree Go1 as data, its MuJoCo body tree, and the index tables of N robots in one scene.

Every figure is in SI units (metre, kilogram, second, radian, newton) in the link's own frame: x forward,
y left, z up. Source: the public Unitree Go1 description (masses, inertias, limits) with the collision
shapes replaced by spheres and capsules, which all three engines support.

Legs are ordered FL, FR, RL, RR and joints hip, thigh, calf everywhere in this package.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mqe_jax import robot_look as look
from mqe_jax.rotation import quaternion_to_euler, rotate_inverse

LEGS = ("FL", "FR", "RL", "RR")
JOINTS = ("hip", "thigh", "calf")
NUM_LEGS = len(LEGS)
NUM_JOINTS = NUM_LEGS * len(JOINTS)
JOINT_NAMES = tuple(f"{leg}_{joint}" for leg in LEGS for joint in JOINTS)


@dataclasses.dataclass(frozen=True)
class Link:
    """Inertial figures of one rigid link.

    Attributes:
        mass: kg.
        com: centre of mass in the link frame (3,), m.
        inertia: (xx, yy, zz, xy, xz, yz) about the centre of mass, kg m^2.
    """

    mass: float
    com: tuple[float, float, float]
    inertia: tuple[float, float, float, float, float, float]

    def mirrored(self, x: int, y: int) -> Link:
        """Returns the link reflected by the signs `x` and `y` (each 1 or -1)."""
        xx, yy, zz, xy, xz, yz = self.inertia
        cx, cy, cz = self.com
        return Link(self.mass, (x * cx, y * cy, cz), (xx, yy, zz, x * y * xy, x * xz, y * yz))

    def matrix(self) -> np.ndarray:
        """Returns the inertia tensor about the centre of mass (3, 3), kg m^2."""
        xx, yy, zz, xy, xz, yz = self.inertia
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])

    def welded(self, other: Link, position: tuple[float, float, float]) -> Link:
        """Returns this link with `other` fixed to it at `position` (m, link frame, same axes)."""
        mass = self.mass + other.mass
        centers = (np.asarray(self.com), np.asarray(position) + np.asarray(other.com))
        com = (self.mass * centers[0] + other.mass * centers[1]) / mass
        tensor = np.zeros((3, 3))
        for link, center in zip((self, other), centers, strict=True):
            arm = center - com
            tensor += link.matrix() + link.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
        inertia = tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        return Link(mass, tuple(com.tolist()), tuple(inertia.tolist()))


TRUNK = Link(4.8, (0.0116, 0.0044, 0.0001), (0.01613, 0.03651, 0.04469, 0.00059, 7.3e-6, 2.1e-5))
HIP = Link(0.5103, (-0.0054, -0.0007, 0.0), (3.053e-4, 5.909e-4, 3.966e-4, 0.0, 0.0, 0.0))
THIGH = Link(0.8989, (-0.0035, -0.0189, -0.0327), (5.396e-3, 5.142e-3, 1.025e-3, 0.0, 3.38e-4, 0.0))
CALF = Link(0.1580, (0.0063, -0.0013, -0.1223), (3.608e-3, 3.627e-3, 3.51e-5, 0.0, -1.33e-4, 0.0))
FOOT = Link(0.0600, (0.0, 0.0, 0.0), (9.6e-6, 9.6e-6, 9.6e-6, 0.0, 0.0, 0.0))

LEG_ROOT = (0.1881, 0.04675)  # m, hip joint from the trunk's origin (x front, y left)
HIP_LENGTH = 0.08  # m, hip joint to thigh joint, outward
THIGH_LENGTH = 0.213  # m, thigh joint to calf joint
CALF_LENGTH = 0.213  # m, calf joint to the centre of the foot
FOOT_RADIUS = 0.02  # m

DEFAULT_JOINTS = np.array([0.1, 0.8, -1.5, -0.1, 0.8, -1.5, 0.1, 1.0, -1.5, -0.1, 1.0, -1.5])  # rad
JOINT_LOWER = np.tile([-0.803, -1.047, -2.697], NUM_LEGS)  # rad
JOINT_UPPER = np.tile([0.803, 4.189, -0.916], NUM_LEGS)  # rad
JOINT_SPEED_LIMIT = np.tile([50.0, 28.0, 28.0], NUM_LEGS)  # rad/s, of the motors; used by walking rewards
TORQUE_LIMIT = np.tile([20.0, 20.0, 25.0], NUM_LEGS)  # N m, of the controller (the motors give 33.5)
KP = 20.0  # N m / rad
KD = 0.5  # N m s / rad
# Joint target = default + ACTION_SCALE * action; the hips turn half as far.
ACTION_SCALE = np.tile([0.125, 0.25, 0.25], NUM_LEGS)  # rad
STAND_HEIGHT = 0.30  # m, trunk origin above the ground when standing at the default angles

# The shapes of a robot that may touch something, see `Contacts`.
PARTS = ("trunk", "foot", "calf", "thigh")


@dataclasses.dataclass(frozen=True)
class Contacts:
    """Which parts of a robot touch what; every extra pair costs time on every engine.

    Attributes:
        ground: parts that touch floors, ramps and platforms.
        wall: parts that touch walls and gates.
        robot: parts that touch another robot's trunk (trunks always touch trunks when listed).
        object: parts that touch movable objects and NPCs.
    """

    ground: tuple[str, ...] = ("trunk", "foot")
    wall: tuple[str, ...] = ("trunk", "foot")
    robot: tuple[str, ...] = ("trunk", "foot", "calf")
    object: tuple[str, ...] = ("trunk", "foot", "calf")

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            for part in getattr(self, field.name):
                if part not in PARTS:
                    raise ValueError(f"Contacts.{field.name}: unknown part {part!r}; allowed: {', '.join(PARTS)}")

    def parts(self) -> tuple[str, ...]:
        """Returns the parts that need a collision shape, in the order of `PARTS`."""
        used = {*self.ground, *self.wall, *self.robot, *self.object}
        return tuple(part for part in PARTS if part in used)


# Collision bits. Every robot's trunk has one of its own, which only other robots' shapes answer to: so a robot
# never touches itself, and limbs touch trunks but not limbs.
GROUND_BIT, WALL_BIT, OBJECT_BIT = 1, 2, 4
MAX_ROBOTS = 16


def _trunk_bit(robot: int) -> int:
    return 8 << robot


def _collision_bits(part: str, robot: int, num_robots: int, contacts: Contacts) -> tuple[int, int]:
    """Returns (contype, conaffinity) of one part of one robot."""
    affinity = 0
    affinity |= GROUND_BIT if part in contacts.ground else 0
    affinity |= WALL_BIT if part in contacts.wall else 0
    affinity |= OBJECT_BIT if part in contacts.object else 0
    if part not in contacts.robot:
        return 0, affinity
    affinity |= sum(_trunk_bit(other) for other in range(num_robots) if other != robot)
    return _trunk_bit(robot) if part == "trunk" else 0, affinity


def _add_inertial(body: Any, link: Link) -> None:
    body.explicitinertial = True
    body.mass = link.mass
    body.ipos = link.com
    body.fullinertia = link.inertia


def build_robot(
    robot: int,
    num_robots: int,
    contacts: Contacts,
    *,
    visual: bool = True,
    friction: float = 1.0,
    torque_control: bool = False,
    color: int | None = None,
) -> mujoco.MjSpec:
    """Builds one Go1 with a free base as an `MjSpec`, to be attached to a scene under a prefix.

    Args:
        robot: which robot of the scene it is (its collision bits).
        num_robots: how many robots share the scene.
        contacts: which parts touch what.
        visual: whether to add the geoms that are only looked at.
        friction: sliding friction of its shapes, which takes precedence over the other shape's.
        torque_control: actuators take torques (N m) instead of PD joint targets (rad).
        color: index of its colour in `robot_look.COLORS`; `robot` if None.
    """
    paint = look.COLORS[(robot if color is None else color) % len(look.COLORS)]
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    trunk = spec.worldbody.add_body(name="trunk", pos=(0.0, 0.0, STAND_HEIGHT))
    trunk.add_freejoint(name="base")
    _add_inertial(trunk, TRUNK)
    used = contacts.parts()

    def collide(body: Any, part: str, name: str, **shape: Any) -> None:
        if part not in used:
            return
        contype, conaffinity = _collision_bits(part, robot, num_robots, contacts)
        body.add_geom(
            name=name, contype=contype, conaffinity=conaffinity, group=3, mass=0.0, condim=3, priority=2,
            friction=(friction, 0.005, 0.0001), rgba=(0.9, 0.3, 0.3, 0.4), **shape,
        )  # fmt: skip

    # Trunk box 0.376 x 0.094 x 0.114 with the head in front of it, as one capsule.
    collide(
        trunk, "trunk", "trunk", type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=(0.055, 0, 0),
        fromto=(-0.135, 0, 0, 0.235, 0, 0),
    )  # fmt: skip
    for leg in LEGS:
        front = 1 if leg[0] == "F" else -1
        left = 1 if leg[1] == "L" else -1
        hip = trunk.add_body(name=f"{leg}_hip", pos=(front * LEG_ROOT[0], left * LEG_ROOT[1], 0.0))
        _add_inertial(hip, HIP.mirrored(front, left))
        thigh = hip.add_body(name=f"{leg}_thigh", pos=(0.0, left * HIP_LENGTH, 0.0))
        _add_inertial(thigh, THIGH.mirrored(1, left))
        calf = thigh.add_body(name=f"{leg}_calf", pos=(0.0, 0.0, -THIGH_LENGTH))
        _add_inertial(calf, CALF.mirrored(1, left).welded(FOOT, (0.0, 0.0, -CALF_LENGTH)))
        for body, name, axis in (
            (hip, "hip", (1, 0, 0)),
            (thigh, "thigh", (0, 1, 0)),
            (calf, "calf", (0, 1, 0)),
        ):
            index = JOINT_NAMES.index(f"{leg}_{name}")
            body.add_joint(
                name=f"{leg}_{name}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis, limited=True,
                range=(JOINT_LOWER[index], JOINT_UPPER[index]),
            )  # fmt: skip
        capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
        collide(thigh, "thigh", f"{leg}_thigh", type=capsule, size=(0.017, 0, 0), fromto=(0, 0, -0.02, 0, 0, -0.19))
        collide(calf, "calf", f"{leg}_calf", type=capsule, size=(0.01, 0, 0), fromto=(0, 0, -0.03, 0, 0, -0.18))
        sphere = mujoco.mjtGeom.mjGEOM_SPHERE
        collide(calf, "foot", f"{leg}_foot", type=sphere, size=(FOOT_RADIUS, 0, 0), pos=(0, 0, -CALF_LENGTH))
        if visual:
            look.add_leg(hip, thigh, calf, left, paint, (THIGH_LENGTH, CALF_LENGTH), FOOT_RADIUS)
    if visual:
        look.add_trunk(trunk, paint)
    for index, name in enumerate(JOINT_NAMES):
        gain, bias = (1.0, (0.0, 0.0, 0.0)) if torque_control else (KP, (0.0, -KP, -KD))
        actuator = spec.add_actuator(
            name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE, forcelimited=True,
            forcerange=(-TORQUE_LIMIT[index], TORQUE_LIMIT[index]),
        )  # fmt: skip
        actuator.gainprm[0] = gain
        actuator.biasprm[:3] = bias
    return spec


@dataclasses.dataclass(frozen=True)
class RobotIndex:
    """Where the robots of a compiled model are; all tables are host integers, A robots.

    Attributes:
        base_qpos: addresses of (position 3, quaternion wxyz 4) in qpos (A, 7).
        base_qvel: addresses of (linear 3 world, angular 3 body) in qvel (A, 6).
        joint_qpos: joint angles in qpos (A, 12).
        joint_qvel: joint velocities in qvel (A, 12).
        actuator: rows of ctrl (A, 12).
        trunk_body: trunk body ids (A,).
        bodies: all body ids of each robot (A, 13).
        foot_geom: foot shape ids (A, 4).
        trunk_geom: trunk shape ids (A,).
        geoms: collision shape ids of each robot (A, G).
        trunk_force: addresses in sensordata of the trunk's strongest contact force (A, 3), contact frame, N.
        foot_force: addresses of each foot's strongest contact force (A, 4, 3), contact frame, N; (0, 4, 3) unless
            the scene has foot sensors.
        touch: (robot, robot, address in sensordata) of each robot-robot contact counter (T, 3).
    """

    base_qpos: np.ndarray
    base_qvel: np.ndarray
    joint_qpos: np.ndarray
    joint_qvel: np.ndarray
    actuator: np.ndarray
    trunk_body: np.ndarray
    bodies: np.ndarray
    foot_geom: np.ndarray
    trunk_geom: np.ndarray
    geoms: np.ndarray
    trunk_force: np.ndarray
    foot_force: np.ndarray
    touch: np.ndarray

    @property
    def num_robots(self) -> int:
        """Number of robots A."""
        return len(self.trunk_body)


def prefix(robot: int) -> str:
    """Returns the name prefix of robot number `robot` in a scene."""
    return f"robot{robot}/"


def add_sensors(spec: mujoco.MjSpec, num_robots: int, contacts: Contacts, *, feet: bool = False) -> None:
    """Adds the trunk (and foot) contact force and robot-robot contact sensors, which all engines compute alike."""
    geom = mujoco.mjtObj.mjOBJ_GEOM
    force_bits, found_bits, strongest = 1 << 1, 1 << 0, 2
    if "trunk" not in contacts.parts():
        raise ValueError(
            "Contacts: the trunk must collide with something; add 'trunk' to ground, wall, robot or object"
        )
    shapes = ["trunk"] + [f"{leg}_foot" for leg in LEGS if feet]
    for robot in range(num_robots):
        for shape in shapes:
            spec.add_sensor(
                name=f"{prefix(robot)}{shape}_force", type=mujoco.mjtSensor.mjSENS_CONTACT, objtype=geom,
                objname=prefix(robot) + shape, intprm=(force_bits, strongest, 1),
            )  # fmt: skip
    for name, first, second in _touch_pairs(num_robots, contacts):
        spec.add_sensor(
            name=name, type=mujoco.mjtSensor.mjSENS_CONTACT, objtype=geom, objname=first, reftype=geom,
            refname=second, intprm=(found_bits, 0, 1),
        )  # fmt: skip


def _touch_pairs(num_robots: int, contacts: Contacts) -> list[tuple[str, str, str]]:
    """Returns (sensor, shape, shape) of every pair of shapes by which two robots can touch."""
    limbs = [f"{leg}_{part}" for part in ("foot", "calf", "thigh") if part in contacts.robot for leg in LEGS]
    pairs = []
    for i in range(num_robots):
        for j in range(i + 1, num_robots):
            if "trunk" not in contacts.robot:
                continue
            shapes = [("trunk", "trunk")] + [("trunk", limb) for limb in limbs] + [(limb, "trunk") for limb in limbs]
            pairs += [(f"touch/{i}/{j}/{a}/{b}", prefix(i) + a, prefix(j) + b) for a, b in shapes]
    return pairs


def index_robots(model: mujoco.MjModel, num_robots: int, contacts: Contacts, *, feet: bool = False) -> RobotIndex:
    """Looks up by name, once, where every robot of a compiled model is."""
    base_qpos, base_qvel, joint_qpos, joint_qvel, actuator, trunk, bodies = ([] for _ in range(7))
    foot_geom, trunk_geom, geoms, force, foot_force = [], [], [], [], []
    body_names = ["trunk"] + [f"{leg}_{joint}" for leg in LEGS for joint in JOINTS]
    for robot in range(num_robots):
        name = prefix(robot)
        base = model.joint(name + "base")
        base_qpos.append(base.qposadr[0] + np.arange(7))
        base_qvel.append(base.dofadr[0] + np.arange(6))
        joint_qpos.append([model.joint(name + joint).qposadr[0] for joint in JOINT_NAMES])
        joint_qvel.append([model.joint(name + joint).dofadr[0] for joint in JOINT_NAMES])
        actuator.append([model.actuator(name + joint).id for joint in JOINT_NAMES])
        trunk.append(model.body(name + "trunk").id)
        bodies.append([model.body(name + body).id for body in body_names])
        shapes = ["trunk"] + [f"{leg}_{part}" for part in PARTS[1:] if part in contacts.parts() for leg in LEGS]
        geoms.append([model.geom(name + shape).id for shape in shapes])
        trunk_geom.append(model.geom(name + "trunk").id)
        foot_geom.append([model.geom(f"{name}{leg}_foot").id for leg in LEGS])
        force.append(model.sensor(name + "trunk_force").adr[0] + np.arange(3))
        if feet:
            foot_force.append([model.sensor(f"{name}{leg}_foot_force").adr[0] + np.arange(3) for leg in LEGS])
    touch = [
        (*map(int, sensor.split("/")[1:3]), model.sensor(sensor).adr[0])
        for sensor, _, _ in _touch_pairs(num_robots, contacts)
    ]
    as_int = lambda rows: np.asarray(rows, np.int32)  # noqa: E731
    return RobotIndex(
        as_int(base_qpos), as_int(base_qvel), as_int(joint_qpos), as_int(joint_qvel), as_int(actuator),
        as_int(trunk), as_int(bodies), as_int(foot_geom), as_int(trunk_geom), as_int(geoms), as_int(force),
        as_int(foot_force).reshape(-1, 4, 3), as_int(touch).reshape(-1, 3),
    )  # fmt: skip


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class RobotReadings:
    """What every engine tells about the A robots of a scene after a step.

    Attributes:
        position_w: trunk origin in the environment frame (A, 3), m.
        quaternion: trunk orientation, wxyz (A, 4).
        linear_velocity_w: of the trunk origin (A, 3), m/s.
        angular_velocity_b: body frame (A, 3), rad/s.
        joint_position: (A, 12), rad.
        joint_velocity: (A, 12), rad/s.
        trunk_force: strongest contact force on the trunk (A,), N.
        touching: whether robots i and j touch (A, A) bool, symmetric.
    """

    position_w: jax.Array
    quaternion: jax.Array
    linear_velocity_w: jax.Array
    angular_velocity_b: jax.Array
    joint_position: jax.Array
    joint_velocity: jax.Array
    trunk_force: jax.Array
    touching: jax.Array

    @property
    def euler(self) -> jax.Array:
        """Roll, pitch, yaw of the trunk (A, 3), rad."""
        return quaternion_to_euler(self.quaternion)

    @property
    def base_info(self) -> jax.Array:
        """Position and roll, pitch, yaw (A, 6): the base information of the paper's observations."""
        return jnp.concatenate([self.position_w, self.euler], axis=-1)

    @property
    def projected_gravity(self) -> jax.Array:
        """Unit gravity vector in the trunk frame (A, 3)."""
        return rotate_inverse(self.quaternion, jnp.array([0.0, 0.0, -1.0]))


def read_robots(index: RobotIndex, qpos: jax.Array, qvel: jax.Array, sensordata: jax.Array) -> RobotReadings:
    """Reads all robots off the state vectors of one world (nq,), (nv,), (nsensordata,)."""
    base, base_velocity = qpos[index.base_qpos], qvel[index.base_qvel]
    count = index.num_robots
    touching = jnp.zeros((count, count), bool)
    if len(index.touch):
        first, second, address = index.touch.T
        found = sensordata[address] > 0
        touching = touching.at[first, second].max(found).at[second, first].max(found)
    return RobotReadings(
        position_w=base[:, :3],
        quaternion=base[:, 3:],
        linear_velocity_w=base_velocity[:, :3],
        angular_velocity_b=base_velocity[:, 3:],
        joint_position=qpos[index.joint_qpos],
        joint_velocity=qvel[index.joint_qvel],
        trunk_force=jnp.linalg.norm(sensordata[index.trunk_force], axis=-1),
        touching=touching,
    )


def foot_positions(joint_position: jax.Array) -> jax.Array:
    """Computes the feet's centres in the trunk frame (..., 4, 3), m, from joint angles (..., 12), rad."""
    return _leg_points(joint_position, CALF_LENGTH)


def knee_positions(joint_position: jax.Array) -> jax.Array:
    """Computes the knees (calf joints) in the trunk frame (..., 4, 3), m, from joint angles (..., 12), rad."""
    return _leg_points(joint_position, 0.0)


def _leg_points(joint_position: jax.Array, along_calf: float) -> jax.Array:
    """Closed-form leg kinematics: the point `along_calf` metres down each calf, trunk frame (..., 4, 3)."""
    angles = joint_position.reshape(*joint_position.shape[:-1], NUM_LEGS, 3)
    hip, thigh, calf = jnp.moveaxis(angles, -1, 0)
    front = jnp.array([1.0, 1.0, -1.0, -1.0])
    left = jnp.array([1.0, -1.0, 1.0, -1.0])
    x = -THIGH_LENGTH * jnp.sin(thigh) - along_calf * jnp.sin(thigh + calf)
    z = -THIGH_LENGTH * jnp.cos(thigh) - along_calf * jnp.cos(thigh + calf)
    y = left * HIP_LENGTH
    return jnp.stack(
        [
            front * LEG_ROOT[0] + x,
            left * LEG_ROOT[1] + y * jnp.cos(hip) - z * jnp.sin(hip),
            y * jnp.sin(hip) + z * jnp.cos(hip),
        ],
        axis=-1,
    )
