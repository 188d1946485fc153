"""Index tables of a scene's robots, and their state after a step."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mqe_jax.physics.robots.fleet import Fleet
from mqe_jax.physics.robots.robot import BASE, FOOT, TRUNK, Robot, parts_of
from mqe_jax.physics.rotation import quaternion_to_euler, rotate_inverse


@dataclasses.dataclass(frozen=True)
class RobotIndex:
    """Index tables of the R robots of a compiled model, as host integers.

    J, B, G, T and F are the largest numbers of a robot. -1 fills the rows of those with fewer.
    """

    base_qpos: np.ndarray  # addresses of (position 3, quaternion wxyz 4) in qpos (R, 7)
    base_qvel: np.ndarray  # addresses of (linear 3 world, angular 3 body) in qvel (R, 6)
    joint_qpos: np.ndarray  # joint angles in qpos (R, J)
    joint_qvel: np.ndarray  # joint velocities in qvel (R, J)
    actuator: np.ndarray  # rows of ctrl (R, J)
    trunk_body: np.ndarray  # trunk body ids (R,)
    bodies: np.ndarray  # all body ids of each robot (R, B)
    geoms: np.ndarray  # collision geom ids of each robot (R, G)
    trunk_force: np.ndarray
    """Addresses in sensordata of the strongest contact force on each of the trunk's T collision
    geoms (R, T, 3), contact frame, N."""
    foot_force: np.ndarray
    """Addresses of each foot's strongest contact force (R, F, 3), contact frame, N; (0, F, 3)
    unless the scene has foot sensors."""

    @property
    def num_robots(self) -> int:
        """Number of robots R."""
        return len(self.trunk_body)


def scatter(base: Any, addresses: np.ndarray, values: jax.Array) -> jax.Array:
    """Returns the array `base` (n,) with `values` at `addresses`, host integers of the same shape.

    Values at -1 are left out. A GPU computes this together with what precedes and follows it; a
    scatter takes kernels of its own.
    """
    source = np.full(len(base), -1)
    known = addresses >= 0
    source[addresses[known]] = np.flatnonzero(known)
    placed = jnp.ravel(values)[np.maximum(source, 0)]
    return jnp.where(source < 0, jnp.asarray(base, values.dtype), placed)


def gather(values: jax.Array, addresses: np.ndarray) -> jax.Array:
    """Returns the `values` (n,) at `addresses`, host integers; 0 at those of -1."""
    found = values[addresses]
    if np.all(addresses >= 0):
        return found
    return jnp.where(addresses < 0, jnp.zeros_like(found), found)


def prefix(number: int) -> str:
    """Returns the name prefix of robot `number` in a scene."""
    return f"robot{number}/"


def trunk_bodies(model: mujoco.MjModel) -> list[int]:
    """Returns the body ids of the robots' trunks in a scene's model, in the order of the robots."""
    found: list[int] = []
    while True:
        name = prefix(len(found)) + TRUNK
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
        if body < 0:
            return found
        found.append(body)


def add_sensors(spec: mujoco.MjSpec, robots: Sequence[Robot], *, feet: bool = False) -> None:
    """Adds sensors of the strongest contact force on the trunks, and on the `feet`.

    All engines support them.
    """
    for number, robot in enumerate(robots):
        for name in robot.geom_names(TRUNK) + (robot.geom_names(FOOT) if feet else ()):
            spec.add_sensor(
                name=f"{prefix(number)}{name}_force",
                type=mujoco.mjtSensor.mjSENS_CONTACT,
                objtype=mujoco.mjtObj.mjOBJ_GEOM,
                objname=prefix(number) + name,
                intprm=(1 << 1, 2, 1),  # the force, of the strongest contact, one of them
            )


def index_robots(
    model: mujoco.MjModel, robots: Fleet, *, contacts: str = "full", feet: bool = False
) -> RobotIndex:
    """Builds the index tables of a compiled model's robots by looking up names."""
    bases = [model.joint(prefix(i) + BASE) for i in range(len(robots))]

    def table(lookup: Callable[[str], Any], names: Callable[[Robot], Sequence[str]]) -> np.ndarray:
        return _fill(
            [[lookup(prefix(i) + name) for name in names(robot)] for i, robot in enumerate(robots)]
        )

    def force(part: str) -> np.ndarray:
        def lookup(name: str) -> np.ndarray:
            return model.sensor(name + "_force").adr[0] + np.arange(3)

        return table(lookup, lambda robot: robot.geom_names(part))

    most = max(len(robot.geom_names(FOOT)) for robot in robots)
    return RobotIndex(
        base_qpos=np.array([base.qposadr[0] + np.arange(7) for base in bases], np.int32),
        base_qvel=np.array([base.dofadr[0] + np.arange(6) for base in bases], np.int32),
        joint_qpos=table(lambda name: model.joint(name).qposadr[0], lambda x: x.joint_names),
        joint_qvel=table(lambda name: model.joint(name).dofadr[0], lambda x: x.joint_names),
        actuator=table(lambda name: model.actuator(name).id, lambda x: x.joint_names),
        trunk_body=table(lambda name: model.body(name).id, lambda x: [TRUNK])[:, 0],
        bodies=table(lambda name: model.body(name).id, lambda x: x.body_names),
        geoms=table(lambda name: model.geom(name).id, lambda x: x.geom_names(*parts_of(contacts))),
        trunk_force=force(TRUNK),
        foot_force=force(FOOT) if feet else np.zeros((0, most, 3), np.int32),
    )


