"""Kernels of Warp: the motors, with the numbers of `Motors`, and parts of a physics step.

MuJoCo Warp sums over the bodies below another in a kernel for each level of the tree. Here such a
sum is a loop, since their numbers are consecutive.
"""

import functools

import mujoco
import warp as wp  # pyright: ignore[reportMissingImports]

from mqe_jax.physics.engines import private
from mqe_jax.physics.robots import motors

# Columns of `Motors.constants`.
SPEED = wp.constant(0)
TORQUE = wp.constant(1)
FASTEST = wp.constant(2)
LINE = wp.constant(3)
BRAKE = wp.constant(4)
FULL = wp.constant(5)
NEEDED = wp.constant(6)
INERTIA = wp.constant(7)
LEG_SPEED = wp.constant(8)
STEEP = wp.constant(9)
SLOW = wp.constant(motors.SLOW)
FAST = wp.constant(motors.FAST)
REACH = wp.constant(motors.REACH)
ROUNDING = wp.constant(motors.ROUNDING)
FREE = wp.constant(int(mujoco.mjtJoint.mjJNT_FREE))
BALL = wp.constant(int(mujoco.mjtJoint.mjJNT_BALL))
quat_integrate = private.warp_source("math").quat_integrate


class Ten(wp.types.vector(length=10, dtype=float)):
    """Gain or bias of an actuator; inertia, first moment and mass of bodies."""


@wp.kernel(enable_backward=False)
def repeat(rows: wp.array2d[float], result: wp.array2d[float]):
    """Gives each environment its row."""
    env, column = wp.tid()
    result[env, column] = rows[env % rows.shape[0], column]


@wp.func
def _clamp(
    joint: int,
    env: int,
    constants: wp.array2d[float],
    angles: wp.array[int],
    speeds: wp.array[int],
    timestep: float,
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
):
    """Limits the speed of a joint; what is not a number stays so."""
    fastest = constants[joint, FASTEST]
    velocity = qvel[env, speeds[joint]]
    clamped = velocity
    if velocity > fastest:
        clamped = fastest
    if velocity < -fastest:
        clamped = -fastest
    qpos[env, angles[joint]] = qpos[env, angles[joint]] - timestep * (velocity - clamped)
    qvel[env, speeds[joint]] = clamped


@wp.kernel(enable_backward=False)
def clamp(
    constants: wp.array2d[float],
    angles: wp.array[int],
    speeds: wp.array[int],
    timestep: float,
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
):
    """Limits the speeds of all joints, `Motors.clamp`."""
    env, joint = wp.tid()
    _clamp(joint, env, constants, angles, speeds, timestep, qpos, qvel)


@functools.cache
def driver(joints: int):
    """Returns the kernel `drive` for limbs of a number of joints.

    Its `first` is the first joint of the first limb. Its `kick` are the speeds that unit torques
    of a limb add in a physics step.
    """
    Row = wp.types.vector(length=joints, dtype=float)

    @wp.kernel(enable_backward=False, module="unique")
    def drive(
        constants: wp.array2d[float],
        angles: wp.array[int],
        speeds: wp.array[int],
        timestep: float,
        first: int,
        kick: wp.array2d[float],
        gainprm: wp.array2d[Ten],
        biasprm: wp.array2d[Ten],
        base: wp.array2d[float],
        asked: wp.array2d[float],
        qpos: wp.array2d[float],
        qvel: wp.array2d[float],
        ctrl: wp.array2d[float],
        torques: wp.array2d[float],
        armature: wp.array2d[float],
    ):
        """Sets what a limb gets in a physics step, by `Motors.limit` after `Motors.clamp`."""
        env, limb = wp.tid()
        effort = Row()
        given = Row()
        pace = Row()
        for i in range(joints):
            joint = first + limb * joints + i
            _clamp(joint, env, constants, angles, speeds, timestep, qpos, qvel)
            position = qpos[env, angles[joint]]
            velocity = qvel[env, speeds[joint]]
            gain = gainprm[env % gainprm.shape[0], joint]
            bias = biasprm[env % biasprm.shape[0], joint]
            torque = constants[joint, TORQUE]
            pace[i] = wp.abs(velocity)
            below = constants[joint, SPEED] - pace[i]
            steepest = wp.min(constants[joint, LINE] * below, constants[joint, BRAKE] * below)
            most = wp.max(wp.min(steepest, torque), -torque)
            sign = wp.where(velocity < 0.0, -1.0, 1.0)
            wanted = asked[env, joint]
            force = gain[0] * wanted + bias[0] + bias[1] * position + bias[2] * velocity
            found = sign * wp.min(wp.max(sign * force, -torque), most)
            limited = wanted + (found - force) / wp.where(gain[0] == 0.0, 1.0, gain[0])
            ctrl[env, joint] = limited
            limited = gain[0] * limited + bias[0] + bias[1] * position + bias[2] * velocity
            torques[env, speeds[joint]] = wp.clamp(limited, -torque, torque)
            effort[i] = wp.abs(found)
            given[i] = found * sign

        fastest = wp.max(pace)
        near = (fastest / constants[first + limb * joints, LEG_SPEED] - SLOW) / (FAST - SLOW)
        near = wp.clamp(near, 0.0, 1.0)
        for i in range(joints):
            joint = first + limb * joints + i
            speed = constants[joint, SPEED]
            full = constants[joint, FULL]
            added = 0.0
            for other in range(joints):
                added += effort[other] * kick[other, i]
            reach = (pace[i] + added) / speed
            beyond = wp.min(constants[joint, NEEDED] * (reach - 1.0), full)
            needed = wp.where(reach > REACH, beyond, 0.0)
            if constants[joint, STEEP] > 0.0:
                slope = constants[joint, LINE]
                line = slope * (speed + wp.where(given[i] < 0.0, pace[i], -pace[i]))
                share = wp.min(effort[i] / wp.max(line, ROUNDING), 1.0)
                inertia = constants[joint, INERTIA]
                needed = wp.max(share * (inertia + timestep * slope) - inertia, 0.0)
            dof = speeds[joint]
            armature[env, dof] = base[env % base.shape[0], dof] + wp.max(near * full, needed)

    return drive


