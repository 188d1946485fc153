"""The front door: what users name becomes what the program uses, and each file is read once.

`find` reads a policy, `parameters_of` says what policies need of a task, `environment` makes it,
and `fit` lets a policy act in it. `table` does all four for those who play. `settings` does the
first two for those who learn.
"""

import contextlib
import dataclasses
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, overload

from mqe_jax.acting.seats import Act, Policy, Seats, check_policy, title
from mqe_jax.core import devices
from mqe_jax.core.errors import InputError, nearest, warn
from mqe_jax.core.limits import Number
from mqe_jax.core.literal import echo
from mqe_jax.core.settings import (
    FrozenMapping,
    Parameters,
    PathText,
    check,
    check_call,
    checked,
    differences,
    fail,
    merge,
    nested,
    override,
    path_text,
)
from mqe_jax.envs import QuadrupedEnv, VectorEnv, make
from mqe_jax.envs.registry import SCRIPTED, TASKS, find_task, task_id
from mqe_jax.envs.wrappers import Wrapper
from mqe_jax.policies import simple, zoo
from mqe_jax.policies.translated import together, translate
from mqe_jax.policies.zoo import population
from mqe_jax.presets import resolve
from mqe_jax.selfplay.opponents import Versus
from mqe_jax.sensors.suite import ONBOARD, sensors_of
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.needs import Needs
from mqe_jax.train.policy import (
    POLICY_FILE,
    TrainedPolicy,
    needed_imports,
    read_policy,
)

Source = str | Path | Policy | Act
"""What users pass as a policy: a name, a path, a policy, or a memoryless function `act`.

The function is compiled. It maps observations (N, A, O) of one team in N environments, a memory
that is () and a random key to actions (N, A, D) and the memory. Actions in [-1, 1] are shares of
the ranges that the environment has.
"""
Config = str | Path | TrainConfig | Mapping[str, Any] | None
"""Settings of a training: a shipped name, a file, settings, or changes of the defaults."""
Params = Mapping[str, Any]
"""Task parameters by name; the control mode may be among them."""

_NOTHING: Params = FrozenMapping()


@dataclasses.dataclass(frozen=True)
class Named:
    """A policy that needs no file and exists only in an environment, such as `scripted`."""

    name: str
    """One of `mqe_jax.policies.simple.names`."""
    usual: bool = False
    """Whether it acts with the task's default skill, as the member of a population does."""


Found = Any
"""A `TrainedPolicy`, a `Named`, a policy or a function: what `find` returns."""
Read = dict[str, Found]
"""Policies by name or path, so that each is read once in a call."""


def find(
    source: Source | None, task: str = "", *, field: str = "policy", read: Read | None = None
) -> Found:
    """Returns the policy of a name, a path or an object, None for None; makes no environment.

    A name is one of `mqe_jax.policies.simple`, a task with a shipped policy, a member of a
    population, or that of a file or folder with a suffix, or below another folder. `read` has the
    policies that are already read, and gets further ones.

    Raises:
        InputError: naming `field`, for an unknown name; naming the file, if it cannot be read.
    """
    if source is None:
        return None
    if not isinstance(source, str | Path):
        if isinstance(source, type) or not (callable(source) or hasattr(source, "act")):
            fail(field, source, "a policy, its function act(obs, memory, key), a name or a path")
        if not hasattr(source, "act"):
            function: Any = source
            check_call(field, function, "obs", "memory", "key")
        return source
    source = path_text(check(field, source, PathText))
    known = {} if read is None else read
    if source not in known:
        known[source] = _find(source, task, field)
    return known[source]


def _find(name: str, task: str, field: str) -> Found:
    devices.platform()  # which will hold the weights
    member = population.find(name, task, field)
    if member is not None:
        return Named(member, usual=True) if isinstance(member, str) else member
    if name in simple.names(task):
        return Named(name)
    if Path(name).suffix == ".py":
        fail(field, name, "a policy; --import FILE registers those of a Python file by their names")
    shipped = name in zoo.names()
    if shipped or os.sep in name or Path(name).suffix or Path(name).exists():
        return read_policy(zoo.file_of(name) if shipped else name)
    allowed = (*simple.names(task), *(each for each in zoo.names() if task in ("", each)))
    raise InputError(
        f"{field}: unknown {name!r}{nearest(name, allowed)}; allowed: {', '.join(allowed)}, "
        "a run folder, a policy file, or one that register_scripted adds (mqe: --import FILE)"
    )


