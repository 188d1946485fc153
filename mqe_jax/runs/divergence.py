"""Recordings of environments whose physics diverges, in training and evaluation."""

import contextlib
import dataclasses
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import jax
import numpy as np

from mqe_jax.core.errors import InputError
from mqe_jax.core.files import check_folder
from mqe_jax.core.literal import echo
from mqe_jax.core.settings import fail
from mqe_jax.envs.replay import content, save_recording
from mqe_jax.envs.wrappers import Outer, WrappedState
from mqe_jax.selfplay.opponents import TeamState

STEPS = 64
"""Maximum number of steps in a recording, the last of which diverges."""
LIMIT = 100
"""Maximum number of recordings per command."""


@contextlib.contextmanager
def guard(batch: Any, folder: str | Path | None) -> Iterator[Any]:
    """Yields a batch that records its divergences, or the batch itself without a folder.

    Prints at the end how many recordings there are, if any, and how to replay one.
    """
    if folder is None:
        yield batch
        return
    if getattr(batch, "env", None) is None:
        fail("dump_diverged", folder, f"none: {batch.name} has no physics of this package")
    guarded = Guard(batch, Path(folder))
    try:
        yield guarded
    finally:
        if files := guarded.written:
            echo(
                f"mqe: recorded {len(files)} divergences; replay the first with: mqe replay "
                f"{files[0]}"
            )


class Guard(Outer):
    """A batch of environments that writes the last steps before a divergence to files.

    The files are `FOLDER/diverged_0000.npz`, ... Every step sends the fields on which it depends to
    the host, which keeps the last `STEPS`.
    """

    written: list[Path]  # files written

    def __init__(self, inner: Any, folder: Path) -> None:
        super().__init__(inner)
        check_folder(folder, "dump_diverged")
        self.written = []
        self._folder = folder
        self._steps = deque[tuple[Any, np.ndarray]](maxlen=STEPS)
        self._limit = LIMIT

    def reset(self, key: jax.Array) -> Any:
        """Returns the initial states of all environments."""
        return self.inner.reset(key)

    def step(self, state: Any, action: jax.Array) -> Any:
        """Advances all environments by one step; see the wrapped batch."""
        after = shown = self.inner.step(state, action)
        if isinstance(after, TeamState):
            state = state.match
            action = after.action
            after = after.match
        while isinstance(after, WrappedState):
            state = state.inner
            action = after.action
            after = after.inner
        diverged = shown.metrics["diverged"]
        kind = jax.ShapeDtypeStruct(diverged.shape, diverged.dtype)
        before = content(state), action, after.metrics["diverged"]
        # Returns the metric, on which the program depends: it neither drops nor reorders the calls.
        diverged = jax.pure_callback(
            self._see, kind, diverged, *before, vmap_method="broadcast_all"
        )
        return dataclasses.replace(shown, metrics={**shown.metrics, "diverged": diverged})

    def share(self, parts: int) -> Self:
        """Raises an InputError: recordings of several processes are not supported."""
        raise InputError(
            f"dump_diverged: not allowed in {parts} processes; start the same training in one"
        )

    def _see(self, shown: Any, before: Any, action: Any, diverged: Any) -> np.ndarray:
        """Stores a step of all environments of all seeds.

        It writes a recording of each environment that diverged in the step.
        """
        diverged = np.asarray(diverged)

        def join(x):
            return np.array(x).reshape(diverged.size, *np.shape(x)[diverged.ndim :])

        self._steps.append((jax.tree.map(join, before), join(action)))
        for index in np.flatnonzero(np.ravel(diverged))[: self._limit - len(self.written)]:
            parts = [jax.tree.map(lambda x, i=index: x[i], step) for step in self._steps]
            steps, actions = jax.tree.map(lambda *leaves: np.stack(leaves), *parts)
            states: Any = SimpleNamespace(data=SimpleNamespace(**steps.pop("data")), **steps)
            try:
                save_recording(file := self._next_file(), self.env, states, actions)
            except (OSError, InputError) as error:
                self._limit = 0
                echo(f"mqe: {error}; no further divergence is recorded")
                break
            self.written.append(file)
        return np.asarray(shown)

    def _next_file(self) -> Path:
        taken = {file.name for file in self._folder.glob("diverged_*.npz")}
        name = next(
            name for i in range(len(taken) + 1) if (name := f"diverged_{i:04d}.npz") not in taken
        )
        return self._folder / name
