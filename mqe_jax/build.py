"""Environments and training settings from what users name: tasks, runs, settings and their changes."""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax

from mqe_jax.demonstrations import Demonstrated
from mqe_jax.envs import ALIASES, PLANNERS, TASKS, QuadrupedEnv, TaskParams, VectorEnv, make
from mqe_jax.envs.match import Match
from mqe_jax.envs.wrappers import Deadline
from mqe_jax.errors import InputError, nearest
from mqe_jax.league.league import League
from mqe_jax.league.sides import BothSides
from mqe_jax.opponents import Mirror, versus
from mqe_jax.policies import all_agents, load_as, load_policy
from mqe_jax.settings import Parameters, check, fail, load_yaml, override
from mqe_jax.train.config import MOVING, TrainConfig, load_config
from mqe_jax.train.folder import CONFIG_FILE, load_run_config
from mqe_jax.train.learner import env_dims, make_learner
from mqe_jax.train.logs import check_loggers
from mqe_jax.train.start import initial_key, policy_to_start

CONFIG_FOLDER = Path(__file__).parent / "configs"


def run_config(target: str) -> Any:
    """Returns the settings in a run folder or a policy file; InputError where there are none, or they name no task."""
    if target.endswith(".safetensors"):
        return load_policy(target).config
    if not Path(target).is_dir():
        allowed = "a run folder, a policy file (*.safetensors), or a task's id"
        raise InputError(f"run: {target!r} is {'not a' if Path(target).exists() else 'no'} folder; allowed: {allowed}")
    if not (Path(target) / CONFIG_FILE).is_file():
        runs = sorted(str(path.parent) for path in Path(target).glob(f"*/{CONFIG_FILE}"))
        hint = f"; did you mean {runs[0]}?" if runs else ""
        raise InputError(f"run: {target!r} has no {CONFIG_FILE}; it is not a run folder{hint}")
    config = load_run_config(target)
    if config.task is None:
        raise InputError(f"{target}: {CONFIG_FILE} has no 'task' entry")
    return config


def make_env(
    task: str, impl: str, overrides: Mapping[str, Any], num_envs: int, copies: int = 1
) -> tuple[Any, VectorEnv]:
    """Returns a task and its vectorised environment with automatic reset; `copies` as in `VectorEnv`."""
    check("set", overrides, Parameters)
    device = platform()
    if impl == "warp" and device != "gpu":
        raise InputError(f"impl: 'warp' needs an NVIDIA GPU, but JAX runs on {device}; allowed: c, jax")
    env = make(task, impl=impl, num_envs=num_envs * copies, **overrides)
    return env, VectorEnv(env, num_envs, copies)


