"""Index tables of the robots of a compiled scene, and their state after a step."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mqe_jax.robots.build import PARTS, Contacts
from mqe_jax.robots.go1 import JOINT_NAMES, JOINTS, LEGS
from mqe_jax.rotation import quaternion_to_euler, rotate_inverse


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
class RobotState:
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


def read_robots(index: RobotIndex, qpos: jax.Array, qvel: jax.Array, sensordata: jax.Array) -> RobotState:
    """Reads all robots off the state vectors of one world (nq,), (nv,), (nsensordata,)."""
    base, base_velocity = qpos[index.base_qpos], qvel[index.base_qvel]
    count = index.num_robots
    touching = jnp.zeros((count, count), bool)
    if len(index.touch):
        first, second, address = index.touch.T
        found = sensordata[address] > 0
        touching = touching.at[first, second].max(found).at[second, first].max(found)
    return RobotState(
        position_w=base[:, :3],
        quaternion=base[:, 3:],
        linear_velocity_w=base_velocity[:, :3],
        angular_velocity_b=base_velocity[:, 3:],
        joint_position=qpos[index.joint_qpos],
        joint_velocity=qvel[index.joint_qvel],
        trunk_force=jnp.linalg.norm(sensordata[index.trunk_force], axis=-1),
        touching=touching,
    )
