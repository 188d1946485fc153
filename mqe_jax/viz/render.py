"""Frames, clips and images of an episode."""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mqe_jax.viz.cameras import Camera, cameras
from mqe_jax.viz.clips import check_output, write_clip
from mqe_jax.viz.geometry import rendering_model
from mqe_jax.viz.gl import draw_gl, gl_backend
from mqe_jax.viz.recording import Episode
from mqe_jax.viz.top_view import draw_top

GL_PACKAGES = "libegl1 libgl1-mesa-dri (Debian, Ubuntu)"


def render_frames(
    env: Any,
    episode: Episode,
    views: Sequence[Camera] | None = None,
    size: tuple[int, int] = (960, 540),
    backend: str | None = "auto",
) -> Iterator[np.ndarray]:
    """Yields the episode's frames (H, W, 3) uint8; `size` is (width, height) in pixels.

    `views` holds a camera for each frame; the view is `scene` if None.

    `backend` is `auto` (from `gl_backend`), `egl`, `osmesa`, or None for matplotlib's top view.
    """
    model = rendering_model(env.mj_model, episode)
    if backend == "auto":
        backend = gl_backend()
    if backend is None:
        return draw_top(model, episode, size)
    return draw_gl(model, episode, views or cameras(model, episode, "scene", size[0] / size[1]), size, backend)


def render_episode(
    env: Any,
    episode: Episode,
    path: Path,
    *,
    view: str | None = None,
    size: tuple[int, int] | None = None,
    fps: float | None = None,
    speed: float = 1.0,
    at: float | None = None,
    backend: str | None = "auto",
) -> str:
    """Renders an episode to a file (format by suffix) and returns the renderer used (`egl`, `osmesa`, `matplotlib`).

    Defaults: .mp4 960 x 540 at 25 frames/s, .gif and .webp 480 x 270 at 12.5 frames/s, .png 1280 x 720; view `follow`
    for a clip, `scene` for an image. `speed` below 1 is slow motion; `at` is the time of an image, s (default: the
    middle).
    Without GL, the packages required for 3-D rendering are printed to standard error.
    """
    check_output(path)
    suffix = path.suffix.lower()
    size = size or {".mp4": (960, 540), ".webp": (480, 270), ".gif": (480, 270), ".png": (1280, 720)}[suffix]
    fps = fps or {".mp4": 25.0, ".webp": 12.5, ".gif": 12.5, ".png": 1.0}[suffix]
    if backend == "auto":
        backend = gl_backend()
    if backend is None:
        print(
            f"mqe: no GL library, rendered from above instead; for 3-D images install {GL_PACKAGES}",
            file=sys.stderr,
        )
    aspect = size[0] / size[1]
    if suffix == ".png":
        views = cameras(rendering_model(env.mj_model, episode), episode, view or "scene", aspect)
        shown = len(episode) // 2 if at is None else min(round(at / episode.dt), len(episode) - 1)
        if backend is not None:
            views = views[shown : shown + 1]
            episode = replace(
                episode,
                qpos=episode.qpos[shown : shown + 1],
                mocap_pos=episode.mocap_pos[shown : shown + 1],
                mocap_quat=episode.mocap_quat[shown : shown + 1],
            )
    else:
        episode = episode.every(max(1, round(speed / (fps * episode.dt))))
        fps = speed / episode.dt
        views = cameras(rendering_model(env.mj_model, episode), episode, view or "follow", aspect)
    write_clip(path, render_frames(env, episode, views, size, backend), fps)
    return backend or "matplotlib"
