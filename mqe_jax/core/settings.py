"""Typed, validated settings classes, built from keyword arguments, mappings, dotted names or YAML.

A settings class is a frozen dataclass whose annotations hold the type and the bounds of each field:

    @settings_class
    class Ppo:
        clip: Positive = 0.2
        \"\"\"Half width of the clipping interval of the ratio.\"\"\"

Fields are given by keyword. Every constructor, `Ppo(clip=0.1)` included, validates the fields and
raises a one-line `InputError`: `ppo.clip: -1 is not allowed; it must be greater than 0`.

Every number has bounds: those of its kind (`mqe_jax.core.limits`), or of `Number` and `Integer` for
a plain `float` or `int`. Numpy scalars are numbers, and so are strings such as "7e-4", which YAML
does not read as a number. Booleans and bytes are not. For an optional field, "none" means None.
"""

import contextlib
import dataclasses
import functools
import inspect
import itertools
import math
import os
import re
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, ParamSpec, TypeVar, dataclass_transform

import pydantic
import pydantic_core
from annotated_types import Ge, Le
from pydantic.dataclasses import dataclass as pydantic_dataclass

from mqe_jax.core import limits
from mqe_jax.core.errors import InputError, brief, nearest, short_repr
from mqe_jax.core.files import read_yaml
from mqe_jax.core.limits import (  # noqa: F401  (for modules that declare settings)
    Coordinate,
    Factor,
    Fraction,
    NonNegative,
    NonNegativeInt,
    Number,
    Offset,
    Payload,
    Positive,
    PositiveFriction,
    PositiveInt,
    Seed,
)

T = TypeVar("T")
P = ParamSpec("P")
R = TypeVar("R")


class FrozenMapping(Mapping[str, Any]):
    """An immutable, hashable mapping for settings; equal to any mapping with its entries."""

    def __init__(self, values: Mapping[str, Any] = {}) -> None:
        self._values = dict(values)

    def __getitem__(self, name: str) -> Any:
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __hash__(self) -> int:
        return hash(frozenset(self))  # the names: values may be lists

    def __repr__(self) -> str:
        return repr(self._values)


_CONFIG = pydantic.ConfigDict(extra="forbid", allow_inf_nan=False, arbitrary_types_allowed=True)


def _check_order(value: tuple[float, float]) -> tuple[float, float]:
    if value[0] > value[1]:
        raise ValueError("[lowest, highest], in this order")
    return value


def _check_pair(value: Any) -> Any:
    value = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(value, str) or not isinstance(value, Sequence) or len(value) != 2:
        raise ValueError("[lowest, highest]")
    return value


_Pair = pydantic.BeforeValidator(_check_pair)
_Order = pydantic.AfterValidator(_check_order)
Range = Annotated[tuple[Number, Number], _Pair, _Order]
Frictions = Annotated[tuple[PositiveFriction, PositiveFriction], _Pair, _Order]
Payloads = Annotated[tuple[Payload, Payload], _Pair, _Order]
Offsets = Annotated[tuple[Offset, Offset], _Pair, _Order]
Factors = Annotated[tuple[Factor, Factor], _Pair, _Order]
Coordinates = Annotated[tuple[Coordinate, Coordinate], _Pair, _Order]


def _parameters(value: Mapping[str, Any]) -> Mapping[str, Any]:
    for name in ("task", "impl", "num_envs"):
        if name in value:
            raise InputError(f"{name}: is not a task parameter, but an argument of its own")
    return value


Parameters = Annotated[Mapping[str, Any], pydantic.AfterValidator(_parameters)]
"""A task's parameters by name; the control mode may be among them."""