def parameters_of(task: str, found: Iterable[Found], *, scaled: bool = False) -> dict[str, Any]:
    """Returns the parameters that policies need and that differ from a task's defaults.

    They include the control mode, and command ranges if `scaled`: a robot's size may change the
    defaults. Only trained policies of the task and the scripted member of a
    population need any. Trained policies need their sensors as well; the scripted member acts with
    the task's default skill. Policies of different skills get parameters with which they can meet.
    """
    found = list(found)
    trained = [each for each in found if isinstance(getattr(each, "needs", None), Needs)]
    trained = [each for each in trained if each.needs.task == task and each.needs.control]
    params: dict[str, Any] = {}
    for policy in trained:
        needs = policy.needs
        usual = TASKS[task].Params().actions(needs.control or "") | {"control": "command"}
        own = {name: getattr(needs, name) for name in usual}
        own = {
            name: value
            for name, value in own.items()
            if value != usual[name] or (scaled and name == "command_ranges")
        }
        if needs.senses:
            own["senses"] = needs.senses
        if "robot" in own:
            own |= _robots_of(policy, own.pop("robot"))
        if needs.skill_weights:
            own["skill_weights"] = policy.config.env.get("skill_weights")
        params = own | {name: value for name, value in params.items() if value is not None}
    skills = [policy.needs.by_name() for policy in trained]
    usual = any(isinstance(each, Named) and each.usual for each in found)
    if usual and all(policy.needs.control == "command" for policy in trained):
        skills.append(TASKS[task].Params().actions("command"))
    return params | together(skills)


def _robots_of(policy: TrainedPolicy, needed: str) -> dict[str, Any]:
    """Returns the parameter that names a policy's robots.

    The training's settings name files; without them the parameter is left out.
    """
    unlike = needed.split(", ")
    name, value = ("robots", unlike) if len(unlike) > 1 else ("robot", needed)
    if "@" not in needed:
        return {name: value}
    return {name: policy.config.env[name]} if name in policy.config.env else {}


def environment(
    task: str | QuadrupedEnv,
    params: Params = _NOTHING,
    *,
    impl: str = "auto",
    num_envs: int = 1,
) -> QuadrupedEnv:
    """Returns the environment of a task's id, or the passed one with other parameters.

    `num_envs` environments fit into the buffers of a new one. `impl` is its physics engine.
    """
    if isinstance(task, QuadrupedEnv):
        if impl not in ("auto", task.impl):
            fail("impl", impl, f"left out for an environment, whose engine is {task.impl!r}")
        return task.changed(params)
    device = devices.platform()
    if impl in ("warp", "warp-mjx") and device != "gpu":
        raise InputError(
            f"impl: {impl!r} needs an NVIDIA GPU, but JAX runs on {device}; allowed: c, jax"
        )
    return make(task, impl=impl, num_envs=num_envs, **params)


def fit(
    found: Found,
    env: QuadrupedEnv,
    *,
    deterministic: bool = False,
    field: str = "policy",
    name: str = "",
) -> Policy:
    """Returns a policy as it acts for a team of an environment: of its size, with its own skill.

    With `deterministic`, a trained policy acts with its mean actions.

    Raises:
        InputError: naming `field`, the policy, by default its text, and what does not fit.
    """
    named = isinstance(found, Named)
    if not named and not hasattr(found, "act"):
        return simple.from_function(found, env, name or title(found))
    if named:
        return simple.named(found.name, env, field)
    name = name or repr(found)
    if isinstance(found, TrainedPolicy):
        return translate(found.acting(True) if deterministic else found, env, name, field)
    if hasattr(found, "task"):
        check_policy(found, env, name, field)
    return found


