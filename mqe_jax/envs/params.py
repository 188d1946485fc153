"""The parameters that all tasks have."""

from __future__ import annotations

import dataclasses

from mqe_jax.control import check_commands
from mqe_jax.envs.overrides import Range
from mqe_jax.envs.randomization import Randomization

CLEARANCE = 0.3  # m, from the ground to the trunk of a robot that stands


@dataclasses.dataclass(frozen=True)
class TaskParams:
    """Parameters that all tasks have; a task adds its own.

    Attributes:
        num_agents: robots that are told what to do.
        episode_length: time limit, s.
        spawn_height: of the trunks, m.
        spawn_noise: half-width of the uniform noise on the spawn position in x and y, m.
        spawn_joint_scale: the joints start at their default angles times a factor from this range.
        spawn_velocity: half-width of the uniform noise on all six base velocities, m/s and rad/s.
        max_roll: an episode ends when any |roll| is greater, rad.
        max_pitch: likewise |pitch|, rad; pitch is an arcsine, so that a limit over pi / 2, as the released system has
            it, is never met: a robot that turns over pitching shows a roll of pi.
        min_height: an episode ends when any trunk is lower, m.
        max_height: likewise higher, m.
        end_on_collision: an episode ends when any trunk touches anything with more than `collision_force`.
        collision_force: N, read after the last physics step of an environment step.
        gait: of the walk policy: trot, pronk, bound or pace.
        commands: the walk commands that the action sets, in order.
        walk_policy: weights file of the walk policy; the package's own if None.
        actuator_network: weights file of an actuator network in place of PD; none if None.
        friction: sliding friction of robots and ground.
        solver_iterations: at most so many solver iterations per physics step.
        contacts_per_robot: room for contacts, times the robots of a world: of a world on MJX-JAX, which keeps the
            deepest ones, and of all worlds together on Warp.
        constraints_per_robot: room for constraint rows of a world on Warp, likewise.
        randomization: domain randomisation.
        frozen_time: a training aid, on only where a trainer sets `State.aid`: one agent, drawn at reset, stands still
            for up to frozen_time x aid, s, so that agents first learn one at a time what they must do in turn.
    """

    num_agents: int = 2
    episode_length: float = 10.0
    spawn_height: float = 0.42
    spawn_noise: float = 0.1
    spawn_joint_scale: Range = (0.7, 1.3)
    spawn_velocity: float = 0.5
    max_roll: float = 0.8
    max_pitch: float = 1.6
    min_height: float = -1.0
    max_height: float = 100.0
    end_on_collision: bool = False
    collision_force: float = 1.0
    gait: str = "trot"
    commands: tuple[str, ...] = ("vx", "vy", "yaw_rate")
    walk_policy: str | None = None
    actuator_network: str | None = None
    friction: float = 1.0
    solver_iterations: int = 4
    contacts_per_robot: int = 12
    constraints_per_robot: int = 64
    randomization: Randomization = Randomization()
    frozen_time: float = 4.0

    def __post_init__(self) -> None:
        for name in (
            "episode_length",
            "collision_force",
            "friction",
            "solver_iterations",
            "contacts_per_robot",
            "constraints_per_robot",
        ):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name}: {getattr(self, name)} must be positive")
        check_commands(self.commands)


def check_above(spawn_height: float, top: float) -> None:
    """Raises a ValueError if robots would start inside what they are to stand on, whose top is at `top` m."""
    least = top + CLEARANCE
    if spawn_height < least:
        raise ValueError(f"spawn_height: {spawn_height} must be at least {least:.2f}, as the ground is at {top}")
