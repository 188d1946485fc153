"""Environments, learners and players from the names and settings that users pass."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax

from mqe_jax.acting.seats import Act, Policy, Seats
from mqe_jax.core.errors import InputError
from mqe_jax.core.limits import SeedCount
from mqe_jax.core.literal import echo
from mqe_jax.core.settings import (
    FrozenMapping,
    Parameters,
    PathText,
    check,
    check_arguments,
    differences,
    fail,
    merge,
    nested,
    override,
)
from mqe_jax.core.types import Cast
from mqe_jax.core.types import VectorEnv as AnyVectorEnv
from mqe_jax.envs import ALIASES, SCRIPTED, TASKS, QuadrupedEnv, TaskParams, VectorEnv, make
from mqe_jax.envs.registry import task_id
from mqe_jax.envs.wrappers import Deadline
from mqe_jax.policies import load_as, load_policy, parameters_for, zoo
from mqe_jax.presets import resolve
from mqe_jax.selfplay.demonstrations import Demonstrated
from mqe_jax.selfplay.league.league import League, Roster
from mqe_jax.selfplay.league.sides import BothSides
from mqe_jax.selfplay.opponents import Mirror, versus
from mqe_jax.sensors.suite import ONBOARD, sensors_of
from mqe_jax.train import learner
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.learner import Learner
from mqe_jax.train.logs import check_loggers
from mqe_jax.train.needs import needs_of
from mqe_jax.train.policy import POLICY_FILE, groups_of
from mqe_jax.train.start import initial_key, policy_to_start

TaskLike = str | QuadrupedEnv | AnyVectorEnv
"""A task's id, its environment, or a batch of environments."""
Config = str | Path | TrainConfig | Mapping[str, Any] | None
"""Settings of a training: a shipped name, a file, settings, or changes of the task's default
ones."""
Player = str | Path | Policy | Act | None
"""A policy, its function `act` without recurrent state, or what `load_policy` accepts."""


@check_arguments(env=Mapping[str, Any] | None, impl=str)
def prepare(
    task: TaskLike,
    config: Config = None,
    env: Mapping[str, Any] | None = None,
    *,
    impl: str = "auto",
    seeds: Sequence[int] | None = None,
) -> tuple[list[TrainConfig], Cast]:
    """Returns the settings of each seed and the environments of a training; arguments and errors as
    `mqe_jax.learn`.

    `seeds` are trained in one program; by default the one of the settings.
    """
    if len(set(seeds or ())) < len(seeds or ()):
        fail("seeds", seeds, "a list without repetitions")
    if isinstance(task, str | QuadrupedEnv):
        made = settings(task, config, env=env)
    elif all(hasattr(task, name) for name in ("num_envs", "reset", "step")):
        made = settings(task, config)
        theirs = {"env": env, "opponents": made.opponents}
        theirs |= {"demonstrator": made.curriculum.demonstrator}
        for name, value in theirs.items():
            if value:
                fail(name, value, "left out for a batch of environments, which has its own")
        made = override(made, {"num_envs": task.num_envs, "evaluation.every": None})
    else:
        fail(
            "task",
            task,
            "a task's id, an environment such as that of mqe_jax.make, or a batch of environments",
        )
    configs = [made] if seeds is None else [override(made, {"seed": seed}) for seed in seeds]
    if isinstance(task, str | QuadrupedEnv):
        return configs, environments(impl, made, len(configs), task)
    return configs, Cast(task)


@check_arguments(seeds=SeedCount)
def make_learner(
    task: TaskLike,
    config: Config = None,
    *,
    env: Mapping[str, Any] | None = None,
    impl: str = "auto",
    seeds: int = 1,
) -> Learner:
    """Returns `init(key) -> state` and `update(state) -> (state, metrics)`: a training as pure
    functions, not compiled.

    Example:
        ```python
        init, update = mqe_jax.make_learner("go1gate", "demo")
        state = jax.jit(init)(jax.random.PRNGKey(0))
        state, metrics = jax.jit(update)(state)
        ```

    Args:
        task: as in `mqe_jax.learn`, and so are config, env and impl.
        config: settings; nothing is evaluated during training.
        env: task parameters.
        impl: physics engine.
        seeds: number of states under an outer `jax.vmap`, for which buffers are sized.

    Raises:
        InputError: as `mqe_jax.learn`.
    """
    (made, *_), cast = prepare(task, config, env, impl=impl, seeds=range(seeds))
    return learner.make_learner(cast.env, made, league=cast.league, teacher=cast.teacher)