def environments(impl: str, config: TrainConfig, seeds: int) -> tuple[Any, Any]:
    """Returns training and evaluation environments (None without evaluation) of seeds trained together.

    In a match the policy is team 0 against `opponents`. Without, both teams of each of `num_envs` / 2 matches are
    environments of the policy; it is evaluated against the scripted policy, or an idle team where that does not fit.
    InputError for a task, an opponent or a demonstrator that is not allowed.
    """
    task, episodes, opponents = config.task or "", config.evaluation.episodes, config.opponents
    both, env = make_env(task, impl, config.training_env, config.num_envs, seeds)
    demonstrator = config.curriculum.demonstrator

    def batch(num_envs: int) -> Any:
        if demonstrator is None:
            started = env if num_envs == config.num_envs else VectorEnv(both, num_envs, seeds)
        else:
            policy = load_as("curriculum.demonstrator", demonstrator, both)
            everyone = all_agents(both, policy, policy if len(both.teams) > 1 else None)
            started = Demonstrated(both, num_envs, everyone, seeds, backward=config.curriculum.backward)
        return Deadline(started) if config.time_limit_ends else started

    eval_env = None
    if config.evaluation.every is not None:
        _, eval_env = make_env(task, impl, config.env, episodes, 2 * seeds)
    if config.train_env:
        _check_alike(both, make_env(task, impl, config.env, 1)[0] if eval_env is None else eval_env.env)
    _check_teams(both, config)
    learning: Any
    if len(both.teams) < 2:
        learning = batch(config.num_envs)
    elif opponents:
        matches = batch(config.num_envs)
        learning = League(BothSides(matches) if config.both_sides else matches, opponents, config)
    else:
        learning = Mirror(batch(config.num_envs // 2))
    if config.imitation.teacher is not None:
        learning.teacher = load_as("imitation.teacher", config.imitation.teacher, both)
    if len(both.teams) > 1 and eval_env is not None:
        fixed = [opponent for opponent in opponents if opponent not in MOVING]
        eval_env = versus(BothSides(eval_env) if config.both_sides else eval_env, fixed or anchors(eval_env.env)[:1])
    return learning, eval_env


def check_start(config: TrainConfig, seeds: int = 1, impl: str = "auto") -> None:
    """Raises an InputError where a training of seeds could not start."""
    check_loggers(config.loggers)
    env, _ = environments(impl, config, seeds)
    make_learner(env, config)
    if config.start is not None:
        network = config.network.build(env_dims(env, config))
        policy_to_start(env.name, jax.eval_shape(network.init, initial_key(config)), config)


def _check_alike(training: QuadrupedEnv, env: QuadrupedEnv) -> None:
    """Raises an InputError where a policy that is trained in a task could not act in it as it is evaluated."""
    for name, own, other in (
        ("control", training.control, env.control),
        ("robot", training.robot.name, env.robot.name),
        ("skill", training.params.skill, env.params.skill),
        ("commands", training.params.commands, env.params.commands),
        ("command_ranges", training.params.command_ranges, env.params.command_ranges),
        ("size of the observation", training.observation_size, env.observation_size),
    ):
        if own != other:
            fail(f"train_env.{name}", own, f"that of env, {other!r}, in which the policy is evaluated")


def _check_teams(env: QuadrupedEnv, config: TrainConfig) -> None:
    if len(env.teams) < 2 and config.opponents:
        fail("opponents", list(config.opponents), f"empty: {env.name} is not a match; it has one team")
    if config.both_sides and not config.opponents:
        fail("both_sides", True, "false where there are no opponents")
    if len(env.teams) > 1 and config.num_envs % 2 and not config.opponents:
        fail("num_envs", config.num_envs, "even: both teams of a match are environments")


def anchors(env: QuadrupedEnv) -> list[str]:
    """Returns the names of a match's fixed opponents, the strongest first: policies are evaluated against that one."""
    walking = env.control == "command" and tuple(env.params.commands) == TaskParams.commands
    return [*(["scripted"] if env.name in PLANNERS and walking else []), "idle", "random"]


def platform() -> str:
    """Returns the platform of JAX; raises an InputError if JAX_PLATFORMS selects an unavailable one."""
    try:
        return jax.default_backend()
    except (RuntimeError, AssertionError) as error:
        requested = os.environ.get("JAX_PLATFORMS", "")
        reason = str(error) or "no such device"
        raise InputError(f"JAX_PLATFORMS: {requested!r} cannot be used here ({reason}); try cpu") from None


@functools.cache
def _parts(file: str) -> dict[str, Any]:
    """Returns the parts of a shipped file of settings: those `common` to all, and changes of them by name."""
    return load_yaml(CONFIG_FOLDER / f"{file}.yaml")


def preset(algorithm: str) -> dict[str, Any]:
    """Returns the settings that define an algorithm, those of configs/paper.yaml, for `mqe_jax.settings.override`.

    Raises:
        InputError: for an unknown name, with the nearest known one.
    """
    algorithms = {name: changes for name, changes in _parts("paper").items() if name != "common"}
    if algorithm not in algorithms:
        fail("algorithm", algorithm, f"one of {', '.join(algorithms)}{nearest(algorithm, algorithms)}")
    return algorithms[algorithm]


def named_config(name: str, task: str) -> TrainConfig:
    """Returns the settings of a file, or of a shipped name; `league` has changes of some tasks."""
    shipped = ["demo", "league"]
    shipped += [f"{file}/{part}" for file in ("paper", "tuned") for part in sorted(_parts(file)) if part != "common"]
    path, allowed = Path(name), f"a YAML file, or one of {', '.join(shipped)}"
    if name == "demo":
        path = CONFIG_FOLDER / "demo.yaml"
    elif name in shipped:
        file, _, part = name.partition("/")
        common = override(TrainConfig(), _parts(file)["common"])
        return override(common, _parts(file).get(part or task, {}))
    elif path.suffix not in (".yaml", ".yml") and path.parent == Path("."):
        raise InputError(f"config: unknown name {name!r}{nearest(name, shipped)}; allowed: {allowed}")
    if not path.is_file():
        raise InputError(f"config: no file {name!r}; allowed: {allowed}")
    return load_config(path)


def base_config(task: str, name: str | None, algorithm: str | None = None) -> TrainConfig:
    """Returns the settings of a file or a shipped name, with the algorithm's preset.

    The default is paper/ALGORITHM if an algorithm is given, else tuned/TASK if it exists, else league for a match and
    paper/mappo for other tasks. InputError for a file or an algorithm that is not allowed.
    """
    task, changes = ALIASES.get(task, task), {} if algorithm is None else preset(algorithm)
    if name is None and algorithm is not None:
        name = f"paper/{algorithm}"
    elif name is None:
        match = task in TASKS and issubclass(TASKS[task], Match)
        name = f"tuned/{task}" if task in _parts("tuned") else "league" if match else "paper/mappo"
    return override(named_config(name, task), changes)


def for_task(config: TrainConfig, task: str, env: Mapping[str, Any] | None = None) -> TrainConfig:
    """Returns the settings with a task and its parameters; says so where they are those of another task."""
    if config.task not in (None, task):
        print(f"mqe: the settings are for {config.task!r}; training {task!r} with them", file=sys.stderr)
    return override(config, {"task": task, "env": dict(env or {})})
