"""Whether an update has made numbers NaN or infinite."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp

from mqe_jax.core.errors import NonFiniteError
from mqe_jax.core.types import PyTree, raw_keys
from mqe_jax.train.checkpoint import latest, nonfinite

_METRICS = ("loss/policy", "loss/value", "entropy", "approx_kl", "grad_norm")


def all_finite(tree: PyTree) -> jax.Array:
    """Returns whether all numbers of a pytree are finite (), computed on the device."""
    arrays = jax.tree.leaves(raw_keys(tree))
    return _finite([x for x in arrays if x.size])  # jaxlib cannot compile empty ones of several processes


@jax.jit
def _finite(arrays: list[jax.Array]) -> jax.Array:
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in arrays]))


def nonfinite_metrics(row: Mapping[str, float]) -> list[str]:
    """Returns the names of the metrics of an update that are NaN or infinite."""
    return [name for name in _METRICS if not math.isfinite(row[name])]


def check_finite(learned: PyTree, row: Mapping[str, float], run_dir: Path | None) -> None:
    """Raises a NonFiniteError naming the first metrics and learned arrays that an update made NaN or infinite."""
    wrong = nonfinite_metrics(row) + nonfinite(learned)
    if wrong:
        kept = None if run_dir is None else latest(run_dir)
        raise NonFiniteError(
            f"{run_dir or 'training'}: update {row['updates']:.0f} ({row['env_steps']:.0f} environment steps) made "
            f"{', '.join(wrong[:3])} NaN or infinite; the last finite checkpoint is {kept.name if kept else 'missing'}"
        )