def make_env(
    task: str | QuadrupedEnv,
    impl: str,
    overrides: Mapping[str, Any],
    num_envs: int,
    copies: int = 1,
    final: Sequence[str] = (),
) -> tuple[Any, VectorEnv]:
    """Returns a task and its vectorised environment with automatic reset; `copies` and `final` as
    in `VectorEnv`.

    The task is an id or an environment, of which only class and engine are used (`parameters_of`
    has the rest).
    """
    check("set", overrides, Parameters)
    device = platform()
    if impl == "warp" and device != "gpu":
        raise InputError(
            f"impl: 'warp' needs an NVIDIA GPU, but JAX runs on {device}; allowed: c, jax"
        )
    if isinstance(task, QuadrupedEnv):
        control = overrides.get("control", "command")
        params = {k: v for k, v in overrides.items() if k != "control"}
        env = type(task)(
            override(task.Params(), params),
            impl=task.impl,
            control=control,
            num_envs=num_envs * copies,
        )
    else:
        env = make(task, impl=impl, num_envs=num_envs * copies, **overrides)
    return env, VectorEnv(env, num_envs, copies, final=final)


def parameters_of(task: str | QuadrupedEnv) -> dict[str, Any]:
    """Returns the parameters, with the control mode, that differ from the task's defaults; empty
    for an id.
    """
    if not isinstance(task, QuadrupedEnv):
        return {}
    control = {} if task.control == "command" else {"control": task.control}
    return {**control, **differences(task.params, task.Params())}


