"""The parameters that all tasks have."""

from __future__ import annotations

from typing import Literal

from mqe_jax import robots
from mqe_jax.control import check_commands
from mqe_jax.envs.randomization import Randomization
from mqe_jax.errors import InputError
from mqe_jax.settings import NonNegative, Positive, PositiveInt, Range, fail, record


@record
class TaskParams:
    """Parameters that all tasks have; a task adds its own.

    Attributes:
        num_agents: number of controlled robots.
        robot: name of the robot, such as go1 or go2 (`mqe_jax.robots`).
        episode_length: time limit, s.
        spawn_height: of the trunks, m.
        spawn_noise: half-width of the uniform noise on the spawn position in x and y, m.
        spawn_joint_scale: range of the factor on the default joint angles at reset.
        spawn_velocity: half-width of the uniform noise on all six base velocities, m/s and rad/s.
        max_roll: an episode ends when any |roll| is greater, rad.
        max_pitch: likewise |pitch|, rad. Pitch is an arcsine, so a limit above pi / 2, as in the released system, is
            never reached: a robot that turns over by pitching shows a roll of pi.
        min_height: an episode ends when any trunk is lower, m.
        max_height: an episode ends when any trunk is higher, m.
        end_on_collision: whether a contact force on an agent's trunk above `collision_force` ends the episode.
        collision_force: threshold, N, on the forces of the last physics step of an environment step.
        gait: of the walk policy: trot, pronk, bound or pace.
        commands: walk commands that the action sets, in order.
        walk_policy: weights file of the walk policy; the package's own if None.
        actuator_network: weights file of an actuator network that replaces PD control; PD control if None.
        friction: sliding friction of robots and ground.
        solver_iterations: maximum solver iterations per physics step.
        contacts: set of the robots' collision shapes: full, or minimal (trunk and feet), which is several times faster
            on MJX-JAX and disables limb collisions.
        contacts_per_robot: contact buffer size per robot: per environment on MJX-JAX, which keeps the deepest
            contacts, and on average over all environments on Warp.
        constraints_per_robot: constraint buffer size per robot on Warp, per environment.
        privileged_contact_forces: whether the privileged observation includes the contact forces on trunks and feet;
            their sensors cost about 8% of the throughput.
        randomization: domain randomisation.
        frozen_time: curriculum: one agent, sampled at reset, is frozen for up to frozen_time x `State.assistance`, s,
            so that agents first learn sequential subtasks one at a time. Off unless a trainer sets assistance.
    """

    num_agents: PositiveInt = 2
    robot: str = "go1"
    episode_length: Positive = 10.0
    spawn_height: Positive = 0.42
    spawn_noise: NonNegative = 0.1
    spawn_joint_scale: Range = (0.7, 1.3)
    spawn_velocity: NonNegative = 0.5
    max_roll: Positive = 0.8
    max_pitch: Positive = 1.6
    min_height: float = -1.0
    max_height: float = 100.0
    end_on_collision: bool = False
    collision_force: Positive = 1.0
    gait: str = "trot"
    commands: tuple[str, ...] = ("vx", "vy", "yaw_rate")
    walk_policy: str | None = None
    actuator_network: str | None = None
    friction: Positive = 1.0
    solver_iterations: PositiveInt = 4
    contacts: Literal["full", "minimal"] = "full"
    contacts_per_robot: PositiveInt = 12
    constraints_per_robot: PositiveInt = 64
    privileged_contact_forces: bool = False
    randomization: Randomization = Randomization()
    frozen_time: NonNegative = 4.0

    def __post_init__(self) -> None:
        check_commands(self.commands)
        robots.get(self.robot)
        if self.min_height >= self.max_height:
            fail("min_height", self.min_height, f"less than max_height, {self.max_height}")


def check_above(spawn_height: float, top: float, robot: str) -> None:
    """Checks that the spawn height clears the supporting surface at height `top` (m) for a standing robot.

    Raises:
        InputError: if it does not.
    """
    least = top + robots.get(robot).stand_height
    if spawn_height < least:
        raise InputError(f"spawn_height: {spawn_height} must be at least {least:.2f}, as the ground is at {top}")


def check_gap(name: str, width: float, track_width: float) -> None:
    """Checks that the parameter `name`, the width of a gap in a wall across the track, m, fits into the track.

    Raises:
        InputError: if it does not.
    """
    if width >= track_width:
        fail(name, width, f"less than the width of the track, {track_width}")