class Table(NamedTuple):
    """An environment, and who sits in it."""

    env: QuadrupedEnv
    """The task."""
    batch: VectorEnv
    """Environments with automatic reset."""
    seats: Seats
    """Who acts for which agents."""
    about: dict[str, Any]
    """Names of policy and opponent, whether a trained policy's actions are means or samples, the
    skill of all robots."""


def table(
    task: str | Path | QuadrupedEnv,
    policy: Source | None = None,
    opponent: Source | None = None,
    *,
    env: Params | None = None,
    impl: str = "auto",
    num_envs: int = 1,
    deterministic: bool = False,
    sensors: bool = False,
    read: Read | None = None,
) -> Table:
    """Returns what is evaluated, rendered and viewed; arguments and errors as `mqe_jax.evaluate`.

    With `sensors`, robots that have none get the sensors of the set `onboard`.

    A run brings its own task, parameters and policy. A task has its shipped policy, on both sides
    of a match; if that does not fit the parameters, with a warning its scripted one, or `forward`,
    or `random` if actions are not commands. A task by its id has the parameters that trained
    policies need, such as their skill.
    """
    read = {} if read is None else read
    found = target(task, read)
    options: dict[str, Any] = {
        "env": dict(env or {}),
        "impl": impl,
        "num_envs": num_envs,
        "deterministic": deterministic,
        "sensors": sensors,
        "read": read,
    }
    first = found.run if policy is None else policy
    if first is not None:
        return _seated(task, found, first, opponent, **options)
    usual = _usual_policy(found.task, merge(found.params, options["env"]))
    if found.task not in zoo.names():
        return _seated(task, found, usual, opponent, **options)
    try:
        return _seated(task, found, found.task, opponent, others=found.task, **options)
    except InputError as error:
        reason = str(error)
    seated = _seated(task, found, usual, opponent, **options)
    warn(f"{reason}; {usual!r} acts in place of the shipped policy")
    shown = f"{usual}, in place of the shipped policy"
    return seated._replace(about=seated.about | {"policy": shown})


def _about(sources: Mapping[str, Source], policy: Any) -> dict[str, Any]:
    """Returns the names of who plays, and the kind of actions of a trained policy."""
    about: dict[str, Any] = {"policy": title(sources["policy"])}
    mean = getattr(getattr(policy, "policy", policy), "deterministic", None)
    if mean is not None:
        about["actions"] = "mean" if mean else "sampled"
    if "opponent" in sources:
        about["opponent"] = title(sources["opponent"])
    return about


class Target(NamedTuple):
    """What a task's id, an environment, a run folder or a policy file stands for."""

    task: str
    """Id of the task."""
    params: Mapping[str, Any]
    """The parameters that it brings, which differ from the task's defaults."""
    run: str | None = None
    """Source of the policy of a run."""


def target(task: str | Path | QuadrupedEnv, read: Read | None = None) -> Target:
    """Returns what is named as a task; `read` gets the policy of a run.

    Raises:
        InputError: for an unknown id, or a folder without a policy.
    """
    if isinstance(task, QuadrupedEnv):
        return Target(task.name, own_parameters(task))
    source = path_text(check("task", task, PathText))
    name = find_task(source)
    if name is not None:
        return Target(name, {})
    if not source.endswith(".safetensors") and not (Path(source) / POLICY_FILE).is_file():
        runs = sorted(str(path.parent) for path in Path(source).glob(f"*/{POLICY_FILE}"))
        hint = f"; did you mean {runs[0]}?" if runs else ""
        allowed = "a run folder, a policy file (*.safetensors), or a task's id"
        raise InputError(f"run: {source!r} has no {POLICY_FILE}{hint}; allowed: {allowed}")
    policy = read_policy(source)
    if read is not None:
        read[source] = policy
    with imports_of(policy, source):
        return Target(task_id(policy.task), policy.config.env, source)


