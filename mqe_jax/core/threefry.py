"""JAX's random numbers on a CPU, the same ones, without the loops in which JAX computes them there.

The loops' small operations cost run time in every environment step, and more time to compile than
the unrolled rounds.
"""

from typing import Any

import jax
import numpy as np
from jax.extend.random import threefry2x32_p
from jax.interpreters import mlir

_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))


def threefry(key0: Any, key1: Any, x0: Any, x1: Any) -> tuple[Any, Any]:
    """Returns the random bits of two counters, by Threefry-2x32 with 20 rounds; all uint32.

    Source: Salmon et al. 2011.
    """
    if key0.size == 1 < x0.size:
        # The barrier keeps the splits that a key comes from out of the loop over its numbers, which
        # LLVM of jaxlib 0.11 otherwise does not compile within 25 minutes.
        key0, key1 = jax.lax.optimization_barrier((key0, key1))
    keys = key0, key1, key0 ^ key1 ^ np.uint32(0x1BD11BDA)
    x0 = x0 + keys[0]
    x1 = x1 + keys[1]
    for group in range(1, 6):
        for bits in _ROTATIONS[(group - 1) % 2]:
            x0 = x0 + x1
            x1 = x0 ^ (x1 << np.uint32(bits) | x1 >> np.uint32(32 - bits))
        x0 = x0 + keys[group % 3]
        x1 = x1 + keys[(group + 1) % 3] + np.uint32(group)
    return x0, x1


mlir.register_lowering(
    threefry2x32_p, mlir.lower_fun(threefry, multiple_results=True), platform="cpu"
)