@wp.kernel(enable_backward=False)
def center(
    ends: wp.array[int],
    mass: wp.array2d[float],
    subtree_mass: wp.array2d[float],
    position: wp.array2d[wp.vec3],
    result: wp.array2d[wp.vec3],
):
    """Computes the centre of mass of each body with those below it, whose numbers end at `ends`."""
    env, body = wp.tid()
    total = wp.vec3()
    for part in range(body, ends[body]):
        total += mass[env % mass.shape[0], part] * position[env, part]
    whole = subtree_mass[env % subtree_mass.shape[0], body]
    if whole != 0.0:
        total = total / whole
    result[env, body] = total


@wp.kernel(enable_backward=False)
def composite(ends: wp.array[int], inertia: wp.array2d[Ten], result: wp.array2d[Ten]):
    """Sums the inertia of each body and those below it."""
    env, body = wp.tid()
    total = Ten()
    for part in range(body, ends[body]):
        total += inertia[env, part]
    result[env, body] = total


@wp.kernel(enable_backward=False)
def forces(
    ends: wp.array[int],
    bodies: wp.array[int],
    motion: wp.array2d[wp.spatial_vector],
    force: wp.array2d[wp.spatial_vector],
    passive: wp.array2d[float],
    actuator: wp.array2d[float],
    result: wp.array2d[float],
):
    """Sums the forces on each degree of freedom, without those of constraints."""
    env, dof = wp.tid()
    body = bodies[dof]
    total = wp.spatial_vector()
    for part in range(body, ends[body]):
        total += force[env, part]
    result[env, dof] = passive[env, dof] - wp.dot(motion[env, dof], total) + actuator[env, dof]


@wp.func
def _turn(env: int, place: int, speed: wp.vec3, timestep: float, qpos: wp.array2d[float]):
    """Turns the quaternion at a place of the positions."""
    before = wp.quat(
        qpos[env, place], qpos[env, place + 1], qpos[env, place + 2], qpos[env, place + 3]
    )
    after = quat_integrate(before, speed, timestep)
    for i in range(4):
        qpos[env, place + i] = after[i]


@wp.kernel(enable_backward=False)
def advance(
    timesteps: wp.array[float],
    kinds: wp.array[int],
    places: wp.array[int],
    dofs: wp.array[int],
    qacc: wp.array2d[float],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    warmstart: wp.array2d[float],
):
    """Advances each joint's velocities, then its positions with these."""
    env, joint = wp.tid()
    timestep = timesteps[env % timesteps.shape[0]]
    place = places[joint]
    dof = dofs[joint]
    kind = kinds[joint]
    count = 1
    moved = 1
    if kind == FREE:
        count = 6
        moved = 3
    if kind == BALL:
        count = 3
        moved = 0
    for i in range(dof, dof + count):
        qvel[env, i] = qvel[env, i] + qacc[env, i] * timestep
        warmstart[env, i] = qacc[env, i]
    for i in range(moved):
        qpos[env, place + i] = qpos[env, place + i] + timestep * qvel[env, dof + i]
    if count > 1:
        first = dof + moved
        speed = wp.vec3(qvel[env, first], qvel[env, first + 1], qvel[env, first + 2])
        _turn(env, place + moved, speed, timestep, qpos)