@dataclass_transform(
    frozen_default=True, kw_only_default=True, field_specifiers=(dataclasses.field,)
)
def settings_class(cls: type[T]) -> type[T]:
    """Makes a class a frozen, keyword-only dataclass that validates its fields.

    Checks that involve several fields go into `__post_init__`, which may call `fail` with the
    field's name; messages of nested settings are prefixed with their path. A subclass must be
    decorated too.
    """
    hints = typing.get_type_hints(cls, include_extras=True)
    for name in vars(cls).keys() - inspect.get_annotations(cls).keys():
        value = vars(cls)[name]
        if is_settings(value) and not isinstance(value, type):
            kind = type(value).__name__
            raise InputError(f"{cls.__name__}: {name} is no field; write {name}: {kind} = {kind}()")
    cls.__annotations__ = {name: _accept_yaml(hints[name]) for name in inspect.get_annotations(cls)}
    made = pydantic_dataclass(frozen=True, kw_only=True, config=_CONFIG)(cls)

    @functools.wraps(made.__init__)
    def checked_init(self: Any, /, **values: Any) -> None:
        try:  # as pydantic's own `__init__`, which has no value named as its argument
            self.__pydantic_validator__.validate_python(
                pydantic_core.ArgsKwargs((), values), self_instance=self
            )
        except pydantic.ValidationError as error:
            raise _one_line(made, error) from None

    made.__init__ = checked_init  # pyright: ignore[reportAttributeAccessIssue]
    return typing.cast(type[T], made)


def name_settings(cls: type[Any], name: str) -> type[Any]:
    """Makes a class a settings class whose field `name` tells it from those of other names."""
    cls.__annotations__ = {"name": Literal[name], **cls.__annotations__}
    cls.name = name
    return settings_class(cls)


def _path(value: Any) -> Any:
    if not isinstance(value, str | Path) or not str(value) or not is_text(str(value)):
        raise ValueError(f"a path, or a text that is not empty, {TEXT}")
    if any(len(os.fsencode(part)) > limits.FILE_NAME for part in Path(value).parts):
        raise ValueError(f"a path whose parts have at most {limits.FILE_NAME} bytes")
    return _expand_home(value)


def path_text(value: str | Path) -> str:
    """Returns a text, or that of a path, which no name equals: ./go1gate for Path("go1gate")."""
    text = str(value)
    return os.path.join(os.curdir, text) if isinstance(value, Path) and os.sep not in text else text


def _expand_home(value: Any) -> Any:
    """Returns a text or path with the home folder in place of a `~` at its beginning."""
    if not isinstance(value, str | Path) or not str(value).startswith("~"):
        return value
    expanded = os.path.expanduser(str(value))
    if str(value).split("/")[0] == "~" and expanded == str(value):
        raise ValueError("a path without ~, for there is no home folder")
    return type(value)(expanded)


PathText = Annotated[str | Path, pydantic.PlainValidator(_path)]
"""A path, or a text that is one."""
FileName = Annotated[str, pydantic.AfterValidator(_path)]
"""A text that is a path."""


TEXT = f"at most {limits.TEXT} characters, none of which is a control character"
"""What `is_text` allows."""


def is_text(value: str) -> bool:
    """Returns whether a text can be a name or a path, and be printed."""
    return len(value) <= limits.TEXT and not any(
        ord(x) < 32 or 0xD800 <= ord(x) < 0xE000 for x in value
    )


_PLACES = {
    "config": "; settings of a training are in `config`",
    "env": "; parameters of the task are in `env`",
}
"""Arguments that hold values by name, and what a message says of them."""


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """Makes a public function check its arguments against their annotations, as settings are.

    Checked are texts, numbers, booleans, paths, functions, sequences and mappings of these,
    settings classes, and what has a validator. Arrays and other objects are not.
    """
    signature = inspect.signature(function)

    @functools.cache  # when the function is called, whatever its annotations name is defined
    def kinds() -> dict[str, Any]:
        return _kinds_of(function)

    @functools.wraps(function)
    def call(*given: P.args, **named: P.kwargs) -> R:
        try:
            bound = signature.bind(*given, **named)
        except TypeError as error:
            known = signature.parameters
            hints = [nearest(name, known, 0.8) for name in named if name not in known]
            if hints:
                hints += [text for name, text in _PLACES.items() if name in known]
            raise TypeError(f"{function.__name__}: {error}{''.join(hints)}") from None
        for name, kind in kinds().items():
            if name in bound.arguments:
                bound.arguments[name] = check(name, bound.arguments[name], kind)
        return function(*bound.args, **bound.kwargs)

    return call


