"""One training in several processes of `jax.distributed`.

Each process has one device and a share of the environments.

The learner runs in each of them under `jax.shard_map` over the axis `AXIS`. The functions of this
module then span all processes. Anywhere else they are those of a single process: means are the
identity, and rows are all rows.
"""

import contextlib
import os
import re
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh, PartitionSpec

from mqe_jax.core.errors import InputError
from mqe_jax.core.types import PyTree

AXIS = "processes"

PEER = re.compile(
    r"^(?!.*NCCL.*(unhandled cuda error|invalid (argument|usage)))"  # of this process
    r".*([Gg]loo|NCCL|[Cc]onnection (reset|closed)|coordination|distributed service)",
    re.DOTALL,
)
"""Matches what JAX says if another process has ended."""
PEER_ENDED = "another process of the training, or its host, has ended"

_WHOLE = PartitionSpec()
_ALONE: ContextVar[bool] = ContextVar("alone", default=False)


def platform() -> str:
    """Returns the platform of JAX.

    InputError if JAX_PLATFORMS selects an unavailable one.
    """
    try:
        return jax.default_backend()
    except (RuntimeError, AssertionError) as error:
        requested = os.environ.get("JAX_PLATFORMS", "")
        reason = str(error) or "no such device"
        raise InputError(
            f"JAX_PLATFORMS: {requested!r} cannot be used here ({reason}); try cpu"
        ) from None


def cores() -> int:
    """Returns the number of CPU cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def size() -> int:
    """Returns the number of processes among which the environments are split."""
    if _ALONE.get():
        return 1
    try:
        return jax.lax.axis_size(AXIS)
    except NameError:  # outside of `Processes.compile`
        return 1


def total(tree: PyTree) -> PyTree:
    """Returns the sums over processes of a pytree's leaves of one dtype, by one collective."""
    if size() == 1:
        return tree
    flat, restore = ravel_pytree(tree)
    return restore(jax.lax.psum(flat, AXIS))


def mean(tree: PyTree) -> PyTree:
    """Returns the means over processes of the leaves of a pytree of floating-point numbers."""
    return tree if size() == 1 else jax.tree.map(lambda x: x / size(), total(tree))


def mean_where(x: jax.Array, mask: jax.Array, axis: int | None = None) -> jax.Array:
    """Returns the mean of the elements whose mask (same shape) is true, over an axis and processes.

    It is 0 if no mask is true.
    """
    count = jnp.maximum(total(jnp.sum(mask.astype(jnp.float32), axis)), 1.0)
    return total(jnp.sum(jnp.where(mask, x, 0.0), axis)) / count


def any_of(flag: jax.Array) -> jax.Array:
    """Returns whether a flag () is true in any process."""
    return total(flag.astype(jnp.int32)) > 0 if size() > 1 else flag


def variance(x: jax.Array, mask: jax.Array, axis: int | None = None) -> jax.Array:
    """Returns the variance of the elements where a mask is true, over an axis and processes."""
    return mean_where(jnp.square(x - mean_where(x, mask, axis)), mask, axis)


def rows(draw: Callable[[int], jax.Array], count: int) -> jax.Array:
    """Returns this process's `count` rows of `draw(n)` (n, ...), the rows of all processes.

    Random numbers drawn so belong to an environment, wherever it is.
    """
    if size() == 1:
        return draw(count)
    first = jax.lax.axis_index(AXIS) * count
    return jax.lax.dynamic_slice_in_dim(draw(count * size()), first, count)


def normal(key: jax.Array, shape: Sequence[int], dtype: Any) -> jax.Array:
    """Returns normal random numbers of a shape, with an environment in each row; see `rows`."""
    return rows(lambda n: jax.random.normal(key, (n, *shape[1:]), dtype), shape[0])


@contextlib.contextmanager
def alone() -> Iterator[None]:
    """Makes each process compute as a single one, all the same."""
    token = _ALONE.set(True)
    try:
        yield
    finally:
        _ALONE.reset(token)


@contextlib.contextmanager
def translate_errors() -> Iterator[None]:
    """Turns JAX's error of a collective, if a process has ended, into a ConnectionError."""
    try:
        yield
    except (jax.errors.JaxRuntimeError, ValueError) as error:  # by where the collective was called
        if isinstance(error, InputError) or jax.process_count() == 1 or not PEER.search(str(error)):
            raise
        raise ConnectionError(f"{PEER_ENDED}; the same command with --resume continues") from None


def share(name: str, count: int, parts: int) -> int:
    """Returns a process's share of `count` environments.

    InputError, naming the setting, for a fraction.
    """
    if count % parts:
        raise InputError(
            f"{name}: {count} is not allowed; it must be a multiple of the number of processes, "
            f"{parts}"
        )
    return count // parts


