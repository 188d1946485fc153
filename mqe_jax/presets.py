"""Settings of trainings: `resolve` stacks shipped files, algorithms and changes.

It imports no JAX, so that `mqe train` shows its flags at once.
"""

import functools
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from mqe_jax.core.errors import InputError, nearest, warn
from mqe_jax.core.settings import (
    FrozenMapping,
    Parameters,
    PathText,
    check,
    fail,
    hints_of,
    leaves,
    load_yaml,
    merge,
    nested,
    override,
    path_text,
)
from mqe_jax.envs.registry import ALIASES, SCRIPTED, SHIPPED, TASKS
from mqe_jax.envs.sets import expand
from mqe_jax.train.config import TrainConfig, read_settings

CONFIG_FOLDER = Path(__file__).parent / "configs"
_UNTUNED = "paper/mappo"  # of a cooperative task of one's own

Layers = Mapping[str, Mapping[str, Any]]
"""Changes of settings, as `override` has them, by their name in errors; the last ones count."""


def resolve(
    task: str,
    config: str | Path | TrainConfig | None = None,
    algorithm: str | None = None,
    layers: Mapping[str, Mapping[str, Any]] = FrozenMapping(),
    needs: Callable[[TrainConfig], Mapping[str, Any]] = lambda config: {},
) -> TrainConfig:
    """Returns the settings with which a task is trained: a stack of layers, the lowest first.

    1. The defaults of `TrainConfig`.
    2. The task parameters that `needs` returns for the other layers' settings: those of the
       policies that they name.
    3. The settings of a file or a shipped name; a file changes those that its key `config` names,
       else the default ones, unless it names its task, as that of a run folder does. The default is
       paper/ALGORITHM for an algorithm, else tuned/TASK if it exists, else league for a match and
       paper/mappo for other tasks.
    4. What defines the algorithm.
    5. `onboard.yaml`, if a layer sets the task parameter `senses` and none sets `group`.
    6. `layers`.

    A `TrainConfig` stands for 1 to 5. A parameter in a layer's `env` leaves any lower `train_env`;
    a warning says so of files and 6.

    Raises:
        InputError: for a file, an algorithm or a value that is not allowed, or for sensors above
            the settings whose `group` is `policy`.
    """
    task = ALIASES.get(task, task)
    defined = None if algorithm is None else preset(algorithm)
    if isinstance(config, TrainConfig):
        below = [_Layer.of("", vars(config))]
    else:
        usual = default_name(task) if algorithm is None else f"paper/{algorithm}"
        below = _layers_of(task, usual if config is None else config)
    if defined is not None:
        below.append(_Layer.of("", defined))
    above = [_Layer.of(f"{name}." if name else "", values) for name, values in layers.items()]
    if _select_onboard([*below, *above]):
        below.append(_Layer.of("", _parts("onboard")))
    _check_names(task, [*below, *above])
    control = _joint([*below, *above]).get("env", {}).get("control", "command")
    if control != "command" and not isinstance(config, TrainConfig):
        unscripted = _unscripted(below)
        below.append(unscripted)
        if unscripted.values:
            warn(f"control: the scripted team does not act by {control!r}: training without it")
    given = [layer for layer in below if layer.prefix]  # a file
    shipped = [layer for layer in below if not layer.prefix]
    _warn_of_replaced(_joint(shipped).get("train_env", {}), [*given, *above])
    settings = _stack(TrainConfig(), [*below, *above])
    needed = needs(settings)
    return _stack(TrainConfig(env=needed), [*below, *above]) if needed else settings


class _Layer(NamedTuple):
    """Changes of the settings below."""

    prefix: str
    """What its errors begin with."""
    values: Mapping[str, Any]

    @classmethod
    def of(cls, prefix: str, values: Mapping[str, Any]) -> "_Layer":
        """Returns a layer whose dotted names are nested ones."""
        try:
            values = nested(values)
            for name in ("env", "train_env"):
                if name in values:
                    values[name] = expand(check(name, values[name], Parameters))
        except InputError as error:
            raise InputError(f"{prefix}{error}") from None
        return cls(prefix, values)

    @property
    def env(self) -> Mapping[str, Any]:
        """The task parameters."""
        return self.values.get("env", {})


def _stack(config: TrainConfig, layers: list[_Layer]) -> TrainConfig:
    """Returns settings with the changes of layers; what one breaks, the following may mend."""
    failed: InputError | None = None
    waiting: dict[str, Any] = {}
    for layer in layers:
        config = replace(config, train_env=_without(config.train_env, layer.env))
        waiting = _joined(waiting, layer)
        try:
            config = override(config, waiting)
        except InputError as error:
            failed = failed or InputError(f"{layer.prefix}{error}")
        else:
            failed, waiting = None, {}
    if failed is not None:
        raise failed
    return config


def _joint(layers: list[_Layer]) -> dict[str, Any]:
    """Returns the changes of several layers."""
    return functools.reduce(_joined, layers, {})


def _joined(values: Mapping[str, Any], layer: _Layer) -> dict[str, Any]:
    """Returns changes with those of a further layer, whose `env` leaves their `train_env`."""
    kept = _without(values.get("train_env", {}), layer.env)
    return merge({**values, "train_env": kept}, layer.values)


def _check_names(task: str, layers: list[_Layer]) -> None:
    """Raises an InputError for a parameter of the task among the settings."""
    for layer in layers:
        for name in layer.values.keys() - hints_of(TrainConfig).keys():
            if task in TASKS and name in hints_of(TASKS[task].Params):
                raise InputError(
                    f"{layer.prefix}{name}: is a parameter of the task; it belongs into env"
                )


