"""Shipped settings of trainings, by name; it imports no JAX."""

import functools
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from mqe_jax.core.errors import InputError, nearest
from mqe_jax.core.settings import FrozenMapping, PathText, check, fail, load_yaml, merge, override
from mqe_jax.envs.registry import ALIASES, SHIPPED, TASKS
from mqe_jax.train.config import TrainConfig, load_config

CONFIG_FOLDER = Path(__file__).parents[1] / "configs"


@functools.cache
def _parts(file: str) -> dict[str, Any]:
    """Returns the parts of a shipped file of settings: those `common` to all, and changes of them
    by name.
    """
    return load_yaml(CONFIG_FOLDER / f"{file}.yaml")


def preset(algorithm: str) -> dict[str, Any]:
    """Returns the settings that define an algorithm, for `override`; InputError for an unknown
    name.
    """
    algorithms = {name: changes for name, changes in _parts("paper").items() if name != "common"}
    if algorithm not in algorithms:
        fail(
            "algorithm",
            algorithm,
            f"one of {', '.join(algorithms)}{nearest(algorithm, algorithms)}",
        )
    return algorithms[algorithm]


def named_config(name: str, task: str) -> TrainConfig:
    """Returns the settings of a file, or of a shipped name; `league` and `sizes` have changes of
    some tasks.
    """
    shipped = ["demo", "league", "sizes"]
    shipped += [
        f"{file}/{part}"
        for file in ("paper", "tuned")
        for part in sorted(_parts(file))
        if part != "common"
    ]
    path = Path(check("config", name, PathText))
    allowed = f"a YAML file, or one of {', '.join(shipped)}"
    if name == "demo":
        path = CONFIG_FOLDER / "demo.yaml"
    elif name == "sizes":
        usual = override(named_config(default_name(task), task), _parts(name)["common"])
        return override(usual, _parts(name).get(task, {}))
    elif name in shipped:
        file, _, part = name.partition("/")
        common = override(TrainConfig(), _parts(file)["common"])
        return override(common, _parts(file).get(part or task, {}))
    elif path.suffix not in (".yaml", ".yml") and path.parent == Path("."):
        raise InputError(
            f"config: unknown name {name!r}{nearest(name, shipped)}; allowed: {allowed}"
        )
    if not path.is_file():
        raise InputError(f"config: no file {name!r}; allowed: {allowed}")
    return load_config(path)


def base_config(
    task: str,
    name: str | None,
    algorithm: str | None = None,
    env: Mapping[str, Any] = FrozenMapping(),
) -> TrainConfig:
    """Returns the settings of a file or a shipped name, changed by an algorithm and by task
    parameters.

    The default is paper/ALGORITHM for an algorithm, else tuned/TASK if it exists, else league for a
    match and paper/mappo for other tasks. If the parameters have sensors and the settings name no
    group of observations, `onboard.yaml` changes the settings. Parameters also replace those of
    `train_env`. InputError for a file or an algorithm that is not allowed.
    """
    task = ALIASES.get(task, task)
    changes = {} if algorithm is None else preset(algorithm)
    if name is None and algorithm is not None:
        name = f"paper/{algorithm}"
    elif name is None:
        name = default_name(task)
    config = override(named_config(name, task), changes)
    config = replace(config, train_env=FrozenMapping(_without(config.train_env, merge({}, env))))
    sensing = env.get("senses", "full") not in ("full", (), [])
    return override(config, _parts("onboard")) if sensing and config.group == "policy" else config


def _without(values: Mapping[str, Any], others: Mapping[str, Any]) -> dict[str, Any]:
    """Returns nested values without those that others have too."""
    kept: dict[str, Any] = {}
    for name, value in merge({}, values).items():
        if name not in others:
            kept[name] = value
        elif isinstance(value, Mapping) and isinstance(others[name], Mapping):
            kept[name] = _without(value, others[name])
    return kept


def default_name(task: str) -> str:
    """Returns the name of the settings with which a task is trained by default."""
    return (
        f"tuned/{task}"
        if task in _parts("tuned")
        else "league"
        if _is_match(task)
        else "paper/mappo"
    )


def _is_match(task: str) -> bool:
    if task in SHIPPED:
        return len(SHIPPED[task].teams) > 1
    from mqe_jax.envs.match import Match

    return task in TASKS and issubclass(TASKS[task], Match)
