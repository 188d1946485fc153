"""Single precision, whatever `jax_enable_x64` is."""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax

P = ParamSpec("P")
R = TypeVar("R")


def single(function: Callable[P, R]) -> Callable[P, R]:
    """Makes a function compute in float32 and int32, even in a trace with `jax_enable_x64`.

    It broadcasts shapes, also with `jax_numpy_rank_promotion`.

    The function and all that it calls, such as a user's task or engine, need no dtype in each
    `jnp.zeros`.
    """

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        with jax.enable_x64(False), jax.numpy_rank_promotion("allow"):
            return function(*args, **kwargs)

    return call
