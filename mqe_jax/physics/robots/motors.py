"""Motors: the torque and the speed that a robot's joint motors can give.

A motor has a controller's limit L, and a DC motor's stall torque S and speed limit V. In the
direction of its speed v it gives at most L and at most S (1 - v / V). Above V it brakes, with L at
(1 + `BAND`) V. These bounds are evaluated at the start of every physics step.

Explicit integration alone would carry light legs beyond V within one physics step of 5 ms. So some
joints get an armature (rotor inertia) for this physics step. In a leg that is fast, or whose
torques can carry it far beyond V within the step, it is the implicit form of the braking above V.
In a joint whose torque line is too steep for the step (the calf of the Go2), it is the implicit
form of that line, in proportion to the torque. A free joint then moves as by backward Euler. Speeds
beyond `CLAMP` V, from torques, joint limits and contacts, are set to `CLAMP` V, as PhysX does with
a joint's velocity limit.

The functions take numpy or JAX arrays; `xp` is the module, numpy or jax.numpy.
"""

import dataclasses
import functools
import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from mqe_jax.physics.robots.build import build_robot
from mqe_jax.physics.robots.fleet import Fleet
from mqe_jax.physics.robots.index import RobotIndex
from mqe_jax.physics.robots.robot import Robot

BAND = 0.15  # share of the speed limit above it at which the motor brakes with its full torque
SLOW = 0.85  # share of a leg's lowest speed limit at which its armature begins
FAST = 1.0  # share at which it is complete
REACH = 1.25
"""Share of its speed limit to which a joint's torques may carry it in a step without armature."""
GAIN = 4.0  # of the armature beyond `REACH`; 1 would bring an isolated joint to its speed limit
STEEP = 2.0
"""Timestep x slope of the torque line / inertia above which explicit integration is unstable."""
DROP = 1.4  # height of the trunk at a reset over that of the stance
UNLIMITED = 1e6  # rad/s, the speed limit of motors without one
CLAMP = 1.09  # greatest share of the speed limit after a physics step
ROUNDING = 1e-5  # relative margin that covers the rounding of single precision


@functools.cache
def leg_response(robot: Robot) -> np.ndarray:
    """Returns the accelerations of the first limb's joints per torque (L, L), 1/(kg m^2).

    They are magnitudes, in the default pose. L is `Robot.limb`.
    """
    model = build_robot(robot, 0, visual=False).compile()
    data = mujoco.MjData(model)
    matrix = np.zeros((model.nv, model.nv))
    joints = [model.joint(name) for name in robot.joint_names]
    data.qpos[[joint.qposadr[0] for joint in joints]] = robot.default_joints
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, matrix)
    limb = [joint.dofadr[0] for joint in joints[: robot.limb]]
    return np.abs(np.linalg.inv(matrix)[np.ix_(limb, limb)])


def stands(robot: Robot) -> bool:
    """Returns whether a robot holds its default pose for 2 s after a drop as at a reset."""
    spec = build_robot(robot, 0, visual=False, torque_control=True)
    bits = 0xFFFF
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    spec.worldbody.add_geom(type=plane, size=[0, 0, 1], contype=bits, conaffinity=bits)
    spec.option.timestep = 0.005
    model = spec.compile()
    data = mujoco.MjData(model)
    joints = [model.joint(name) for name in robot.joint_names]
    place = [joint.qposadr[0] for joint in joints]
    speed = [joint.dofadr[0] for joint in joints]
    data.qpos[2] = DROP * robot.stand_height
    data.qpos[place] = robot.default_joints
    for _ in range(400):
        wanted = robot.kp * (robot.default_joints - data.qpos[place])
        torque = wanted - robot.kd * data.qvel[speed]
        data.qfrc_applied[speed] = np.clip(torque, -robot.torque_limit, robot.torque_limit)
        mujoco.mj_step(model, data)
    level = data.xmat[1].reshape(3, 3)[2, 2]
    return bool(data.qpos[2] > 0.8 * robot.stand_height and level > 0.985)


class Run(NamedTuple):
    """The joints of consecutive robots of one kind, limb after limb."""

    joints: slice
    """Which of all joints."""
    response: np.ndarray
    """Accelerations of a limb's joints per torque (L, L), 1/(kg m^2)."""


