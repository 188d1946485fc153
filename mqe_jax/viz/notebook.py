"""Inline clips for notebooks, as self-contained HTML."""

from __future__ import annotations

import base64
import tempfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax

from mqe_jax.train.evaluate import Act
from mqe_jax.viz.recording import Episode, best, record
from mqe_jax.viz.render import render_episode


class Clip:
    """A clip, displayed inline when a notebook cell returns it."""

    data: bytes
    """The file's content."""
    kind: str
    """Mp4 or gif."""

    def __init__(self, data: bytes, kind: str) -> None:
        self.data, self.kind = data, kind

    def _repr_html_(self) -> str:
        text = base64.b64encode(self.data).decode("ascii")
        if self.kind == "gif":
            return f'<img src="data:image/gif;base64,{text}">'
        return f'<video controls loop autoplay muted src="data:video/mp4;base64,{text}"></video>'


def clip(env: Any, episode: Episode, size: tuple[int, int] = (480, 270), fps: float = 25.0) -> Clip:
    """Returns an episode as an inline clip: H.264 with imageio-ffmpeg (extra `render`), else a GIF."""
    kind = "mp4" if find_spec("imageio_ffmpeg") is not None else "gif"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"clip.{kind}"
        render_episode(env, episode, path, size=size, fps=fps if kind == "mp4" else fps / 2)
        return Clip(path.read_bytes(), kind)


def play(
    env: Any, act: Act, memory: Any = (), *, episodes: int = 1, seconds: float = 20.0, seed: int = 0, **options: Any
) -> Clip:
    """Runs episodes under a batched policy and returns the best one as an inline clip.

    Args:
        env: the task.
        act: the policy, batched over the episodes.
        memory: initial recurrent state of the policy, batched likewise.
        episodes: number of environments.
        seconds: time limit of an episode.
        seed: random seed.
        options: `size` and `fps` of `clip`.
    """
    recorded = record(env, act, memory, jax.random.PRNGKey(seed), episodes=episodes, seconds=seconds)
    return clip(env, best(recorded), **options)