def _kinds_of(function: Callable[..., Any]) -> dict[str, Any]:
    """Returns the kinds of the arguments that `checked` checks."""
    kinds = {}
    scope = inspect.unwrap(function).__globals__  # pyright: ignore[reportAttributeAccessIssue]
    for name, parameter in inspect.signature(function).parameters.items():
        hint = parameter.annotation
        if isinstance(hint, str):
            with contextlib.suppress(NameError):  # of a class that type checkers alone import
                hint = eval(hint, scope)
        parts = typing.get_args(hint) or (hint,)
        if Path in parts and {*parts} <= {str, Path, types.NoneType}:
            hint = PathText if types.NoneType not in parts else typing.Optional[PathText]  # noqa: UP045
        if _is_data(hint) and parameter.kind is not inspect.Parameter.VAR_KEYWORD:
            kinds[name] = hint
    return kinds


def _is_data(hint: Any) -> bool:
    """Returns whether an annotation is one of data, which the kinds of settings describe."""
    origin = typing.get_origin(hint)
    parts = typing.get_args(hint)
    if origin in (Annotated, Literal, Callable):
        return True
    if origin is Mapping and parts[1] is Any:
        return _is_data(parts[0])
    if origin in (typing.Union, types.UnionType, tuple, list, Sequence, Mapping):
        return Path not in parts and all(map(_is_data, parts))
    return hint in (str, int, float, bool, types.NoneType, Ellipsis) or is_settings(hint)


def check(name: str, value: Any, kind: Any) -> Any:
    """Returns a value converted to a type; raises the InputError of `fail` if that fails."""
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        return value if isinstance(value, kind) else fail(name, value, f"a {kind.__name__}")
    try:
        return _adapter(kind).validate_python(value)
    except pydantic.ValidationError as error:
        text = str(_one_line(None, error))
        raise InputError(f"{name}{text if text.startswith(':') else f'.{text}'}") from None


@functools.cache
def _adapter(kind: Any) -> pydantic.TypeAdapter[Any]:
    return pydantic.TypeAdapter(_accept_yaml(kind), config=_CONFIG)


def is_settings(kind: object) -> bool:
    """Returns whether a type (or an instance's type) was made by `settings_class`."""
    return dataclasses.is_dataclass(kind) and pydantic.dataclasses.is_pydantic_dataclass(
        kind if isinstance(kind, type) else type(kind)
    )


def fail(name: str, value: object, allowed: str) -> NoReturn:
    """Raises the `InputError` of a value that is not allowed.

    Its text is `name: value is not allowed; it must be ...`.
    """
    raise InputError(f"{name}: {short_repr(value)} is not allowed; it must be {allowed}")


def check_call(name: str, function: Callable[..., Any], *arguments: str) -> None:
    """Raises the `InputError` of a function that cannot be called with these arguments."""
    try:
        signature = inspect.signature(function)
    except ValueError:  # of a builtin function
        return
    try:
        signature.bind(*arguments)
    except TypeError:
        found = f"{getattr(function, '__name__', 'function')}{signature}"
        fail(name, found, f"a function of ({', '.join(arguments)})")


def build(kind: type[T], values: Mapping[str, Any]) -> T:
    """Builds settings from names and values.

    They may be nested (`{"ppo": {"clip": 0.1}}`) or dotted (`{"ppo.clip": 0.1}`).

    InputError for a value that is not allowed or an unknown name, with the nearest known one.
    """
    if not (isinstance(kind, type) and is_settings(kind)):
        fail("kind", kind, "a class of settings, such as TrainConfig")
    return kind(**_joined(kind, {}, values))


def override(settings: T, changes: Mapping[str, Any]) -> T:
    """Returns settings with fields replaced, named as in `build`; mappings are merged.

    InputError as `build`.
    """
    if not is_settings(settings):
        fail("settings", settings, "an instance of a settings class, such as TrainConfig()")
    return type(settings)(**_joined(type(settings), _fields(settings), changes))


