"""Training settings as command-line flags, derived from the settings records."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection
from typing import Annotated, Any

import tyro
import yaml

from mqe_jax.settings import describe, hints_of, is_record
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.networks import NETWORKS, NetworkSettings

_NOT_GIVEN: Any = object()
_HIDDEN = ("task", "env", "train_env")  # given by other arguments


def train_flags() -> Any:
    """Returns a dataclass with one optional flag for every training setting; `given` reads it."""
    return _flags((TrainConfig,), _HIDDEN)


def given(flags: Any) -> dict[str, Any]:
    """Returns the settings that were given as flags, nested as in YAML."""
    values = {field.name: getattr(flags, field.name) for field in dataclasses.fields(flags)}
    values = {name: given(value) if dataclasses.is_dataclass(value) else value for name, value in values.items()}
    return {name: value for name, value in values.items() if value is not _NOT_GIVEN and value != {}}


def _flags(kinds: Collection[type[Any]], hidden: Collection[str] = ()) -> Any:
    """Returns a dataclass of optional flags for the fields of records; docstrings are those of the records.

    Every field of several records (the registered networks) becomes a flag; validation rejects the flags of records
    that are not selected.
    """
    fields = {}
    for kind in kinds:
        for name, hint in hints_of(kind).items():
            default = next(field.default for field in dataclasses.fields(kind) if field.name == name)
            if name in hidden:
                flag: tuple[Any, Any] = (Annotated[Any, tyro.conf.Suppress], _NOT_GIVEN)
            elif is_record(default):
                inner = _flags(tuple(NETWORKS.values()) if isinstance(default, NetworkSettings) else (type(default),))
                flag = (inner, inner())
            else:
                flag = (_leaf(hint, default), _NOT_GIVEN)
            fields.setdefault(name, flag)
    return dataclasses.make_dataclass(
        "Flags",
        [(name, hint, dataclasses.field(default=default)) for name, (hint, default) in fields.items()],
        bases=tuple(kinds),  # tyro reads their docstrings
        namespace={"__post_init__": lambda self: None},
        frozen=True,
        kw_only=True,
    )


def _leaf(hint: Any, default: Any) -> Any:
    """Returns the annotation of a flag whose text is read as YAML and validated later, with the other settings."""
    several = "a list of" in describe(hint)
    read: Callable[[list[str]], Any] = _read_several if several else lambda texts: yaml.safe_load(texts[0])
    spec = tyro.constructors.PrimitiveConstructorSpec(
        nargs="*" if several else 1,
        metavar="VALUE",
        instance_from_str=read,
        is_instance=lambda value: True,
        str_from_instance=lambda value: [str(value)],
    )
    shown = " ".join(map(str, default)) if isinstance(default, tuple) else "none" if default is None else default
    hint_text = f"({describe(hint).removesuffix(', or none')}; default: {str(shown).lower()})"
    return Annotated[Any, spec, tyro.conf.arg(help_behavior_hint=hint_text)]


def _read_several(texts: list[str]) -> Any:
    """Reads `64 64` or `[64, 64]` as a list."""
    values = [yaml.safe_load(text) for text in texts]
    return values[0] if len(values) == 1 and isinstance(values[0], list) else values
