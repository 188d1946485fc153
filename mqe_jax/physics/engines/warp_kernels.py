"""The motors as kernels of Warp, with the numbers of `Motors`."""

import warp as wp  # pyright: ignore[reportMissingImports]

from mqe_jax.physics.robots import motors

JOINTS = 3  # of a leg
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


class Parameters(wp.types.vector(length=10, dtype=float)):
    """Gain or bias of an actuator."""


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


@wp.kernel(enable_backward=False)
def drive(
    constants: wp.array2d[float],
    angles: wp.array[int],
    speeds: wp.array[int],
    timestep: float,
    kick: wp.mat33,  # speeds that unit torques of a leg add in a physics step
    gainprm: wp.array2d[Parameters],
    biasprm: wp.array2d[Parameters],
    base: wp.array2d[float],
    asked: wp.array2d[float],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    ctrl: wp.array2d[float],
    armature: wp.array2d[float],
):
    """Sets a leg's control and armature in a physics step, `Motors.limit` after `Motors.clamp`."""
    env, leg = wp.tid()
    effort = wp.vec3()
    given = wp.vec3()
    pace = wp.vec3()
    for i in range(JOINTS):
        joint = leg * JOINTS + i
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
        ctrl[env, joint] = wanted + (found - force) / wp.where(gain[0] == 0.0, 1.0, gain[0])
        effort[i] = wp.abs(found)
        given[i] = found * sign

    added = effort @ kick
    fastest = wp.max(wp.max(pace[0], pace[1]), pace[2])
    near = (fastest / constants[leg * JOINTS, LEG_SPEED] - SLOW) / (FAST - SLOW)
    near = wp.clamp(near, 0.0, 1.0)
    for i in range(JOINTS):
        joint = leg * JOINTS + i
        speed = constants[joint, SPEED]
        full = constants[joint, FULL]
        reach = (pace[i] + added[i]) / speed
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