@dataclasses.dataclass(frozen=True)
class Motors:
    """The motors of the robots in a compiled scene, all J joints."""

    joint_qpos: np.ndarray  # joint angles in qpos (J,)
    joint_qvel: np.ndarray  # joint velocities in qvel (J,)
    speed: np.ndarray  # speed limits V (J,), rad/s
    torque: np.ndarray  # torque limits of the controller L (J,), N m
    stall: np.ndarray  # stall torques S (J,), N m
    runs: tuple[Run, ...]  # of all joints, in order
    timestep: float  # physics step, s

    @classmethod
    def of(cls, robots: Fleet, index: RobotIndex, timestep: float) -> "Motors":
        """Returns the motors of all robots of a scene.

        Its actuators must be in the order of the robots' joints.
        """
        actuator = index.actuator[robots.has_joint]
        assert np.array_equal(actuator, np.arange(actuator.size))

        def per_joint(name: str) -> np.ndarray:
            return robots.table(name)[robots.has_joint].astype(np.float32)

        runs = []
        first = 0
        for robot, alike in itertools.groupby(robots):
            last = first + robot.num_joints * len(list(alike))
            runs.append(Run(slice(first, last), leg_response(robot).astype(np.float32)))
            first = last
        return cls(
            joint_qpos=index.joint_qpos[robots.has_joint],
            joint_qvel=index.joint_qvel[robots.has_joint],
            speed=np.minimum(per_joint("joint_speed_limit"), np.float32(UNLIMITED)),
            torque=per_joint("torque_limit"),
            stall=per_joint("stall_torque"),
            runs=tuple(runs),
            timestep=timestep,
        )

    def limit(
        self, xp: Any, ctrl: Any, position: Any, velocity: Any, gain: Any, bias: Any
    ) -> tuple[Any, Any]:
        """Returns control and armature (..., J) of one physics step, with the motors' torques.

        The control is `ctrl` if the motors can give its torque. The armature is in kg m^2.

        Args:
            xp: numpy or jax.numpy.
            ctrl: control, rad or N m (..., J).
            position: joint angles (..., J), rad.
            velocity: joint velocities (..., J), rad/s.
            gain: of the actuators, whose force is gain x ctrl + bias (..., J).
            bias: its constant, position and velocity coefficients (..., J, 3).
        """
        pace = xp.abs(velocity)
        below = self.speed - pace
        steepest = xp.minimum(self._line * below, self._brake * below)
        most = xp.maximum(xp.minimum(steepest, self.torque), -self.torque)  # in the direction of v
        sign = xp.where(velocity < 0, np.float32(-1.0), np.float32(1.0))
        force = _force(ctrl, position, velocity, gain, bias)
        given = sign * xp.minimum(xp.maximum(sign * force, -self.torque), most)
        ctrl = ctrl + (given - force) / xp.where(gain == 0, 1, gain)
        return ctrl, self._armature(xp, pace, xp.abs(given), given * sign < 0)

    def idle(self, ctrl: Any, position: Any, velocity: Any, gain: Any, bias: Any) -> np.ndarray:
        """Returns where `limit` surely returns `ctrl` itself and no armature (...,) bool.

        The arrays are those of `limit`, of numpy.

        This takes less time. The torques' magnitudes must be at most L and S (1 - |v| / V), and
        speeds below those at which armature begins, by a margin for rounding. Some braking and
        numbers that are not finite fail too.
        """
        pace = np.abs(velocity)
        effort = np.abs(_force(ctrl, position, velocity, gain, bias))
        idle = effort <= np.minimum(self._light * (self.speed - pace), self.torque)
        idle &= pace <= self._slow
        pace += self._kick(np, effort)
        idle &= pace <= self._near
        return idle.all(axis=-1)

    def _kick(self, xp: Any, effort: Any) -> Any:
        """Returns the speeds (..., J), rad/s, that torques can add in a physics step.

        `effort` are the torques' magnitudes (..., J), N m.
        """
        return _join(xp, [self._kick_of(xp, effort[..., run.joints], run) for run in self.runs])

    def _kick_of(self, xp: Any, effort: Any, run: Run) -> Any:
        size = len(run.response)
        legs = effort.reshape(-1, size)
        added = self.timestep * run.response
        if xp is np:
            return (legs @ added).reshape(effort.shape)
        # A GPU computes sums of products together with what precedes and follows them, a matrix
        # product on its own.
        total = legs[:, :1] * added[0]
        for i in range(1, size):
            total += legs[:, i : i + 1] * added[i]
        return total.reshape(effort.shape)

    def _haste(self, xp: Any, pace: Any) -> Any:
        """Returns the share (..., J) of the complete armature that the speed of a limb calls for.

        `pace` are magnitudes of speeds.
        """
        parts = []
        for run in self.runs:
            size = len(run.response)
            own = pace[..., run.joints]
            fastest = functools.reduce(xp.maximum, [own[..., i::size] for i in range(size)])
            lowest = self._leg_speed[..., run.joints][..., ::size]
            near = (fastest / lowest - SLOW) / (FAST - SLOW)
            parts.append(xp.repeat(xp.clip(near, 0.0, 1.0), size, axis=-1))
        return _join(xp, parts)

    def _armature(self, xp: Any, pace: Any, effort: Any, against: Any) -> Any:
        """Returns the armature (..., J), kg m^2.

        `pace` and `effort` are magnitudes of speeds and torques, `against` says which are opposed.
        """
        haste = self._haste(xp, pace)
        reach = (pace + self._kick(xp, effort)) / self.speed
        if xp is np and haste.max() <= 0.0 and reach.max() <= REACH and not self._steep.any():
            return np.zeros_like(pace)
        beyond = (reach > REACH).astype(np.float32)
        needed = xp.minimum(self._needed * (reach - 1.0), self._full) * beyond
        if self._steep.any():
            line = self._line * (self.speed + xp.where(against, pace, -pace))
            share = xp.minimum(effort / xp.maximum(line, ROUNDING), 1.0)  # of the line's torque
            implicit = share * (self._inertia + self.timestep * self._line) - self._inertia
            needed = xp.where(self._steep, xp.maximum(implicit, 0.0), needed)
        return xp.maximum(haste * self._full, needed)

    @functools.cached_property
    def constants(self) -> np.ndarray:
        """What `limit` and `clamp` know of each joint (J, 10), for kernels that do the same.

        The columns: V, L, greatest speed, slopes of the torque line and of braking, complete
        armature, armature beyond the limit, inertia, lowest V of the leg, whether the line is too
        steep.
        """
        columns = (
            self.speed,
            self.torque,
            self.fastest,
            self._line,
            self._brake,
            self._full,
            self._needed,
            self._inertia,
            self._leg_speed,
            self._steep,
        )
        return np.stack(columns, axis=-1).astype(np.float32)

    @functools.cached_property
    def fastest(self) -> np.ndarray:
        """Greatest speeds after a physics step (..., J), rad/s."""
        return np.float32(CLAMP) * self.speed

    @functools.cached_property
    def _line(self) -> np.ndarray:
        """Slope of the torque line (..., J), N m s; smaller than `_brake`."""
        return self.stall / self.speed

    @functools.cached_property
    def _inertia(self) -> np.ndarray:
        """Inertia of each joint in a free leg (..., J), kg m^2."""
        limbs = []
        for run in self.runs:
            own = self.speed[..., run.joints].shape
            count = own[-1] // len(run.response)
            limbs.append(np.tile(1.0 / np.diag(run.response), (*own[:-1], count)))
        return _join(np, limbs)

    @functools.cached_property
    def _steep(self) -> np.ndarray:
        """Joints whose torque line is too steep for explicit integration (..., J) bool."""
        return self.timestep * self._line > STEEP * self._inertia

    @functools.cached_property
    def _light(self) -> np.ndarray:
        """Slope of the torques without armature (..., J), N m s.

        It is less than `_line` where that is steep.
        """
        share = self._inertia / (self._inertia + self.timestep * self._line)
        share = np.where(self._steep, np.float32(1.0 - ROUNDING) * share, np.float32(1.0))
        return share * self._line

    @functools.cached_property
    def _brake(self) -> np.ndarray:
        """Slope of the braking torque (..., J), N m s."""
        return self.torque / (BAND * self.speed)

    @functools.cached_property
    def _full(self) -> np.ndarray:
        """Complete armature (..., J), kg m^2."""
        return self.timestep * self._brake

    @functools.cached_property
    def _needed(self) -> np.ndarray:
        """Armature per share of the speed limit beyond it (..., J), kg m^2."""
        return np.float32(GAIN) * self._inertia

    @functools.cached_property
    def _leg_speed(self) -> np.ndarray:
        """Lowest speed limit of each joint's limb (..., J), rad/s."""
        limbs = []
        for run in self.runs:
            own = self.speed[..., run.joints]
            rows = own.reshape(*own.shape[:-1], -1, len(run.response))
            limbs.append(np.repeat(rows.min(axis=-1), len(run.response), axis=-1))
        return _join(np, limbs)

    @functools.cached_property
    def _slow(self) -> np.ndarray:
        """Speeds (..., J), rad/s, below which a leg has no armature for its speed."""
        return np.float32((1.0 - ROUNDING) * SLOW) * self._leg_speed

    @functools.cached_property
    def _near(self) -> np.ndarray:
        """Speeds (..., J), rad/s, below which a joint has no armature for its speed and torque.

        Its torque cannot carry it beyond them.
        """
        speed = np.where(self._steep, np.float32(np.inf), self.speed)
        return np.float32((1.0 - ROUNDING) * REACH) * speed

    def repeat(self, count: int) -> "Motors":
        """Returns the motors with arrays (count, J).

        Numpy is faster with them than with broadcast ones.
        """
        return dataclasses.replace(
            self,
            speed=np.tile(self.speed, (count, 1)),
            torque=np.tile(self.torque, (count, 1)),
            stall=np.tile(self.stall, (count, 1)),
        )

    def clamp(self, position: Any, velocity: Any) -> tuple[Any, Any]:
        """Returns joint angles and velocities (..., J) after a physics step.

        Their speeds are at most `fastest`.
        """
        clamped = velocity.clip(-self.fastest, self.fastest)
        return position - self.timestep * (velocity - clamped), clamped


def _force(ctrl: Any, position: Any, velocity: Any, gain: Any, bias: Any) -> Any:
    """Returns the forces (..., J), N m, of actuators without limits; arguments as of `limit`."""
    return gain * ctrl + bias[..., 0] + bias[..., 1] * position + bias[..., 2] * velocity


def _join(xp: Any, parts: Sequence[Any]) -> Any:
    """Returns the parts of all runs (..., n) in one array (..., J)."""
    return parts[0] if len(parts) == 1 else xp.concatenate(parts, axis=-1)