class Processes:
    """The processes of `jax.distributed` as those of a training; without it, this process alone.

    The learner state is in arrays that span all processes. Each process has its part of it: rows of
    the arrays that are split, and copies of all others. `own` and `together` convert; a conversion
    takes about 30 us per array.
    """

    def __init__(self, own: PyTree, whole: PyTree) -> None:
        """Takes the shapes of a process's part of the state, and of the whole state."""
        self.count = jax.process_count()  # of the training
        self.leads = jax.process_index() == 0  # whether this process writes the files
        self.whole = whole  # shapes of the state of all environments
        devices = jax.local_device_count()
        if self.count > 1 and devices > 1:
            raise InputError(f"processes: one has {devices} devices; it must have one")
        self._mesh = Mesh(np.array(jax.devices()[: self.count]), (AXIS,))
        self._specs = jax.tree.map(self._spec, own, whole)

    def stack(self, shared: PyTree) -> "Processes":
        """Returns those of several states, with a leading axis on all leaves but the shared ones.

        See `SeedBatch`.
        """
        other = object.__new__(Processes)
        vars(other).update(vars(self))

        other._specs = jax.tree.map(
            lambda once, spec: spec if once else PartitionSpec(None, *spec), shared, self._specs
        )
        return other

    def compile(
        self, function: Callable[..., Any], *, start: bool = False, more: bool = False
    ) -> jax.stages.Wrapped:
        """Returns a compiled function of the state, to be called by all processes.

        Args:
            function: from the state, or with `start` from a random key, to a state.
            start: whether it creates the state.
            more: whether it returns, after the state, something of which each process has a copy.
        """
        if self.count == 1:
            return jax.jit(function)
        given = _WHOLE if start else self._specs
        result = (self._specs, _WHOLE) if more else self._specs
        mapped = jax.shard_map(
            _own_empty(function),
            mesh=self._mesh,
            in_specs=(given,),
            out_specs=result,
            check_vma=False,
        )
        return jax.jit(mapped)

    def own(self, state: PyTree) -> PyTree:
        """Returns this process's part of the state, as local arrays."""
        return state if self.count == 1 else jax.tree.map(self._local, state, self._specs)

    def together(self, own: PyTree) -> PyTree:
        """Returns the global state, assembled from every process's part."""
        return own if self.count == 1 else self._together(own, self._specs)

    def join(self, own: PyTree) -> PyTree:
        """Returns the global state on the host, gathered from every process's part."""

        def whole(x: Any, spec: PartitionSpec) -> Any:
            if self.count == 1 or _whole(x, spec):
                return x
            return multihost_utils.process_allgather(self._together(x, spec), tiled=True)

        return jax.tree.map(whole, own, self._specs)

    def part(self, state: PyTree) -> PyTree:
        """Returns this process's part of a global state on the host."""
        return jax.tree.map(self._rows, state, self._specs)

    def gather(self, numbers: Sequence[int]) -> np.ndarray:
        """Returns the n numbers of every process (P, n); all P processes must call it."""
        own = np.array(numbers)
        return own[None] if self.count == 1 else multihost_utils.process_allgather(own)

    def check_equal(self, checked: object) -> None:
        """Raises an InputError unless the text of an object is that of all processes.

        All processes must call it.
        """
        sums = self.gather([zlib.crc32(repr(checked).encode()) >> 1])  # 31 bits
        if np.any(sums != sums[0]):
            raise InputError(
                "run_dir: processes have different settings or see different checkpoints; start "
                "the same command on all hosts, with a run folder that all of them see"
            )

    def _spec(self, own: Any, whole: Any) -> PartitionSpec:
        """Returns how a leaf is split: along the axis that is longer with all environments."""
        for axis, (few, all_) in enumerate(zip(own.shape, whole.shape, strict=True)):
            if few * self.count == all_ != few:
                return PartitionSpec(*[None] * axis, AXIS)
        return _WHOLE

    def _together(self, state: PyTree, specs: PyTree) -> PyTree:
        return multihost_utils.host_local_array_to_global_array(state, self._mesh, specs)

    def _local(self, x: jax.Array, spec: PartitionSpec) -> jax.Array:
        """Returns this process's part of an array of all processes.

        Programs give the whole of an empty array to each process.
        """
        own = x.addressable_data(0)
        return self._rows(own, spec) if not x.size and own.shape == x.shape else own

    def _rows(self, x: Any, spec: PartitionSpec) -> Any:
        if _whole(x, spec):
            return x
        axis = spec.index(AXIS)
        length = x.shape[axis] // self.count
        first = jax.process_index() * length
        return jax.lax.slice_in_dim(x, first, first + length, axis=axis)


def _own_empty(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Returns a function that makes the empty arrays of its argument and of what it closes over.

    A model has empty arrays for whatever it lacks. In a program of several processes they crash the
    compiler of jaxlib 0.11.2.
    """

    def own(x: Any) -> Any:
        return x if np.size(x) else jnp.zeros(np.shape(x), x.dtype)

    def call(argument: Any) -> Any:
        closed, result = jax.make_jaxpr(function, return_shape=True)(argument)
        evaluate = jaxpr_as_fun(ClosedJaxpr(closed.jaxpr, list(map(own, closed.consts))))
        found = evaluate(*map(own, jax.tree.leaves(argument)))
        return jax.tree.unflatten(jax.tree.structure(result), found)

    return call


def _whole(x: Any, spec: PartitionSpec) -> bool:
    """Returns whether a leaf is not split, or left out (`without_shared`)."""
    return AXIS not in spec or x.shape == (0,)