def _fill(rows: Sequence[Sequence[Any]]) -> np.ndarray:
    """Returns rows of any lengths as a table, which -1 fills."""
    most = max(map(len, rows))
    full = []
    for row in rows:
        own = np.array(row, np.int32)
        missing = [(0, most - len(own)), *[(0, 0)] * (own.ndim - 1)]
        full.append(np.pad(own, missing, constant_values=-1))
    return np.stack(full)


class Proprioception(NamedTuple):
    """What a skill senses of one robot."""

    gravity_b: jax.Array  # unit gravity vector in the trunk frame (3,)
    joint_position: jax.Array  # joint angles (J,), rad
    joint_velocity: jax.Array  # joint velocities (J,), rad/s

    def of(self, rows: slice | np.ndarray, joints: int) -> "Proprioception":
        """Returns that of some rows of many robots, with their first joints."""
        position = self.joint_position[rows, :joints]
        return Proprioception(self.gravity_b[rows], position, self.joint_velocity[rows, :joints])


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class RobotState:
    """Backend-independent robot state after a step (R robots, NPC robots included).

    J is the largest number of joints; entries beyond a robot's own are 0.
    """

    position_w: jax.Array  # trunk origin in the environment frame (R, 3), m
    quaternion: jax.Array  # trunk orientation, wxyz (R, 4)
    linear_velocity_w: jax.Array  # of the trunk origin in the environment frame (R, 3), m/s
    angular_velocity_b: jax.Array  # angular velocity of the trunk in its own frame (R, 3), rad/s
    joint_position: jax.Array  # joint angles (R, J), rad
    joint_velocity: jax.Array  # joint velocities (R, J), rad/s
    trunk_force: jax.Array  # strongest contact force on the trunk (R,), N
    active: jax.Array  # robots that take part (R,) bool; the others count nowhere

    def count(self, values: jax.Array) -> jax.Array:
        """Returns values (R', ...) of the first R' robots, 0 for those that take no part."""
        active = self.active[: len(values)].reshape(-1, *(1,) * (values.ndim - 1))
        return jnp.where(active, values, jnp.zeros_like(values))

    @property
    def euler(self) -> jax.Array:
        """Roll, pitch, yaw of the trunk (R, 3), rad."""
        return quaternion_to_euler(self.quaternion)

    @property
    def base_info(self) -> jax.Array:
        """Position, m, and roll, pitch, yaw, rad (R, 6), the base information of the paper."""
        return jnp.concatenate([self.position_w, self.euler], axis=-1)

    @property
    def projected_gravity(self) -> jax.Array:
        """Unit gravity vector in the trunk frame (R, 3)."""
        return rotate_inverse(self.quaternion, jnp.array([0.0, 0.0, -1.0]))

    @property
    def proprioception(self) -> Proprioception:
        """What the robots' skills sense, leading axis R."""
        return Proprioception(self.projected_gravity, self.joint_position, self.joint_velocity)


def read_robots(
    index: RobotIndex,
    qpos: jax.Array,
    qvel: jax.Array,
    sensordata: jax.Array,
    active: jax.Array | None = None,
) -> RobotState:
    """Reads all robots from state vectors.

    `active` (A,) says which of the first robots take part, by default all.
    """
    takes_part = jnp.ones(index.num_robots, bool)
    if active is not None:
        takes_part = jnp.concatenate([active, takes_part[len(active) :]])
    base = qpos[index.base_qpos]
    base_velocity = qvel[index.base_qvel]
    trunk_forces = jnp.linalg.norm(gather(sensordata, index.trunk_force), axis=-1)
    return RobotState(
        position_w=base[:, :3],
        quaternion=base[:, 3:],
        linear_velocity_w=base_velocity[:, :3],
        angular_velocity_b=base_velocity[:, 3:],
        joint_position=gather(qpos, index.joint_qpos),
        joint_velocity=gather(qvel, index.joint_qvel),
        trunk_force=jnp.max(trunk_forces, axis=-1),
        active=takes_part,
    )
