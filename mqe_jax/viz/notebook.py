"""Inline clips for notebooks, as self-contained HTML."""

from __future__ import annotations

import base64
import tempfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax

from mqe_jax.envs import QuadrupedEnv
from mqe_jax.train.evaluate import Act
from mqe_jax.train.policy import Policy
from mqe_jax.viz.recording import Episode, best, record
from mqe_jax.viz.render import render_episode


def clip(env: QuadrupedEnv, episode: Episode, size: tuple[int, int] = (480, 270), fps: float = 25.0) -> Any:
    """Returns an episode as inline HTML: H.264 with imageio-ffmpeg (extra `render`), else a GIF."""
    from IPython.display import HTML

    kind = "mp4" if find_spec("imageio_ffmpeg") is not None else "gif"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"clip.{kind}"
        render_episode(env, episode, path, size=size, fps=fps if kind == "mp4" else fps / 2)
        data = base64.b64encode(path.read_bytes()).decode("ascii")
    if kind == "gif":
        return HTML(f'<img src="data:image/gif;base64,{data}">')
    return HTML(f'<video controls loop autoplay muted src="data:video/mp4;base64,{data}"></video>')


def play(
    env: QuadrupedEnv, policy: Policy | Act, *, episodes: int = 1, seconds: float = 20.0, seed: int = 0, **options: Any
) -> Any:
    """Runs episodes under a policy of all agents, as `record`, and returns the best one as `clip`, with its options."""
    recorded = record(env, policy, jax.random.PRNGKey(seed), episodes=episodes, seconds=seconds)
    return clip(env, best(recorded), **options)