def _joined(kind: Any, first: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    if not isinstance(changes, Mapping):
        fail(kind.__name__, changes, "a mapping of names to values")
    return merge(first, nested(changes))


def nested(changes: Mapping[str, Any]) -> dict[str, Any]:
    """Returns changes with dotted names as nested ones.

    InputError for a name that is given twice.
    """
    made = merge({}, changes)  # which rejects what is nested too deep
    given = sorted(leaves(changes), key=lambda pair: pair[0])
    for (name, value), (following, _) in itertools.pairwise(given):
        if name == following:
            raise InputError(f"{name}: is given twice")
        if following.startswith(f"{name}.") and not is_settings(value):
            raise InputError(f"{name}: is given as a whole and as {following}")
    return made


def differences(settings: Any, default: Any) -> dict[str, Any]:
    """Returns the fields that differ from other settings of the same type, by dotted names."""
    found: dict[str, Any] = {}
    for name, value in _fields(settings).items():
        other = getattr(default, name)
        if is_settings(value) and type(value) is type(other):
            found |= {f"{name}.{inner}": each for inner, each in differences(value, other).items()}
        elif value != other:
            found[name] = value
    return found


def leaves(mapping: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yields the dotted names and values of nested settings."""
    for name, value in mapping.items():
        if isinstance(value, Mapping) and value:
            yield from leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def merge(
    first: Mapping[str, Any], second: Mapping[str, Any], depth: int = limits.DEPTH
) -> dict[str, Any]:
    """Returns two mappings merged at every depth, dotted names as nested ones.

    The second's values count.

    Settings with a `name`, which selects one of several classes, are replaced as a whole.
    InputError for mappings that are nested more than `depth` deep.
    """
    both: dict[str, Any] = {}
    for key, value in (*first.items(), *second.items()):
        name, dot, rest = str(key).partition(".")
        value = {rest: value} if dot else value
        if isinstance(value, Mapping):
            if not depth:
                fail(name, value, f"nested at most {limits.DEPTH} deep")
            now = _fields(both.get(name))
            kind = now.get("name")
            if is_settings(both.get(name)) and value.get("name", kind) != kind:
                now = {}
            value = merge(now, value, depth - 1)
        both[name] = value
    return both


def to_mapping(settings: Any) -> dict[str, Any]:
    """Returns settings as nested mappings, lists and scalars for YAML and JSON.

    InputError for any other value.
    """

    def plain(value: Any) -> Any:
        if hasattr(value, "tolist"):
            return value.tolist()
        if isinstance(value, FrozenMapping):
            return dict(value)
        fail(
            type(settings).__name__,
            value,
            "a number, a string, true, false, none, or lists and mappings of these",
        )

    return pydantic_core.to_jsonable_python(settings, fallback=plain)


def load_yaml(path: str | Path) -> dict[str, Any]:
    """Reads names and values from a YAML file, which may be empty.

    InputError, naming it, if it is no mapping.
    """
    values = read_yaml(Path(path))
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise InputError(
            f"{path}: holds {type(values).__name__}; it must be a mapping of settings to values"
        )
    return {str(name): value for name, value in values.items()}


def hints_of(kind: Any) -> dict[str, Any]:
    """Returns the annotated types of a settings class's fields by name."""
    hints = typing.get_type_hints(kind, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(kind)}


def _accept_yaml(hint: Any) -> Any:
    """Returns an annotated type that accepts YAML's spellings, and rejects booleans as numbers."""
    origin = typing.get_origin(hint)
    parts = typing.get_args(hint)
    if origin is Annotated and parts[0] in (int, float):
        return _add_bounds(hint)
    if origin is Annotated:  # pydantic applies the last validators of an annotation first
        kind, *conversions = typing.get_args(Annotated[_accept_yaml(parts[0]), None])[:-1]
        return Annotated[(kind, *parts[1:], *conversions)]  # type: ignore[return-value]
    if origin in (typing.Union, types.UnionType):
        union = typing.Union[tuple(_accept_yaml(part) for part in parts)]  # noqa: UP007
        if types.NoneType not in parts:
            return union
        return Annotated[union, pydantic.BeforeValidator(_none)]
    if origin is tuple:
        return tuple[tuple(part if part is Ellipsis else _accept_yaml(part) for part in parts)]  # type: ignore[misc]
    if origin in (Mapping, Sequence, list):
        made = origin[tuple(map(_accept_yaml, parts))]  # type: ignore[index]
        if origin is not Mapping:
            return made
        return Annotated[made, pydantic.AfterValidator(FrozenMapping)]
    if hint in (int, float):
        return _add_bounds(Annotated[hint, None])
    before = {bool: _boolean, str: _text, Path: _text}.get(hint)
    return hint if before is None else Annotated[hint, pydantic.BeforeValidator(before)]


def _add_bounds(hint: Any) -> Any:
    """Returns an annotated number, with the default bound on each side without one."""
    kind, *parts = typing.get_args(hint)
    low, high = limits.bounds(hint)
    default = limits.bounds(limits.Integer if kind is int else limits.Number)
    parts += [Ge(default[0])] * (low == -math.inf) + [Le(default[1])] * (high == math.inf)
    return Annotated[(kind, *parts, pydantic.BeforeValidator(functools.partial(_number, kind)))]  # type: ignore


def _none(value: Any) -> Any:
    return None if isinstance(value, str) and value.lower() == "none" else value


def _number(kind: type, value: Any) -> Any:
    if type(value).__name__.startswith(("bool", "byte")):
        raise ValueError("a number")
    try:
        return float(value) if isinstance(value, str) and kind is int else value
    except ValueError:
        return value


def _text(value: Any) -> Any:
    unprintable = isinstance(value, str | Path) and not is_text(str(value))
    if unprintable or isinstance(value, bytes | bytearray):
        raise ValueError(f"a text, {TEXT}")
    value = _expand_home(value)
    return path_text(value) if isinstance(value, Path) else value


def _boolean(value: Any) -> bool:
    if not type(value).__name__.startswith("bool"):  # of Python or numpy
        raise ValueError("true or false")
    return bool(value)


def _fields(value: Any) -> Mapping[str, Any]:
    """Returns a mapping, or settings as one; empty for another value."""
    if is_settings(value):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    return value if isinstance(value, Mapping) else {}


def _settings_in(hint: Any) -> Any:
    """Returns the settings class within an annotated or optional type, or None."""
    if is_settings(hint):
        return hint
    inner = map(_settings_in, typing.get_args(hint))
    return next((found for found in inner if found is not None), None)


def _names_within(kind: Any) -> Iterator[str]:
    """Yields the dotted names of the fields within those fields that are settings."""
    for field in dataclasses.fields(kind):
        if is_settings(field.default):
            yield from (f"{field.name}.{inner}" for inner in hints_of(type(field.default)))


def _one_line(kind: Any, error: pydantic.ValidationError) -> InputError:
    """Returns the first error of a validation: path, value, and what is allowed."""
    first = error.errors(include_url=False)[0]
    places = [brief(str(part)) for part in first["loc"]]
    value = first["input"]
    context = first.get("ctx", {})
    raised = context.get("error")
    if isinstance(raised, InputError):
        named = places and re.match(rf"{re.escape(places[-1])}[:.]", str(raised))
        return InputError(".".join([*(places[:-1] if named else places), str(raised)]))
    if first["type"] == "unexpected_keyword_argument":
        inner = _names_within(kind)
        for part in places[:-1]:
            kind = _settings_in(hints_of(kind).get(part)) or kind  # keys of a mapping are no fields
        known = list(hints_of(kind))
        hint = f"{nearest(places[-1], [*known, *inner])}; allowed: {', '.join(known)}"
        return InputError(f"{'.'.join(places)}: unknown name (value {short_repr(value)}){hint}")
    if first["type"] == "missing":
        return InputError(f"{'.'.join(places)}: is missing")
    allowed = first["msg"]
    for theirs, ours in _WORDS.items():
        allowed = allowed.replace(theirs, ours)
    if first["type"].startswith("dataclass"):
        allowed = "it must be a mapping of names to values"
    choices = [word.strip("'") for word in re.split(", | or ", context.get("expected", "")) if word]
    return InputError(
        f"{'.'.join(places)}: {short_repr(value)} is not allowed; "
        f"{allowed}{nearest(value, choices)}"
    )


_WORDS = {
    "Input should be": "it must be",
    "Value error, ": "it must be ",
    "a valid tuple": "a list",
    "a valid dictionary": "a mapping of names to values",
}
"""Words of pydantic's messages, and ours."""
