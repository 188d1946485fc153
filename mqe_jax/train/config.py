"""Settings of a training: a typed, validated record, read from a flat YAML file."""

from __future__ import annotations

import dataclasses
import difflib
import types
import typing
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import yaml


@dataclass(frozen=True)
class TrainConfig:
    """Settings of the learner; the defaults are the paper's MAPPO (arXiv 2403.16015, through OpenRL)."""

    task: str | None = None
    """Id of the task that the settings are meant for."""
    env: Mapping[str, Any] = field(default_factory=dict)
    """Overrides of the task's parameters, handed to the environment as they are."""
    train_env: Mapping[str, Any] = field(default_factory=dict)
    """Further overrides that hold while training only; evaluations are on the task without them."""
    seed: int = 0
    """Seed of everything random."""
    num_envs: int = 500
    """Worlds stepped together."""
    total_steps: int = 40_000_000
    """Environment steps of the whole training, summed over worlds."""
    rollout_steps: int = 200
    """Steps of every world between two updates."""
    epochs: int = 10
    """Passes over each rollout."""
    minibatches: int = 1
    """Parts into which each pass splits the rollout."""
    learning_rate: float = 7e-4
    """Adam's step size, of actor and critic."""
    learning_rate_schedule: Literal["constant", "linear"] = "constant"
    """Whether the step size stays or falls to zero over the training."""
    target_kl: float | None = None
    """Divergence per minibatch towards which the step size is adapted; none leaves it to the schedule."""
    adam_eps: float = 1e-5
    """Adam's epsilon."""
    max_grad_norm: float | None = 10.0
    """Gradients of a larger norm are scaled down to it; none lets them be."""
    gamma: float = 0.99
    """Discount per step."""
    gae_lambda: float = 0.95
    """Decay of the advantage estimate's trace."""
    aid: float = 0.0
    """How much the task helps at the start, in [0, 1], falling linearly to 0 (`State.aid` of the environment)."""
    aid_until: float = 0.5
    """Part of the training after which it helps no more."""
    failure_bootstrap: float = 0.0
    """Share of the value that a terminated episode still gets, falling linearly to 0: an early failure then costs
    its penalty alone, so that agents dare to try what often fails at first."""
    failure_bootstrap_until: float = 0.5
    """Part of the training after which that share is 0."""
    clip: float = 0.2
    """Half width of the interval to which PPO clips the ratio."""
    dual_clip: float | None = None
    """Bound on the loss of bad actions, in advantages (the paper's variant: 3.0); none switches it off."""
    value_clip: float | None = 0.2
    """Half width of the interval around the old value to which the value loss clips; none switches it off."""
    huber_delta: float | None = 10.0
    """Normalised value error from which on the value loss is linear; none keeps it square."""
    value_coef: float = 0.5
    """Weight of the value loss."""
    entropy_coef: float = 0.01
    """Weight of the entropy bonus."""
    entropy_coef_final: float | None = None
    """Weight of the entropy bonus at the end, reached linearly; none keeps it constant."""
    ratio: Literal["agent", "dimension", "joint"] = "agent"
    """One PPO ratio per agent, per action dimension (OpenRL) or of all agents together (JRPO)."""
    value: Literal["agent", "joint"] = "agent"
    """One value per agent or one for the team, of its mean reward."""
    critic_input: Literal["privileged", "observations", "own"] = "privileged"
    """The critic sees the privileged observation, all agents' observations, or each agent its own."""
    share_policy: bool = True
    """Whether one actor serves all agents or each has its own."""
    hidden_sizes: tuple[int, ...] = (64,)
    """Widths of the hidden layers of actor and critic."""
    activation: Literal["relu", "elu", "tanh"] = "relu"
    """Activation after each hidden layer."""
    recurrent: bool = True
    """Whether a gated recurrent unit follows the hidden layers of actor and critic."""
    gru_size: int = 64
    """Width of that unit."""
    chunk_length: int = 2
    """Steps through which gradients flow back in time; only with `recurrent`."""
    action_gain: float = 0.01
    """Gain of the orthogonal initialisation of the action layer."""
    action_mean: Literal["linear", "tanh"] = "linear"
    """Whether the mean action is free or kept within -1 and 1."""
    log_std_init: float = 0.0
    """Logarithm of the actions' deviation at the start."""
    log_std_max: float | None = None
    """Upper bound of that logarithm, against which an entropy bonus can push; none sets no bound."""
    log_std_min: float | None = None
    """Lower bound of that logarithm, which keeps actions varied to the end; none sets no bound."""
    normalize_observations: bool = False
    """Whether observations are brought to mean 0 and deviation 1 by running statistics."""
    normalize_values: bool = True
    """Whether the critic learns values brought to mean 0 and deviation 1."""
    value_norm_decay: float = 0.99
    """Memory, per rollout, of the statistics that normalise values."""
    normalize_advantages: bool = True
    """Whether a rollout's advantages are brought to mean 0 and deviation 1."""
    advantage_clip: float | None = None
    """Bounds advantages to so many times their median size, by which they are then divided, so that rare great
    losses do not drown everyday gains; none leaves them."""
    advantage_clip_until: float = 1.0
    """Part of the training after which advantages are not bounded any more."""
    stagger_episodes: bool = False
    """Whether the first episodes begin at random times, so that worlds do not reset all at once."""
    checkpoint_every: int = 20
    """Updates between two checkpoints."""
    checkpoints_kept: int = 2
    """Number of the newest checkpoints that stay on disk."""

    def __post_init__(self) -> None:
        _validate(self)

    @property
    def training_env(self) -> dict[str, Any]:
        """Overrides of the task's parameters while training."""
        return {**self.env, **self.train_env}

    @property
    def chunk(self) -> int:
        """Steps of a chunk as learnt from: `chunk_length`, or 1 without memory."""
        return self.chunk_length if self.recurrent else 1

    @property
    def steps_per_update(self) -> int:
        """Environment steps, summed over worlds, between two updates."""
        return self.num_envs * self.rollout_steps

    @property
    def num_updates(self) -> int:
        """Updates of the whole training: `total_steps` in whole rollouts, rounded up."""
        return -(-self.total_steps // self.steps_per_update)


_POSITIVE = (
    "num_envs total_steps rollout_steps epochs minibatches learning_rate target_kl adam_eps max_grad_norm "
    "aid_until failure_bootstrap_until advantage_clip advantage_clip_until clip value_clip huber_delta gru_size "
    "chunk_length action_gain checkpoint_every checkpoints_kept "
).split()
_NOT_NEGATIVE = "seed value_coef entropy_coef entropy_coef_final".split()
_SHARE = "gamma gae_lambda failure_bootstrap aid".split()


def _fail(name: str, value: object, allowed: str) -> typing.NoReturn:
    raise ValueError(f"{name}: {value!r} is not allowed; it must be {allowed}")


def _validate(config: TrainConfig) -> None:
    """Raises a ValueError that names the first field whose value is not allowed."""
    hints = _field_types()
    for name, hint in hints.items():
        object.__setattr__(config, name, _coerce(name, getattr(config, name), hint))
    for name in _POSITIVE:
        value = getattr(config, name)
        if value is not None and not value > 0:
            _fail(name, value, "greater than 0")
    for name in _NOT_NEGATIVE:
        value = getattr(config, name)
        if value is not None and not value >= 0:
            _fail(name, value, "at least 0")
    for name in _SHARE:
        if not 0.0 <= getattr(config, name) <= 1.0:
            _fail(name, getattr(config, name), "between 0 and 1")
    if not 0.0 <= config.value_norm_decay < 1.0:
        _fail("value_norm_decay", config.value_norm_decay, "at least 0 and less than 1")
    if config.dual_clip is not None and not config.dual_clip > 1.0:
        _fail("dual_clip", config.dual_clip, "greater than 1, or none")
    if config.log_std_max is not None and config.log_std_init > config.log_std_max:
        _fail("log_std_init", config.log_std_init, f"at most log_std_max ({config.log_std_max})")
    if config.log_std_min is not None and config.log_std_init < config.log_std_min:
        _fail("log_std_init", config.log_std_init, f"at least log_std_min ({config.log_std_min})")
    if not all(size > 0 for size in config.hidden_sizes) or not config.hidden_sizes:
        _fail("hidden_sizes", config.hidden_sizes, "one or more widths greater than 0")
    if config.rollout_steps % config.chunk:
        _fail("chunk_length", config.chunk_length, f"a divisor of rollout_steps ({config.rollout_steps})")
    chunks = config.num_envs * config.rollout_steps // config.chunk
    if chunks % config.minibatches:
        _fail("minibatches", config.minibatches, f"a divisor of the rollout's number of chunks ({chunks})")
    if config.ratio == "joint" and config.value != "joint":
        _fail("value", config.value, "'joint' when ratio is 'joint'")
    if config.critic_input == "own" and config.value != "agent":
        _fail("value", config.value, "'agent' when critic_input is 'own'")


def _field_types() -> dict[str, Any]:
    hints = typing.get_type_hints(TrainConfig)
    return {f.name: hints[f.name] for f in dataclasses.fields(TrainConfig)}


def _coerce(name: str, value: Any, hint: Any) -> Any:
    """Returns the value as the type of its field; raises a ValueError that names the field."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is types.UnionType:
        if value is None or value == "none":
            return None
        return _coerce(name, value, next(a for a in arguments if a is not types.NoneType))
    if origin is Literal:
        if value not in arguments:
            allowed = ", ".join(repr(a) for a in arguments)
            _fail(name, value, f"one of {allowed}{_suggestion(value, arguments)}")
        return value
    if origin is tuple:
        if isinstance(value, str) or not isinstance(value, Iterable):
            _fail(name, value, "a list of whole numbers")
        return tuple(_coerce(name, item, int) for item in value)
    if hint is bool:
        if not isinstance(value, bool):
            _fail(name, value, "true or false")
        return value
    if hint is str:
        if not isinstance(value, str):
            _fail(name, value, "a text")
        return value
    if hint in (int, float):
        return _coerce_number(name, value, hint)
    if not isinstance(value, Mapping):
        _fail(name, value, "a mapping of parameter names to values")
    return dict(value)


def _coerce_number(name: str, value: Any, kind: type[int] | type[float]) -> int | float:
    """Returns a finite number; a text such as 7e-4, which YAML does not take for a number, is one."""
    allowed = "a whole number" if kind is int else "a number"
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        _fail(name, value, allowed)
    try:
        number = value if isinstance(value, int) else float(value)
    except ValueError:
        _fail(name, value, allowed)
    if not abs(number) < float("inf") or (kind is int and number != int(number)):
        _fail(name, value, allowed)
    return kind(number)


def _suggestion(name: object, known: Iterable[str]) -> str:
    matches = difflib.get_close_matches(str(name), list(known), n=1)
    return f"; did you mean {matches[0]!r}?" if matches else ""


def config_from_mapping(values: Mapping[str, Any]) -> TrainConfig:
    """Makes settings from names and values; unknown names raise a ValueError with the nearest known one."""
    known = _field_types()
    for name in values:
        if name not in known:
            suggestion = _suggestion(name, known) or f"; allowed are {', '.join(known)}"
            raise ValueError(f"{name}: unknown setting (value {values[name]!r}){suggestion}")
    return TrainConfig(**values)


def config_to_mapping(config: TrainConfig) -> dict[str, Any]:
    """Returns the settings as plain values that JSON and YAML can hold.

    Raises ValueError for an override in `env` that is no such value.
    """
    return {f.name: _plain(f.name, getattr(config, f.name)) for f in dataclasses.fields(config)}


def _plain(name: str, value: Any) -> Any:
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Mapping):
        return {str(k): _plain(f"{name}.{k}", v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(f"{name}[{i}]", v) for i, v in enumerate(value)]
    _fail(name, value, "a number, a text, true, false, none, or lists and mappings of these")


def load_config(path: str | Path, **overrides: Any) -> TrainConfig:
    """Reads settings from a YAML file; `overrides` replace what the file says (`env` is merged).

    Raises a ValueError that names the file for anything that is wrong in it.
    """
    path = Path(path)
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{path}: cannot be read as YAML settings ({reason})") from None
    values = {} if values is None else values
    if not isinstance(values, dict):
        raise ValueError(f"{path}: holds {type(values).__name__}; it must be a mapping of settings to values")
    for name in ("env", "train_env"):
        if isinstance(values.get(name), Mapping) and isinstance(overrides.get(name), Mapping):
            overrides = {**overrides, name: {**values[name], **overrides[name]}}
    try:
        return config_from_mapping({**values, **overrides})
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
