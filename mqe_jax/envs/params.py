"""Parameters common to all tasks."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, Literal, Self, TypeVar

import numpy as np
import pydantic

from mqe_jax import skills, walk_policy  # noqa: F401  (skills register themselves)
from mqe_jax.core.files import digest
from mqe_jax.core.limits import (
    Buffer,
    Coordinate,
    Distance,
    Fraction,
    Iterations,
    Length,
    Positive,
    PositiveFriction,
    Robots,
    Tilt,
    Time,
    TimeLimit,
    Velocity,
    bounds,
)
from mqe_jax.core.settings import (
    FileName,
    FrozenMapping,
    Range,
    check,
    fail,
    override,
    settings_class,
)
from mqe_jax.envs.randomization import NamedRandomization, Randomization
from mqe_jax.physics import robots
from mqe_jax.physics.robots.fleet import Fleet
from mqe_jax.physics.robots.robot import Proportions, Robot
from mqe_jax.sensors.suite import Senses
from mqe_jax.skills import agile  # noqa: F401  (skills register themselves)
from mqe_jax.skills.control import Commander


def _check_files(value: Any) -> Any:
    several = isinstance(value, list | tuple)
    return check("skill_weights", value, tuple[_File, ...] if several else _File)


_File = FileName | None
Weights = Annotated[_File | tuple[_File, ...], pydantic.PlainValidator(_check_files)]
"""A weights file or none, or several."""


@settings_class
class TaskParams:
    """Parameters common to all tasks; a task adds its own.

    Example:
        ```python
        params = mqe_jax.make("go1gate", episode_length=20.0).params
        print(params.robot, params.action_ranges()["vx"])  # go1 (-1.0, 1.0)
        ```
    """

    num_agents: Robots = 2
    """Number of controlled robots; in a match those of both teams."""
    fewest_agents: Robots | None = None
    """Fewest robots that take part in an episode, in a match those of both teams. Reset draws the
    number, at most `num_agents`, and parks the other robots. None: all take part."""
    growing: bool = False
    """Curriculum: agents first learn in small teams. At `State.assistance` 1 only the fewest robots
    or sheep are drawn; the highest number grows linearly to all at assistance 0."""
    robot: str = "go1"
    """Robot: go1, go2, or another registered name; an MJCF, or a YAML that names one; or
    menagerie:NAME."""
    robots: tuple[str, ...] = ()
    """Unlike robots: a name or file for each robot, in a match possibly one for each team; `robot`
    is then left out. Parameters that follow a body follow the largest. Empty: all are `robot`."""
    episode_length: TimeLimit = 10.0
    """Time limit, s, rounded to environment steps (0.02 s)."""
    spawn_height: Length = 0.42
    """Spawn height of the trunks, m."""
    spawn_noise: Distance = 0.1
    """Half-width of the uniform noise on the spawn position in x and y, m."""
    spawn_joint_scale: Range = (0.7, 1.3)
    """Range of the factor on the default joint angles at reset."""
    spawn_velocity: Velocity = 0.5
    """Half-width of the uniform noise on all six base velocities, m/s and rad/s."""
    max_roll: Tilt = 0.8
    """Maximum |roll|, rad; above it the episode terminates."""
    max_pitch: Tilt = 1.6
    """Maximum |pitch|, rad; above it the episode terminates. Pitch is an arcsine, so it never
    reaches the released system's limit, which is above pi / 2. A robot that pitches over has a roll
    of pi."""
    min_height: Coordinate = -1.0
    """Minimum trunk height, m; below it the episode terminates."""
    max_height: Coordinate = 100.0
    """Maximum trunk height, m; above it the episode terminates."""
    end_on_collision: bool = False
    """Whether a contact force on an agent's trunk above `collision_force` ends the episode."""
    collision_force: Positive = 1.0
    """Threshold of contact forces on the trunk in the last physics step of an environment step,
    N."""
    skill: str | tuple[str, ...] = "walk"
    """Skill of the agents with control `command` (`mqe_jax.skills`). With several, a further action
    entry chooses one (`mqe_jax.skills.choice`)."""
    skill_weights: Weights = None
    """Weights file of the skill; the shipped one if None. With `robots`, one for each of them."""
    gait: str | None = None
    """Name of default commands of the skill. The walk policy has trot, pronk, bound and pace; None:
    trot."""
    commands: tuple[str, ...] = ("vx", "vy", "yaw_rate")
    """Commands of the skill that the action sets, in order."""
    command_ranges: Mapping[str, Range] = FrozenMapping()
    """Lowest and highest value of these commands, by name; others have the skill's default ranges.
    Scripted policies keep the default ranges."""
    position_scale: Positive = 1.0
    """Factor on the range of the joint targets with control `position`; at 1 they are within 0.25
    rad of the default joint angles, hips within 0.125 rad."""
    actuator_network: FileName | None = None
    """Weights file of an actuator network that replaces PD control; PD control if None."""
    friction: PositiveFriction = 1.0
    """Sliding friction of robots and ground."""
    joint_mechanics: bool = False
    """Whether the joints have the robot's rotor inertia, damping and dry friction."""
    solver_iterations: Iterations = 4
    """Maximum solver iterations per physics step."""
    sparse_solver: bool | None = None
    """Whether the solver on Warp skips the zeros between robots that do not touch; results are
    equal up to rounding. None: in scenes with more than 80 degrees of freedom, of which a robot has
    18. The other engines ignore it."""
    contacts: Literal["full", "minimal"] = "full"
    """Set of the robots' collision geoms: full, or minimal (trunk and feet), which is several times
    faster on MJX-JAX and disables limb collisions."""
    contacts_per_robot: Buffer = 12
    """Contact buffer size per robot. MJX-JAX has a buffer per environment and keeps the deepest
    contacts; on Warp all environments share one."""
    constraints_per_robot: Buffer = 64
    """Constraint buffer size per robot on Warp, per environment."""
    privileged_contact_forces: bool = False
    """Whether the privileged observation includes the contact forces on trunks and feet; their
    sensors cost about 8% of the throughput."""
    randomization: NamedRandomization = Randomization()
    """Domain randomisation: ranges by name, or a set of them, `robust`."""
    senses: Senses = ()
    """Sensors, whose readings are the group of observations `onboard`: the set `onboard`, `full`
    (no sensors), or a list of names and mappings of settings.
    """
    frozen_time: Time = 4.0
    """Curriculum: one agent, sampled at reset, is frozen for up to frozen_time x
    `State.assistance`, s. Agents first learn sequential subtasks one at a time. If the number of
    robots varies, mates do not observe the frozen one: they learn to act as a smaller team.
    Inactive at assistance 0."""
    shaping_floor: Fraction = 1.0
    """Factor at assistance 0 on the reward terms whose weight is 0 by default; it is 1 at
    assistance 1."""

    def __post_init__(self) -> None:
        if self.robots and self.robot != type(self).robot:
            fail("robot", self.robot, f"left out beside robots, {self.robots}")
        self._check_weights()
        commander = self.commander
        commander.skill.check_commands(commander.commands)
        commander.skill.changes(self.commands, self.command_ranges, commander.default_commands)
        least = self.ground + max(kind.stand_height for kind in self.kinds)
        if self.spawn_height < least:
            allowed = f"at least {least:.2f}, because the supporting surface is at {self.ground}"
            fail("spawn_height", self.spawn_height, allowed)
        if self.min_height >= self.spawn_height:
            fail("min_height", self.min_height, f"less than spawn_height, {self.spawn_height}")
        if self.max_height <= self.spawn_height:
            fail("max_height", self.max_height, f"greater than spawn_height, {self.spawn_height}")

    @property
    def ground(self) -> float:
        """Height of the surface on which robots start, m."""
        return 0.0

    def scaled(self, body: Proportions) -> dict[str, Any]:
        """Returns the values of the parameters that follow a robot's body, by name.

        `self` has those for a Go1. A task adds its own.
        """
        names = ("spawn_height", "min_height")
        above = {name: getattr(self, name) - self.ground for name in names}
        return {
            name: self.ground + value * body.height if value > 0.0 else getattr(self, name)
            for name, value in above.items()
        }

    @property
    def kinds(self) -> tuple[Robot, ...]:
        """The robots that differ, in the order of their first appearance."""
        names = dict.fromkeys(self.robots or (self.robot,))
        return tuple(dict.fromkeys(robots.get(name) for name in names))

    def _check_weights(self) -> None:
        """Raises an InputError unless each kind of robots has its own weights of the skill."""
        files = self.skill_weights
        if isinstance(files, tuple) != bool(files and self.robots):
            fail("skill_weights", files, "a file, or with robots a list, one for each of them")
        if isinstance(files, tuple):
            given = dict.fromkeys(zip(map(robots.get, self.robots), files, strict=False))
            if len(files) != len(self.robots) or len(given) != len(self.kinds):
                fail("skill_weights", files, "one for each of robots, equal for equal ones")

    def weights_of(self, robot: Robot) -> str | None:
        """Returns the weights file of the skill of a robot, None for the shipped one."""
        if not isinstance(self.skill_weights, tuple):
            return self.skill_weights
        return self.skill_weights[[robots.get(name) for name in self.robots].index(robot)]

    @classmethod
    def suited(cls, *names: str) -> Self:
        """Returns the defaults for a robot, or for unlike ones.

        InputError as of `mqe_jax.physics.robots.get`.
        """
        usual = cls()
        body = largest(robots.get(name) for name in names)
        scaled = {} if body == Proportions() else usual.scaled(body)
        plain = {name: np.round(value, 3).tolist() for name, value in scaled.items()}
        own = {"robot": names[0]} if len(names) == 1 else {"robots": names}
        return override(usual, {**own, **plain})

    def changed(self, changes: Mapping[str, Any]) -> Self:
        """Returns the parameters with changes by name.

        With other robots, values that follow their bodies and are the defaults become those of
        the new ones, unless they are among the changes.
        """
        if "robot" not in changes and "robots" not in changes:
            return override(self, changes)
        usual = {"robot": type(self).robot, "robots": ()}
        given = {**usual, **changes}
        check("robot", given["robot"], str)
        check("robots", given["robots"], tuple[str, ...])
        names = map(str, given["robots"] or [given["robot"]])
        before = self.suited(*(self.robots or (self.robot,)))
        after = self.suited(*names)
        follow = {
            name: getattr(after, name)
            for name in self.scaled(Proportions())
            if getattr(self, name) == getattr(before, name)
        }
        return override(self, {**usual, **follow, **changes})

    @property
    def commander(self) -> Commander:
        """What actions mean with control `command`; the smallest robot sets the ranges."""
        smallest = min(self.kinds, key=lambda kind: kind.proportions.height)
        skill = skills.make(self.skill, smallest)
        commands = (*self.commands, *skill.selector)
        return Commander(skill, commands, skill.default_commands(self.gait), self.command_ranges)

    def action_ranges(self) -> dict[str, tuple[float, float]]:
        """Returns the range of each command that the action sets, in the command's unit."""
        commander = self.commander
        limits = np.round(np.asarray(commander.limits, float), 6).tolist()
        pairs = zip(commander.commands, limits, strict=True)
        return {name: (low, high) for name, (low, high) in pairs}

    def actions(self, control: str) -> dict[str, Any]:
        """Returns what an agent's actions mean in a control mode, by names of parameters."""
        names = self.robots or (self.robot,)
        robot = Fleet(robots.get(name) for name in names).identity
        meaning: dict[str, Any] = {"robot": robot, "control": control}
        if control == "command":
            gait = self.gait or next(iter(self.commander.skill.gaits), None)
            ranges = self.action_ranges()
            meaning |= {"skill": self.skill, "gait": gait, "commands": self.commands}
            meaning["command_ranges"] = {name: ranges[name] for name in self.commands}
        if control == "position":
            meaning["position_scale"] = self.position_scale
        return meaning

    def commanded_text(self) -> str:
        """Returns the skill and these ranges, such as `walk: vx -1 to 1`."""
        ranges = self.action_ranges().items()
        texts = [f"{name} {low:g} to {high:g}" for name, (low, high) in ranges]
        skill = self.skill if isinstance(self.skill, str) else " or ".join(self.skill)
        return f"{skill}: {', '.join(texts)}"


def weights_digest(files: str | Sequence[str | None] | None) -> str | None:
    """Returns the SHA-256 of a weights file, or of several; None for the shipped ones."""
    if files is None or isinstance(files, str):
        return files and digest(files)
    return " ".join(digest(file) if file else "shipped" for file in files)


def largest(kinds: Iterable[Robot]) -> Proportions:
    """Returns the greatest height, width, length and mass of robots."""
    sizes = np.array([kind.proportions for kind in kinds])
    return Proportions(*sizes.max(axis=0).tolist())


P = TypeVar("P", bound=TaskParams)
"""Parameters of a task."""


def check_teams(num_agents: int, most: int, room: str) -> None:
    """Raises an InputError unless `num_agents` are two equal teams of at most `most` robots.

    `room` says what limits them.
    """
    most = min(2 * most, int(bounds(Robots)[1]))
    if num_agents % 2 or num_agents > most:
        fail("num_agents", num_agents, f"even, for two equal teams, and at most {most} with {room}")


def check_gap(name: str, width: float, track_width: float) -> None:
    """Raises an InputError unless a gap in a wall fits into the track.

    `name` is the parameter that is the gap's width, m.
    """
    if width >= track_width:
        fail(name, width, f"less than the width of the track, {track_width}")