def _seated(
    task: str | Path | QuadrupedEnv,
    found: Target,
    policy: Source,
    opponent: Source | None,
    *,
    env: Params,
    impl: str,
    num_envs: int,
    deterministic: bool,
    sensors: bool,
    read: Read,
    others: Source = "idle",
) -> Table:
    """Returns the table of a policy; `others` are its opponents in a match if none is given."""
    name = found.task
    policies = [find(policy, name, read=read)]
    if opponent is not None:
        policies.append(find(opponent, name, field="opponent", read=read))
    given = dict(env)
    place = task if isinstance(task, QuadrupedEnv) else name
    params = merge(found.params, given)
    if isinstance(place, str):
        needed = parameters_of(name, policies, scaled="robot" in given)
        given = merge(merge(params, needed), given)
    if sensors and not sensors_of({**params, **given}.get("senses", ())):
        given["senses"] = ONBOARD
    with imports_of(read.get(found.run or ""), found.run or ""):
        made = environment(place, given, impl=impl, num_envs=num_envs)
    sources = {"policy": policy}
    if len(made.teams) > 1:
        sources["opponent"] = others if opponent is None else opponent
    elif opponent is not None:
        raise InputError(f"opponent: {name} is not a competitive task; omit the opponent")
    teams = [
        seat(source, made, field, read, deterministic=deterministic)
        for field, source in sources.items()
    ]
    seats = Seats.of_teams(made, *teams)
    groups = seats.groups | {ONBOARD} if sensors else seats.groups
    batch = VectorEnv(made, num_envs, final=()).with_groups(groups)
    about = _about(sources, teams[0]) | {"skill": made.skill_text}
    return Table(made, batch, seats, about)


@contextlib.contextmanager
def imports_of(policy: TrainedPolicy | None, run: str) -> Iterator[None]:
    """Adds to an InputError the flags of `mqe` that import what the training of a run imported."""
    try:
        yield
    except InputError as error:
        flags = "" if policy is None else needed_imports(policy.metadata)
        if policy is None or not flags:
            raise
        unknown = f"run: the task {policy.task!r} of {run} is not registered"
        raise InputError(f"{error if policy.task in TASKS else unknown}; add {flags}") from None


def _usual_policy(name: str, params: Params) -> str:
    """Returns the policy that a task has without a shipped one."""
    if params.get("control", "command") != "command":
        return "random"
    return "scripted" if name in SCRIPTED else "forward"


def own_parameters(env: QuadrupedEnv) -> dict[str, Any]:
    """Returns the parameters of an environment that differ from its task's defaults.

    They include the control mode.
    """
    control = {} if env.control == "command" else {"control": env.control}
    return {**control, **differences(env.params, env.Params())}


def settings(
    task: Any,
    config: Config = None,
    *,
    env: Params | None = None,
    layers: Mapping[str, Params] = _NOTHING,
    read: Read | None = None,
) -> TrainConfig:
    """Returns the settings of a training on a task, with the task and its parameters.

    The task is an id, an environment or a batch of environments. Layers lie between those of
    `config` and `env`. A task by its id gets the parameters that the teacher and the policy to
    start from need, which `read` gets. A line says if the settings are for another task.
    """
    changes: dict[str, Any] = nested(config) if isinstance(config, Mapping) else {"config": config}
    source = changes.pop("config", None)
    algorithm = changes.pop("algorithm", None)
    kinds = str | Path | TrainConfig | None
    if not isinstance(source, kinds) or not isinstance(algorithm, str | None):
        fail("config", config, "a shipped name, a file, a TrainConfig, or a mapping of settings")
    inner = task if isinstance(task, str | QuadrupedEnv) else getattr(task, "env", None)
    name = ""
    own: dict[str, Any] = {}
    if isinstance(inner, str):
        name = task_id(inner)
    elif isinstance(inner, QuadrupedEnv):
        name = inner.name
        own = own_parameters(inner)
    asked = check("env", changes.get("env", {}), Parameters)
    changes["env"] = merge(merge(own, asked), env or {})

    def needs(made: TrainConfig) -> dict[str, Any]:
        teacher = find(made.imitation.teacher, name, field="imitation.teacher", read=read)
        return parameters_of(name, [teacher, find(made.start, name, field="start", read=read)])

    made = resolve(
        name if inner is task else "",
        source,
        algorithm,
        {**layers, "": changes},
        needs if isinstance(task, str) else lambda made: {},
    )
    if made.task not in (None, name) and name:
        echo(f"mqe: the settings are for {made.task!r}; training {name!r} with them")
    return override(made, {"task": name or made.task})


