"""Keyword overrides of frozen dataclasses: by name, nested by mapping or dotted name, checked and converted."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Mapping
from typing import Any, TypeVar

from mqe_jax.errors import nearest

Range = tuple[float, float]
T = TypeVar("T")


def override(config: T, changes: Mapping[str, Any], where: str = "") -> T:
    """Returns a dataclass with fields replaced.

    `changes` maps field names to values; `{"rewards": {"success": 3}}` and `{"rewards.success": 3}` both reach
    into a nested dataclass.

    Raises:
        ValueError: for an unknown name (with the nearest match) or a value of the wrong type.
    """
    hints = typing.get_type_hints(type(config))
    names = [field.name for field in dataclasses.fields(typing.cast(Any, config))]
    new: dict[str, Any] = {}
    nested: dict[str, dict[str, Any]] = {}
    for key, value in changes.items():
        name, _, rest = key.partition(".")
        if name not in names:
            raise ValueError(f"{where}{key}: unknown parameter{nearest(name, names)}; allowed: {', '.join(names)}")
        if rest:
            nested.setdefault(name, {})[rest] = value
        elif dataclasses.is_dataclass(getattr(config, name)) and isinstance(value, Mapping):
            nested.setdefault(name, {}).update(value)
        else:
            new[name] = convert(value, hints[name], where + name)
    for name, part in nested.items():
        inner = getattr(config, name)
        if not dataclasses.is_dataclass(inner):
            raise ValueError(f"{where}{name}: has no parameters of its own; got {sorted(part)}")
        new[name] = override(inner, part, f"{where}{name}.")
    try:
        return dataclasses.replace(typing.cast(Any, config), **new)
    except ValueError as error:
        raise ValueError(f"{where}{error}") from None


def convert(value: Any, hint: Any, name: str) -> Any:
    """Returns a value as the type that a field has, or raises a ValueError that names field, value and type."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in parts:
            return None
        for part in parts:
            if part is not type(None):
                return convert(value, part, name)
    wrong = ValueError(f"{name}: {value!r} is not {_spell(hint)}")
    if dataclasses.is_dataclass(hint):
        if isinstance(value, typing.cast(type, hint)):
            return value
        raise wrong
    if hint is bool:
        if isinstance(value, bool):
            return value
        raise wrong
    if hint is int:
        if isinstance(value, int) and not isinstance(value, bool):
            return value
        raise wrong
    if hint is float:
        if isinstance(value, int | float) and not isinstance(value, bool) and value == value:
            return float(value)
        raise wrong
    if hint is str:
        if isinstance(value, str):
            return value
        raise wrong
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise wrong
        kinds = [parts[0]] * len(value) if len(parts) == 2 and parts[1] is Ellipsis else list(parts)
        if len(kinds) != len(value):
            raise wrong
        return tuple(convert(item, kind, name) for item, kind in zip(value, kinds, strict=True))
    return value


def _spell(hint: Any) -> str:
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin is tuple:
        if len(parts) == 2 and parts[1] is Ellipsis:
            return f"a list of {_spell(parts[0])}"
        return f"a list of {len(parts)} numbers"
    names = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}
    return names.get(hint, getattr(hint, "__name__", str(hint)))
