"""Checks of the methods of tasks and sensors: what they take, and what they return.

A ValueError names the method, the value and what is expected.
"""

import inspect
from collections.abc import Iterable, Mapping
from typing import Any, NoReturn

import jax
import jax.numpy as jnp

from mqe_jax.core.errors import short_repr


def weights_of(params: Any) -> Any:
    """Returns the weights of the reward terms, the field `rewards` of a task's parameters."""
    if not hasattr(params, "rewards"):
        _fail(
            f"Params = {type(params).__name__}",
            "no field rewards",
            "one, the weights of the reward terms",
        )
    return params.rewards


def check_signatures(kind: type, base: type) -> None:
    """Checks that the methods that a class overrides take the arguments of those of its base."""
    for name, own in inspect.getmembers(kind, inspect.isfunction):
        usual = getattr(base, name, own)
        if own is usual or name == "__init__":
            continue
        expected = inspect.signature(usual)
        found = inspect.signature(own)
        try:
            found.bind(*expected.parameters)
        except TypeError:
            _fail(f"{kind.__name__}.{name}", found, f"({', '.join(expected.parameters)})")


def check_names(method: str, values: Any, names: Iterable[str]) -> None:
    """Checks that values are a mapping of these names."""
    if not isinstance(values, Mapping) or set(values) != set(names):
        found = sorted(values) if isinstance(values, Mapping) else _kind(values)
        _fail(method, found, f"by name: {sorted(names)}")


def check_shape(method: str, value: Any, *shapes: tuple[int, ...], dtype: Any = None) -> jax.Array:
    """Returns an array of one of these shapes, and of a dtype if one is given."""
    same_shape = value is not None and jnp.shape(value) in shapes
    if not same_shape or dtype not in (None, getattr(value, "dtype", type(value))):
        expected = " or ".join(map(str, shapes))
        _fail(method, _kind(value), expected if dtype is None else f"{expected} {dtype.__name__}")
    return jnp.asarray(value)


def numbers(method: str, values: Any) -> dict[str, jax.Array]:
    """Returns numbers () by name."""
    if not isinstance(values, Mapping):
        _fail(method, _kind(values), "numbers by name")
    return {name: check_shape(f"{method}: {name}", value, ()) for name, value in values.items()}


def results(method: str, values: Any) -> dict[str, jax.Array]:
    """Returns `success` and further numbers () by name."""
    found = numbers(method, values)
    if "success" not in found:
        _fail(method, sorted(found), "success, and further results by name")
    return found


def alike(method: str, values: Any, before: Any) -> Any:
    """Returns a pytree with the structure, shapes and dtypes of another."""
    now = jax.tree.map(_kind, values)
    then = jax.tree.map(_kind, before)
    if jax.tree.flatten(now) != jax.tree.flatten(then):
        _fail(method, now, f"as before, {then}")
    return values


def _kind(value: Any) -> str:
    """Returns the shape and dtype of an array, or what else a value is."""
    if isinstance(value, bool | int | float) or hasattr(value, "dtype"):
        return f"{jnp.shape(value)} {jnp.result_type(value)}"
    return short_repr(value)


def _fail(method: str, found: object, expected: str) -> NoReturn:
    raise ValueError(f"{method}: {found}; expected {expected}")
