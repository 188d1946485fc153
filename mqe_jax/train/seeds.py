"""States of several seeds in one pytree: where seeds become a `jax.vmap`.

On `warp-mjx` seeds share contact buffers, which every step overwrites. Checkpoints omit them.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from mqe_jax.core.types import PyTree


class SeedBatch:
    """S states of `init(key)`, with a leading axis S on all leaves but the shared ones."""

    def __init__(self, init: Callable[[jax.Array], PyTree], count: int) -> None:
        key = jax.random.PRNGKey(0)
        alone = jax.eval_shape(init, key)
        batched = jax.eval_shape(jax.vmap(init), jnp.stack([key, key]))
        self.count = count
        self.shared = jax.tree.map(lambda one, many: one.shape == many.shape, alone, batched)
        """Whether each leaf of a state is unbatched under `vmap`."""
        self.take = jax.jit(self._at)
        """`take(states, seed)` returns one seed's state."""

    def map(
        self, update: Callable[[PyTree], tuple[PyTree, PyTree]]
    ) -> Callable[[PyTree], tuple[PyTree, PyTree]]:
        """Returns `update(state) -> (state, metrics)` of all seeds, to be compiled.

        Metrics gain a leading axis S. A single seed is computed without a batch axis: bit for bit
        as outside of `SeedBatch`.
        """

        def alone(states: PyTree) -> tuple[PyTree, PyTree]:
            state, metrics = update(self._at(states, 0))
            return self.stack([state]), jax.tree.map(lambda x: x[None], metrics)

        return alone if self.count == 1 else jax.vmap(update)

    def stack(self, states: Sequence[Any]) -> Any:
        """Returns the states of all seeds as one."""
        return jax.tree.map(lambda once, *x: x[0] if once else jnp.stack(x), self.shared, *states)

    def _at(self, states: Any, seed: int) -> Any:
        return jax.tree.map(lambda once, x: x if once else x[seed], self.shared, states)


def without_shared(state: Any, shared: PyTree) -> Any:
    """Returns a state with empty arrays in place of the shared leaves."""
    return jax.tree.map(lambda once, x: jnp.zeros((0,), x.dtype) if once else x, shared, state)


def with_shared(state: Any, shared: PyTree, fresh: Any) -> Any:
    """Returns a state with the shared leaves of another one."""
    return jax.tree.map(lambda once, x, new: new if once else x, shared, state, fresh)
