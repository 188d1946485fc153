"""Recordings of environments whose physics diverges, in training and evaluation."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np

from mqe_jax.envs import QuadrupedEnv
from mqe_jax.envs.replay import content, save_recording
from mqe_jax.envs.wrappers import WrappedState
from mqe_jax.files import check_folder
from mqe_jax.literal import echo
from mqe_jax.opponents import TeamState
from mqe_jax.settings import PathText, check, fail
from mqe_jax.train.types import Trace

STEPS = 64
"""Maximum number of steps in a recording, the last of which diverges."""
LIMIT = 100
"""Maximum number of recordings per command."""


@contextlib.contextmanager
def record_divergences(batch: Any, folder: str | Path | None) -> Iterator[DivergenceRecorder | None]:
    """Yields a recorder of a batch's divergences, or None without a folder.

    Prints at the end how many recordings there are, if any, and how to replay one.
    """
    if folder is None:
        yield None
        return
    env = getattr(batch, "env", None)
    if env is None:
        fail("dump_diverged", folder, f"none: {batch.name} has no physics of this package")
    recorder = DivergenceRecorder(env, Path(check("dump_diverged", folder, PathText)))
    try:
        yield recorder
    finally:
        if files := recorder.written:
            echo(f"mqe: recorded {len(files)} divergences; replay the first with: mqe replay {files[0]}")


class DivergenceRecorder:
    """Writes the last steps of environments that diverge to `FOLDER/diverged_0000.npz`, ..."""

    written: list[Path]
    """Files written."""

    def __init__(self, env: QuadrupedEnv, folder: Path) -> None:
        check_folder(folder, "dump_diverged")
        self.written: list[Path] = []
        self._env, self._folder = env, folder
        self._previous: Trace | None = None

    def trace(self, before: Any, action: jax.Array, after: Any) -> Trace:
        """Returns the fields on which a step of all environments depends, and all agents' actions."""
        if isinstance(after, TeamState):
            before, action, after = before.match, after.action, after.match
        while isinstance(after, WrappedState):
            before, action, after = before.inner, after.action, after.inner
        return Trace(content(before), action, after.metrics["diverged"])

    def add(self, trace: Trace) -> None:
        """Writes a recording of each environment that diverged in a trace, with steps of the previous one if needed."""
        for step, index in np.argwhere(np.asarray(trace.diverged) > 0.0)[: LIMIT - len(self.written)]:
            parts = [trace] if self._previous is None else [self._previous, trace]
            steps, actions = jax.tree.map(
                lambda *leaves, i=index: np.concatenate([np.asarray(leaf[:, i]) for leaf in leaves]),
                *[(part.snapshot, part.action) for part in parts],
            )
            end = len(actions) - len(trace.diverged) + step + 1
            last = slice(max(0, end - STEPS), end)
            steps: Any = jax.tree.map(lambda leaf, last=last: leaf[last], steps)
            states: Any = SimpleNamespace(data=SimpleNamespace(**steps.pop("data")), **steps)
            save_recording(self._next_file(), self._env, states, actions[last])
        self._previous = trace

    def _next_file(self) -> Path:
        taken = {file.name for file in self._folder.glob("diverged_*.npz")}
        name = next(name for i in range(len(taken) + 1) if (name := f"diverged_{i:04d}.npz") not in taken)
        self.written.append(self._folder / name)
        return self.written[-1]
