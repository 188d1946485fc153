"""Random numbers on a CPU."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.random import threefry_2x32

from mqe_jax.core import threefry  # noqa: F401

VECTORS = [
    (0x00000000, 0x00000000, 0x00000000, 0x00000000, 0x6B200159, 0x99BA4EFE),
    (0xFFFFFFFF, 0xFFFFFFFF, 0xFFFFFFFF, 0xFFFFFFFF, 0x1CB996FC, 0xBB002BE7),
    (0x13198A2E, 0x03707344, 0x243F6A88, 0x85A308D3, 0xC4923A9C, 0x483DF7A0),
]
"""Key, counter and result of the reference implementation (Random123, kat_vectors)."""


@pytest.mark.parametrize("vector", VECTORS)
def test_the_bits_are_those_of_the_reference(vector: tuple[int, ...]) -> None:
    key, counter, bits = np.split(np.array(vector, np.uint32), 3)
    np.testing.assert_array_equal(threefry_2x32(jnp.asarray(key), jnp.asarray(counter)), bits)


def test_random_numbers_are_compiled_without_loops() -> None:
    draw = jax.jit(jax.vmap(lambda key: jax.random.normal(jax.random.split(key, 3)[1], (5,))))
    text = draw.lower(jax.random.split(jax.random.PRNGKey(0), 4)).compile().as_text()
    assert text and " while(" not in text


def test_numbers_of_a_key_after_several_splits_are_compiled() -> None:
    """jaxlib 0.11 did not finish in 25 minutes, so that no training began on a CPU."""
    code = """
import jax
from mqe_jax.core import threefry

def draw(key):
    first, _ = jax.random.split(key)
    second, _, _ = jax.random.split(first, 3)
    third, _ = jax.random.split(second, 2)
    return jax.random.normal(third, (64, 64))

jax.jit(draw).lower(jax.random.PRNGKey(0)).compile()
"""
    usual = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}  # tests optimise less
    subprocess.run([sys.executable, "-c", code], env=usual, check=True, timeout=100)