@overload
def load_policy(source: str | Path, env: None = None, *, deterministic: bool = False) -> Any: ...
@overload
def load_policy(
    source: str | Path, env: QuadrupedEnv, *, deterministic: bool = False
) -> Policy: ...
@checked
def load_policy(
    source: str | Path, env: QuadrupedEnv | None = None, *, deterministic: bool = False
) -> Policy:
    """Returns the policy of a name, a run folder or a policy file.

    Example:
        ```python
        env = mqe_jax.make("go1gate")
        team = mqe_jax.load_policy("go1gate", env)  # the shipped one
        obs = jax.numpy.zeros((1, 2, 16))
        action, memory = team.act(obs, team.initial_memory(1), jax.random.PRNGKey(0))
        ```

    Args:
        source: scripted, random, idle, forward, one of the task's `NAMED_SCRIPTED`, a task with a
            shipped policy (`mqe_jax.policies.zoo`), a member of a population (`zoo.population`), or
            a path. A folder with one of these names is ./NAME.
        env: the task; in a match the policy acts for one team. Names need it, and policies of paths
            are checked against it.
        deterministic: whether a trained policy acts with mean actions. Its file can also say so.

    Returns:
        A `TrainedPolicy` for a shipped one or a path, else a `SimplePolicy`.

    Raises:
        InputError: for an unknown name, a file that cannot be read, a policy of another task, or a
            task without a scripted policy.
    """
    env = getattr(env, "env", env)  # of a batch
    found = find(source, "" if env is None else env.name)
    if env is not None:
        return fit(found, env, deterministic=deterministic, name=str(source))
    if isinstance(found, Named):
        raise InputError(f"policy: {source!r} needs a task: load_policy({source!r}, env)")
    return found.acting(True) if deterministic else found


@checked
def versus(
    env: VectorEnv | Wrapper,
    opponents: Source | Sequence[Source],
    *,
    draw_reward: Number = 0.0,
) -> Versus:
    """Returns matches as environments of team 0, against opponents that control team 1.

    Opponents are policies, functions or what `load_policy` accepts; equally many environments meet
    each of them. Trained policies act as they are loaded (sampled, unless deterministic) and can be
    exchanged (`Versus.change`). A draw adds `draw_reward`. InputError for a task that is not a
    match, and for a policy of another task.

    Example:
        ```python
        batch = mqe_jax.VectorEnv(mqe_jax.make("go1tug"), 8)
        matches = mqe_jax.versus(batch, ["scripted", "idle"])  # four against each
        print(matches.num_agents)  # 1
        ```
    """
    one = isinstance(opponents, str | Path) or callable(opponents)
    alone = one or hasattr(opponents, "initial_memory")
    given: Any = [opponents] if alone else opponents
    if not isinstance(given, Sequence):
        fail("opponents", given, "a policy, or a list of policies")
    if isinstance(env, QuadrupedEnv):
        fail("env", env.name, "a batch of environments, VectorEnv(env, N)")
    read: Read = {}
    policies = [seat(each, env.env, "opponents", read) for each in given]
    return Versus(env, policies, draw_reward)


def seats(
    roles: Mapping[str, Iterable[str | None]], env: QuadrupedEnv, read: Read | None = None
) -> dict[str, Policy]:
    """Returns the policies that settings name, by name, as they act for a team of an environment.

    `roles` has the names, or None, by setting. Errors are those of `find` and `fit`.
    """
    every = [(name, role) for role, sources in roles.items() for name in sources]
    return {name: seat(name, env, role, read) for name, role in every if name is not None}


def seat(
    source: Source,
    env: QuadrupedEnv,
    field: str = "policy",
    read: Read | None = None,
    *,
    deterministic: bool = False,
) -> Policy:
    """Returns the policy of a name, a path or an object as it acts for a team of `env`.

    Arguments and errors are those of `find` and `fit`.
    """
    found = find(source, env.name, field=field, read=read)
    return fit(found, env, deterministic=deterministic, field=field, name=title(source))