def environments(
    impl: str, config: TrainConfig, seeds: int, task: str | QuadrupedEnv | None = None
) -> Cast:
    """Returns the environments of seeds trained together, and who else plays in them.

    The task is that of the settings, or `task` as in `make_env`.

    In a match the policy is team 0 against `opponents`. Without opponents, both teams of each of
    `num_envs` / 2 matches are environments of the policy. It is then evaluated against the scripted
    policy, or an idle team if that does not fit. InputError for a task, an opponent or a
    demonstrator that is not allowed.
    """
    task = task or config.task or ""
    episodes = config.evaluation.episodes
    opponents = config.opponents
    final = config.network.critic_reads
    both, started = make_env(task, impl, config.training_env, config.num_envs, seeds, final)
    _check_teams(both, config)
    others = (
        [load_as("opponent", name, both) for name in Roster(opponents).fixed]
        if len(both.teams) > 1
        else []
    )
    shown = config.imitation.teacher
    teacher = None if shown is None else load_as("imitation.teacher", shown, both)
    groups = {config.group, *groups_of(*others, teacher)}
    demonstrator = config.curriculum.demonstrator

    def batch(num_envs: int) -> Any:
        if demonstrator is None:
            made = (
                started
                if num_envs == config.num_envs
                else VectorEnv(both, num_envs, seeds, final=final)
            )
        else:
            policy = load_as("curriculum.demonstrator", demonstrator, both)
            everyone = Seats.of_teams(both, *[policy] * len(both.teams))
            made = Demonstrated(both, num_envs, everyone, seeds, final=final)
        made = made.with_groups(groups)
        return Deadline(made) if config.time_limit_ends else made

    eval_env = None
    if config.evaluation.every is not None:
        _, eval_env = make_env(task, impl, config.env, episodes, 2 * seeds)
        eval_env = eval_env.with_groups(groups)
    if config.train_env:
        _check_alike(
            both,
            make_env(task, impl, config.env, 1)[0] if eval_env is None else eval_env.env,
            config,
        )
    league = None
    if len(both.teams) < 2:
        env = batch(config.num_envs)
    elif opponents:
        matches = batch(config.num_envs)
        league = League(BothSides(matches) if config.both_sides else matches, opponents, config)
        env = league.env
    else:
        env = Mirror(batch(config.num_envs // 2))
    if len(both.teams) > 1 and eval_env is not None:
        fixed = Roster(opponents).fixed or reference_opponents(eval_env.env)[:1]
        if episodes % len(fixed):
            fail(
                "evaluation.episodes",
                episodes,
                f"a multiple of the number of opponents in evaluations, {len(fixed)}",
            )
        eval_env = versus(BothSides(eval_env) if config.both_sides else eval_env, fixed)
    return Cast(env, eval_env, league, teacher)


def check_start(config: TrainConfig, seeds: int = 1, impl: str = "auto") -> None:
    """Raises an InputError if a training of seeds could not start."""
    check_loggers(config.loggers)
    cast = environments(impl, config, seeds)
    learner.make_learner(cast.env, config, league=cast.league, teacher=cast.teacher)
    if config.start is not None:
        network = config.network.build(needs_of(cast.env, config).dims)
        policy_to_start(cast.env, jax.eval_shape(network.init, initial_key(config)), config)


def _check_alike(training: QuadrupedEnv, env: QuadrupedEnv, config: TrainConfig) -> None:
    """Raises an InputError if a policy trained in a task could not act in its evaluation."""
    differing = needs_of(training, config).mismatches(needs_of(env, config))
    for name, (value, evaluated) in differing.items():
        fail(
            f"train_env.{name}",
            value,
            f"that of env, {evaluated!r}, in which the policy is evaluated",
        )


def _check_teams(env: QuadrupedEnv, config: TrainConfig) -> None:
    if len(env.teams) < 2 and config.opponents:
        fail(
            "opponents",
            list(config.opponents),
            f"empty: {env.name} is not a match; it has one team",
        )
    if config.both_sides and not config.opponents:
        fail("both_sides", True, "false without opponents")
    if len(env.teams) > 1 and config.num_envs % 2 and not config.opponents:
        fail("num_envs", config.num_envs, "even: both teams of a match are environments")


def reference_opponents(env: QuadrupedEnv) -> list[str]:
    """Returns the names of a match's fixed opponents, the strongest first: policies are evaluated
    against that one.
    """
    walking = env.control == "command" and tuple(env.params.commands) == TaskParams.commands
    return [*(["scripted"] if env.name in SCRIPTED and walking else []), "idle", "random"]


def platform() -> str:
    """Returns the platform of JAX; raises an InputError if JAX_PLATFORMS selects an unavailable
    one.
    """
    try:
        return jax.default_backend()
    except (RuntimeError, AssertionError) as error:
        requested = os.environ.get("JAX_PLATFORMS", "")
        reason = str(error) or "no such device"
        raise InputError(
            f"JAX_PLATFORMS: {requested!r} cannot be used here ({reason}); try cpu"
        ) from None


class Players(NamedTuple):
    """An environment, and who acts in it."""

    env: Any
    """The task."""
    batch: VectorEnv
    """Environments with automatic reset."""
    seats: Seats
    """Who acts for which agents."""
    about: dict[str, Any]
    """Names of policy and opponent, and whether a trained policy's actions are means or samples."""


@check_arguments(env=Mapping[str, Any] | None, impl=str, deterministic=bool)
def players(
    task: str | Path | QuadrupedEnv,
    policy: Player = None,
    opponent: Player = None,
    *,
    env: Mapping[str, Any] | None = None,
    impl: str = "auto",
    num_envs: int = 1,
    deterministic: bool = False,
    sensors: bool = False,
) -> Players:
    """Returns what is evaluated, rendered and viewed; arguments and errors as `mqe_jax.evaluate`.

    With `sensors`, robots that have none get the sensors of the set `onboard`.

    A run brings its own task, parameters and policy. Without a policy and parameters, a task has
    its shipped policy, on both sides of a match. Otherwise it has its scripted one, or `forward`,
    or `random` if actions are not commands. A task by its id has the parameters that trained
    policies need, such as their skill.
    """
    made = task
    name = ""
    params = dict(env or {})
    if isinstance(made, QuadrupedEnv):
        name = made.name
        params = merge(parameters_of(made), params)
    else:
        given = str(check("task", made, PathText))
        made = name = ALIASES.get(given, given)
        if name not in (*TASKS, *zoo.names()) and (os.sep in name or Path(name).exists()):
            config = run_config(name)
            made = config.task or ""
            params = merge(config.env, params)
            policy = policy or name
    shipped = name in zoo.names() and not {*params} - {"senses"} and policy is None
    walking = "scripted" if name in SCRIPTED else "forward"
    default = walking if params.get("control", "command") == "command" else "random"
    chosen = (name if shipped else default) if policy is None else policy
    if isinstance(made, str):
        params = merge(merge(params, parameters_for(made, chosen, opponent)), env or {})
    if sensors and not sensors_of(params.get("senses", ())):
        params["senses"] = ONBOARD
    task_env, batch = make_env(made, impl, params, num_envs)
    own = load_as("policy", chosen, task_env, deterministic=deterministic)
    match = len(task_env.teams) > 1
    other, against = (own, chosen) if shipped and match else (None, "idle")
    if opponent is not None:
        if not match:
            name = task_env.name
            raise InputError(f"opponent: {name} is not a competitive task; omit the opponent")
        other = load_as("opponent", opponent, task_env, deterministic=deterministic)
        against = opponent
    about: dict[str, Any] = {"policy": str(chosen)}
    if (mean := getattr(getattr(own, "policy", own), "deterministic", None)) is not None:
        about["actions"] = "mean" if mean else "sampled"
    if match:
        about["opponent"] = str(against)
    teams = [own]
    if match:
        teams.append(load_policy("idle", task_env) if other is None else other)
    seats = Seats.of_teams(task_env, *teams)
    groups = seats.groups | {ONBOARD} if sensors else seats.groups
    return Players(task_env, batch.with_groups(groups), seats, about)


def run_config(target: str) -> TrainConfig:
    """Returns the settings of the policy in a run folder or a policy file; InputError if it is
    missing.
    """
    if not target.endswith(".safetensors") and not (Path(target) / POLICY_FILE).is_file():
        runs = sorted(str(path.parent) for path in Path(target).glob(f"*/{POLICY_FILE}"))
        hint = f"; did you mean {runs[0]}?" if runs else ""
        allowed = "a run folder, a policy file (*.safetensors), or a task's id"
        raise InputError(f"run: {target!r} has no {POLICY_FILE}{hint}; allowed: {allowed}")
    return load_policy(target).config


def settings(
    task: TaskLike,
    config: Config = None,
    *,
    env: Mapping[str, Any] | None = None,
    layers: Mapping[str, Mapping[str, Any]] = FrozenMapping(),
) -> TrainConfig:
    """Returns the settings of a training on a task, with the task and its parameters.

    Layers lie between those of `config` and `env`. A task by its id gets the parameters that the
    teacher and the policy to start from need. A line says if the settings are for another task.
    """
    changes = dict(config) if isinstance(config, Mapping) else {"config": config}
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
        own = parameters_of(inner)
    given = merge(nested(changes), {"env": merge(own, env or {})})

    def needs(settings: TrainConfig) -> dict[str, Any]:
        sources = settings.imitation.teacher, settings.start
        return parameters_for(name, *(source for source in sources if source is not None))

    made = resolve(
        name if inner is task else "",
        source,
        algorithm,
        {**layers, "": given},
        needs if isinstance(task, str) else lambda settings: {},
    )
    if made.task not in (None, name) and name:
        echo(f"mqe: the settings are for {made.task!r}; training {name!r} with them")
    return override(made, {"task": name or made.task})
