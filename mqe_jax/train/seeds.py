"""States of several seeds in one pytree, as `jax.vmap` batches them.

Warp keeps contacts of all environments in shared buffers, which `vmap` leaves unbatched. They are
overwritten in every physics step, so one copy suffices for all seeds, and checkpoints omit them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from mqe_jax.train.types import PyTree


def shared_leaves(init: Callable[[jax.Array], PyTree]) -> PyTree:
    """Returns for each leaf of `init(key)` whether it is unbatched under `vmap`."""
    key = jax.ShapeDtypeStruct((2,), jnp.uint32)
    keys = jax.ShapeDtypeStruct((2, 2), jnp.uint32)
    alone, batched = jax.eval_shape(init, key), jax.eval_shape(jax.vmap(init), keys)
    return jax.tree.map(lambda one, many: one.shape == many.shape, alone, batched)


def stack(states: Sequence[Any], shared: PyTree) -> Any:
    """Returns states of S seeds as one, with a leading axis S on all leaves but the shared ones."""
    return jax.tree.map(lambda once, *x: x[0] if once else jnp.stack(x), shared, *states)


def take(state: Any, shared: PyTree, seed: int) -> Any:
    """Returns one seed's state from those of several."""
    return jax.tree.map(lambda once, x: x if once else x[seed], shared, state)


def without_shared(state: Any, shared: PyTree) -> Any:
    """Returns a state with empty arrays in place of the shared leaves."""
    return jax.tree.map(lambda once, x: jnp.zeros((0,), x.dtype) if once else x, shared, state)


def with_shared(state: Any, shared: PyTree, fresh: Any) -> Any:
    """Returns a state with the shared leaves of another one."""
    return jax.tree.map(lambda once, x, new: new if once else x, shared, state, fresh)
