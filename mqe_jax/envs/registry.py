"""Registry of tasks and their scripted policies; a new task is one line in `SHIPPED`.

A task's module is imported when its class is asked for, so that listing tasks imports neither JAX
nor MuJoCo. Installed packages register tasks by entry points (`load_packages`).
"""

from __future__ import annotations

import functools
import os
from collections import UserDict
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

from mqe_jax.core import imports
from mqe_jax.core.errors import InputError, known_name
from mqe_jax.core.lazy import load
from mqe_jax.core.literal import echo
from mqe_jax.core.settings import check_call, checked, fail

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

    import jax

    from mqe_jax.envs.base import QuadrupedEnv

ScriptedPolicy: TypeAlias = Callable[[dict[str, "jax.Array"]], "jax.Array"]
"""Scripted policy: one team's blocks (A, width) by name -> actions (A, 3) in mode `command`."""


class Shipped(NamedTuple):
    """A task of the package, with what `mqe tasks` lists of it."""

    task: str
    """MODULE:CLASS of mqe_jax.envs."""
    scripted: str | None
    """Scripted policy, MODULE:FUNCTION of mqe_jax.policies.scripted."""
    title: str
    """Its class's `title`."""
    teams: tuple[int, ...]
    """Number of agents of each team."""
    observation: int
    """Length of an agent's observation."""
    privileged: int
    """Length of the privileged observation."""
    time_limit: float
    """Time limit, s."""
    sizes: tuple[int, int] | None = None
    """Least and greatest `num_agents`, which must be even in matches; None if it is fixed."""


SHIPPED = {
    "go1plane": Shipped("plane:Go1Plane", None, "Plane", (2,), 14, 91, 10.0, (1, 64)),
    "go1gate": Shipped(
        "gate:Go1Gate", "cooperative:plan_gate", "Narrow Gate", (2,), 16, 93, 10.0, (1, 64)
    ),
    "go1seesaw": Shipped(
        "seesaw:Go1Seesaw", "cooperative:plan_seesaw", "Climb on Seesaw", (2,), 14, 93, 10.0
    ),
    "go1sheep-easy": Shipped(
        "sheep:Go1SheepEasy",
        "cooperative:plan_sheep_easy",
        "Sheep Dog (Easy)",
        (2,),
        18,
        97,
        15.0,
        (1, 64),
    ),
    "go1sheep-hard": Shipped(
        "sheep:Go1SheepHard",
        "cooperative:plan_sheep_hard",
        "Sheep Dog (Hard)",
        (2,),
        34,
        129,
        15.0,
        (1, 64),
    ),
    "go1pushbox": Shipped(
        "pushbox:Go1PushBox", "cooperative:plan_pushbox", "Push Box", (2,), 22, 106, 15.0, (1, 64)
    ),
    "go1football-defender": Shipped(
        "football_defender:Go1FootballDefender",
        "football:plan_defender",
        "Football (2 vs 1)",
        (2,),
        20,
        153,
        20.0,
    ),
    "go1tug": Shipped("tug:Go1Tug", "matches:plan_tug", "Push Cylinder", (1, 1), 10, 93, 15.0),
    "go1revolvingdoor": Shipped(
        "door:Go1RevolvingDoor",
        "matches:plan_revolving_door",
        "Revolving Door",
        (1, 1),
        12,
        95,
        5.0,
    ),
    "go1wrestling": Shipped(
        "wrestling:Go1Wrestling",
        "matches:plan_wrestling",
        "Sumo Wrestling",
        (1, 1),
        12,
        91,
        15.0,
        (2, 10),
    ),
    "go1bridge": Shipped(
        "bridge:Go1Bridge", "matches:plan_bridge", "Traverse Bridge", (1, 1), 12, 91, 20.0
    ),
    "go1football-1vs1": Shipped(
        "football:Go1Football1vs1",
        "football:plan_match",
        "Football (1 vs 1)",
        (1, 1),
        19,
        108,
        20.0,
        (2, 64),
    ),
    "go1football-2vs2": Shipped(
        "football:Go1Football2vs2",
        "football:plan_match",
        "Football (2 vs 2)",
        (2, 2),
        32,
        198,
        20.0,
        (2, 64),
    ),
}
"""The package's tasks by id, with default parameters."""

# Alternative ids, from the released system.
ALIASES = {"go1bridgewrestling": "go1wrestling"}

_LOADED: set[EntryPoint] = set()


class _Tasks(UserDict[str, Any]):
    """Task classes by id, of which the shipped ones are imported on demand."""

    def __getitem__(self, name: str) -> type[QuadrupedEnv]:
        if self.data[name] is None:
            self.data[name] = load(f"mqe_jax.envs.{SHIPPED[name].task}")
        return self.data[name]


TASKS = _Tasks(dict.fromkeys(SHIPPED))
"""Task classes by id."""

SCRIPTED: dict[str, ScriptedPolicy | str] = {
    name: task.scripted for name, task in SHIPPED.items() if task.scripted is not None
}
"""Scripted policies by task id; MODULE:FUNCTION if shipped, as `envs` imports no `policies`."""

NAMED_SCRIPTED: dict[str, dict[str, ScriptedPolicy | str]] = {
    "go1sheep-hard": {"by-distance": "cooperative:plan_sheep_by_distance"}
}
"""Further scripted policies by task id and name (`--policy NAME`, `--opponent NAME`); shipped ones
as in `SCRIPTED`."""


