"""JAX's random bits, the same ones, in programs that take little time to compile.

Unrolled, as in `mqe_jax.core.threefry`, the rounds are half of the operations of an environment's
step. Here they are one reduction, which XLA on a CPU computes in order.
"""

import math
from typing import Any

import jax
import numpy as np
from jax import lax
from jax.extend.random import threefry2x32_p
from jax.interpreters import mlir

ROUNDS = np.array([0, *(13, 15, 26, 6, 17, 29, 16, 24) * 2, 13, 15, 26, 6], np.uint32)
"""Rotations, after a row that sets the counters (21,)."""


def schedule() -> np.ndarray:
    """What each row adds to both counters (42, 6), as multiples of the three keys, of the counters
    with their keys, and of 1.
    """
    table = np.zeros((2, 21, 6), np.uint32)
    table[0, 0, 3] = 1
    table[1, 0, 4] = 1
    for group in range(1, 6):
        table[0, 4 * group, group % 3] = 1
        table[1, 4 * group, (group + 1) % 3] = 1
        table[1, 4 * group, 5] = group
    return table.reshape(42, 6)


def one_round(counters: Any, row: Any) -> Any:
    x0, x1, _ = counters
    add0, add1, bits = row
    x0 = lax.add(x0, x1)
    left = lax.shift_left(x1, bits)
    right = lax.shift_right_logical(x1, lax.sub(np.uint32(32), bits))
    x1 = lax.bitwise_xor(x0, lax.bitwise_or(left, right))
    return lax.add(x0, add0), lax.add(x1, add1), bits


@jax.jit
def threefry(key0: jax.Array, key1: jax.Array, x0: jax.Array, x1: jax.Array) -> Any:
    """Returns what `mqe_jax.core.threefry.threefry` does."""
    shape = np.broadcast_shapes(key0.shape, key1.shape, x0.shape, x1.shape)
    size = math.prod(shape)
    words = [jax.numpy.broadcast_to(x, shape).reshape(1, size) for x in (key0, key1, x0, x1)]
    key0, key1, x0, x1 = words
    key2 = key0 ^ key1 ^ np.uint32(0x1BD11BDA)
    ones = lax.full((1, size), 1, np.uint32)
    parts = lax.concatenate([key0, key1, key2, x0 + key0, x1 + key1, ones], 0)
    added = lax.dot(schedule(), parts)
    bits = lax.broadcast_in_dim(ROUNDS, (21, size), (0,))
    none = np.uint32(0)
    drawn = lax.reduce((added[:21], added[21:], bits), (none, none, none), one_round, (0,))
    return drawn[0].reshape(shape), drawn[1].reshape(shape)


def register() -> None:
    """JAX computes random numbers on the CPU in this way."""
    from mqe_jax.core import threefry as product  # noqa: F401  (which registers another way)

    mlir.register_lowering(
        threefry2x32_p, mlir.lower_fun(threefry, multiple_results=True), platform="cpu"
    )