def _warn_of_replaced(train_env: Mapping[str, Any], above: list[_Layer]) -> None:
    """Warns of parameters of the task that replace those with which settings train."""
    before = dict(leaves(train_env))
    for layer in above:
        both = dict(leaves(layer.values.get("train_env", {})))
        for name, value in leaves(layer.env):
            if before.get(name, value) != value and name not in both:
                warn(f"{name}: {value} replaces {before[name]}, the settings' value in training")


def _without(values: Mapping[str, Any], others: Mapping[str, Any]) -> dict[str, Any]:
    """Returns nested values without those that others have too."""
    kept: dict[str, Any] = {}
    for name, value in merge({}, values).items():
        if name not in others:
            kept[name] = value
        elif isinstance(value, Mapping) and isinstance(others[name], Mapping):
            kept[name] = _without(value, others[name])
    return kept


def _select_onboard(layers: list[_Layer]) -> bool:
    """Returns whether layers set sensors and no group of observations.

    InputError if the group is `policy` in a layer below all those with sensors.
    """
    sensing = [place for place, layer in enumerate(layers) if _has_sensors(layer.env)]
    if not sensing or not _has_sensors(functools.reduce(merge, (layer.env for layer in layers))):
        return False
    grouped = [place for place, layer in enumerate(layers) if "group" in layer.values]
    if not grouped:
        return True
    top = max(grouped)
    if layers[top].values["group"] == "policy" and top < min(sensing):
        fail("group", "policy", "onboard, to read the sensors of env.senses, or set beside them")
    return False


def _has_sensors(env: Mapping[str, Any]) -> bool:
    return env.get("senses", "full") not in ("full", (), [])


def _layers_of(task: str, config: str | Path) -> list[_Layer]:
    """Returns the layers of a shipped name or a file."""
    shipped = ["default", "demo", "laptop", "league", "robust", "sizes", "student"]
    for file in ("paper", "tuned"):
        shipped += [f"{file}/{part}" for part in sorted(_parts(file)) if part != "common"]
    name = path_text(check("config", config, PathText))
    if name == "default":
        return _layers_of(task, default_name(task))
    if name == "demo":  # of the gate, whatever the task
        return _layers_of("go1gate", "laptop")
    if name in shipped:
        changes = name in ("laptop", "robust", "sizes", "student")  # of the default settings
        below = _defaults(task) if changes else []
        if name == "student":
            below += [_Layer.of("", _parts("onboard")), _Layer.of("", {"imitation.teacher": task})]
        file, _, part = name.partition("/")
        parts = [_parts(file)["common"], _parts(file).get(part or task, {})]
        layers = below + [_Layer.of("", values) for values in parts]
        if task in TASKS and task not in SCRIPTED:
            layers.append(_unscripted(layers))
        return layers
    path = Path(name)
    allowed = f"a YAML file, or one of {', '.join(shipped)}"
    if path.suffix not in (".yaml", ".yml") and path.parent == Path("."):
        raise InputError(
            f"config: unknown name {name!r}{nearest(name, shipped)}; allowed: {allowed}"
        )
    if not path.is_file():
        raise InputError(f"config: no file {name!r}; allowed: {allowed}")
    values = read_settings(path)
    base = values.pop("config", None if "task" in values else "default")
    if base is not None and base not in shipped:
        fail(f"{path}: config", base, f"one of {', '.join(shipped)}")
    below = [] if base is None else _layers_of(task, base)
    return [*below, _Layer.of(f"{path}: ", values)]


def _defaults(task: str) -> list[_Layer]:
    """Returns the layers on which changes of default settings rest.

    A cooperative task that has none gets what those of all others have in common.
    """
    name = default_name(task)
    if name == _UNTUNED:
        return [_Layer.of("", _parts("tuned")["common"])]
    return _layers_of(task, name)


def _unscripted(layers: list[_Layer]) -> _Layer:
    """Returns what replaces the scripted policy of layers where there is none."""
    settings = _joint(layers)
    changes: dict[str, Any] = {}
    if settings.get("imitation", {}).get("teacher") == "scripted":
        changes["imitation.teacher"] = None
    if settings.get("curriculum", {}).get("demonstrator") == "scripted":
        changes |= {"curriculum.demonstrator": None, "curriculum.assistance": 0.0}
    opponents = settings.get("opponents", ())
    if "scripted" in opponents:
        others = [name for name in opponents if name != "scripted"]
        changes["opponents"] = ["newest"] * (len(opponents) - len(others)) + others
    return _Layer.of("", changes)


def preset(algorithm: str) -> dict[str, Any]:
    """Returns the settings that define an algorithm, for `override`.

    InputError for an unknown name.
    """
    algorithms = {name: changes for name, changes in _parts("paper").items() if name != "common"}
    if check("algorithm", algorithm, str) not in algorithms:
        fail(
            "algorithm",
            algorithm,
            f"one of {', '.join(algorithms)}{nearest(algorithm, algorithms)}",
        )
    return algorithms[algorithm]


def default_name(task: str) -> str:
    """Returns the name of the settings with which a task is trained by default."""
    if task in _parts("tuned"):
        return f"tuned/{task}"
    return "league" if is_match(task) else _UNTUNED


def is_match(task: str) -> bool:
    """Returns whether a task has two teams."""
    if task in SHIPPED:
        return len(SHIPPED[task].teams) > 1
    from mqe_jax.envs.match import Match

    return task in TASKS and issubclass(TASKS[task], Match)


@functools.cache
def _parts(file: str) -> dict[str, Any]:
    """Returns a shipped file of settings: its parts by name, or settings.

    The part `common` holds the settings of all parts.
    """
    return load_yaml(CONFIG_FOLDER / f"{file}.yaml")