NAMES = ("scripted", "random", "idle", "forward")
"""Policies of all tasks: scripted, uniform random actions, zero actions, half speed ahead."""

REGISTERED: list[Callable[[], None]] = []
"""What `register_task` calls: the adapters make the task known to their libraries."""


@checked
def register_scripted(task: str, name: str, policy: ScriptedPolicy) -> None:
    """Registers a further scripted policy of a task under a name that no other one has.

    The policy is a function of the observation blocks of one team in one environment: arrays (A,
    width) by name, as `mqe tasks TASK` lists them. It returns actions (A, 3) in [-1, 1], which are
    shares of vx, vy and yaw rate in their default ranges: 1 is 1 m/s in every skill and with any
    `command_ranges`. (To a function `act(obs, memory, key)`, actions are shares of the ranges that
    the environment has.) It is compiled: it uses `jax.numpy`, and what it captures, such as
    weights, is constant.

    Example:
        ```python
        from mqe_jax.envs.registry import register_scripted

        register_scripted("go1tug", "wait", lambda obs: jax.numpy.zeros((len(obs["base"]), 3)))
        policy = mqe_jax.load_policy("wait", mqe_jax.make("go1tug"))
        ```

    Raises:
        InputError: for an unknown task, a name that is taken, or a function of other arguments.
    """
    if not name:
        fail("name", name, "a text that is not empty")
    known_name("task: unknown", task, TASKS)
    if name in NAMES or name in TASKS:
        fail("name", name, "another one: it is that of a policy of the package")
    check_call(f"policy {name!r}", policy, "obs")
    if NAMED_SCRIPTED.setdefault(task, {}).setdefault(name, policy) is not policy:
        raise InputError(f"policy: the name {name!r} is already registered for {task}")


@checked
def register_task(
    task: type[QuadrupedEnv], scripted: ScriptedPolicy | None = None
) -> type[QuadrupedEnv]:
    """Registers a task class under its `name` for `make` and the command line.

    `scripted` is its scripted policy, if it has one.

    Also a class decorator. InputError if it is no class of tasks, has no name, or another class has
    that name.
    """
    from mqe_jax.envs.base import QuadrupedEnv

    if not (isinstance(task, type) and issubclass(task, QuadrupedEnv)):
        fail("task", task, "a class derived from QuadrupedEnv")
    if not task.name:
        raise InputError(
            f"task {task.__name__}: its `name` is empty; give it an id such as 'go1catch'"
        )
    known = TASKS.get(task.name)
    if known is not None and (known.__module__, known.__qualname__) != (
        task.__module__,
        task.__qualname__,
    ):
        raise InputError(
            f"task {task.__name__}: the id {task.name!r} is already registered by {known.__name__}"
        )
    TASKS[task.name] = task
    if scripted is not None:
        SCRIPTED[task.name] = scripted
    for known_to in REGISTERED:
        known_to()
    return task


@functools.cache
def packages() -> tuple[EntryPoint, ...]:
    """Returns the entry points `mqe_jax.tasks` of installed packages, without importing them."""
    from importlib.metadata import entry_points  # 20 ms

    return tuple(entry_points(group="mqe_jax.tasks"))


def load_packages() -> None:
    """Imports the entry points of installed packages, once; a class of tasks is registered.

    A line on standard error names a package that fails.
    """
    for entry in packages():
        if entry in _LOADED:
            continue
        _LOADED.add(entry)
        try:
            found = entry.load()
            if isinstance(found, type):
                register_task(found)
        except (Exception, SystemExit) as error:
            owner = entry.dist.name if entry.dist else entry.value
            why = imports.reason(error)
            echo(f"mqe: warning: the package {owner} does not register its tasks: {why}")


def listed() -> dict[str, Shipped]:
    """Returns what `mqe tasks` lists: of shipped tasks from here, of others from an environment.

    A line on standard error names a task whose environment cannot be made.
    """
    found = dict(SHIPPED)
    for name in TASKS.keys() - SHIPPED.keys():
        try:
            env = TASKS[name](num_envs=1, impl="c")
        except Exception as error:
            echo(f"mqe: warning: the task {name} is not listed: {imports.reason(error)}")
            continue
        teams = tuple(len(team) for team in env.teams)
        sizes = env.observation_size, env.privileged_observation_size
        found[name] = Shipped("", None, env.title, teams, *sizes, env.params.episode_length)
    return found


def task_id(name: str) -> str:
    """Returns the id for which an id or an alias stands; InputError for an unknown one.

    An unknown id imports the packages of `load_packages`.

    Example:
        ```python
        from mqe_jax.envs.registry import task_id

        print(task_id("go1bridgewrestling"))  # go1wrestling
        ```
    """
    name = ALIASES.get(name, name)
    if name not in TASKS:
        load_packages()
    own = "or one that register_task adds in this process (mqe: --import FILE)"
    return known_name("task: unknown id", name, (*TASKS, own))


def find_task(target: str) -> str | None:
    """Returns the id of a task that is named by id or alias; None for the path of a run or a file.

    InputError for an unknown id.
    """
    if ALIASES.get(target, target) not in TASKS:
        if os.sep in target:
            return None
        load_packages()
        if target not in TASKS and Path(target).exists():
            return None
    return task_id(target)
