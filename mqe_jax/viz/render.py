"""Frames, clips and images of an episode.

`mujoco.Renderer` draws them (EGL, else OSMesa), or matplotlib from above.
"""

import contextlib
import math
import os
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np

from mqe_jax.core.errors import InputError
from mqe_jax.core.limits import CLIP_BYTES, FrameRate, Pixels, Speed, Time
from mqe_jax.core.literal import echo
from mqe_jax.envs import QuadrupedEnv
from mqe_jax.physics.appearance import GROUND_GROUP
from mqe_jax.physics.appearance.grounds import GROUND_MATERIAL
from mqe_jax.viz.cameras import cameras
from mqe_jax.viz.clips import check_output, write_clip
from mqe_jax.viz.curves import draw_top
from mqe_jax.viz.drawing import add_marks
from mqe_jax.viz.framing import Camera, legend
from mqe_jax.viz.geometry import COLLISION_GROUP, extent, pose, rendering_model
from mqe_jax.viz.recording import Episode

GL_PACKAGES = "libegl1 libgl1-mesa-dri (Debian, Ubuntu)"
_PROBE = """
import mujoco
context = mujoco.GLContext(64, 64)
context.make_current()
model = mujoco.MjModel.from_xml_string("<mujoco/>")
mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value).free()
context.free()
"""
_probing = threading.Lock()


def gl_backend() -> str | None:
    """Returns the name of a working GL library (`egl` or `osmesa`), or None.

    Any thread may call it. It looks for a library once.
    """
    with _probing:
        return _working_backend()


@cache
def _working_backend() -> str | None:
    """Tries the GL libraries, that of `MUJOCO_GL` first; none if it is `disable` or the like.

    Each candidate is tried in a subprocess, since a missing or broken library fails during MuJoCo's
    import or crashes.
    """
    chosen = os.environ.get("MUJOCO_GL", "").lower().strip()
    if chosen in ("disable", "disabled", "off", "false", "0"):
        return None
    for name in sorted(("egl", "osmesa"), key=lambda name: name != chosen):
        if _draws(name):
            if chosen not in ("", name):
                echo(f"mqe: MUJOCO_GL: {chosen!r} draws nothing here; used {name} instead")
            return name
    return None


def _draws(name: str) -> bool:
    """Returns whether a process draws with a GL library."""
    environment = {**os.environ, "MUJOCO_GL": name}
    environment.pop("PYOPENGL_PLATFORM", None)
    with contextlib.suppress(OSError, subprocess.TimeoutExpired):
        done = subprocess.run(
            [sys.executable, "-P", "-c", _PROBE],  # -P: no module of the current folder
            env=environment,
            timeout=60,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        return done.returncode == 0
    return False


def _gl_context(backend: str) -> Any:
    """Returns MuJoCo's class of contexts of a GL library.

    MUJOCO_GL may have been another at the import of MuJoCo.
    """
    os.environ["MUJOCO_GL"] = backend
    if os.environ.get("PYOPENGL_PLATFORM", backend) != backend:
        del os.environ["PYOPENGL_PLATFORM"]
    return import_module(f"mujoco.{backend}").GLContext


def _draw_gl(
    model: mujoco.MjModel,
    episode: Episode,
    cameras: Sequence[Camera],
    size: tuple[int, int],
    backend: str,
) -> Iterator[np.ndarray]:
    """Yields the frames (H, W, 3) uint8 of an episode, with a camera for each."""
    vis = model.vis
    vis.global_.offwidth, vis.global_.offheight = size
    # Shadows take a fifth of a software renderer's time.
    vis.quality.shadowsize = 2048 if size[0] > 640 else 1024
    vis.quality.offsamples = 4
    vis.quality.numslices = 18
    vis.quality.numstacks = 8
    # -1, no material, if the model has no texture of the ground.
    material = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_MATERIAL, GROUND_MATERIAL)
    model.geom_matid[model.geom_group == GROUND_GROUP] = material
    # One directional light and a headlight, together below saturation on a pale floor.
    vis.headlight.ambient[:] = 0.46
    vis.headlight.diffuse[:] = 0.16
    vis.headlight.specular[:] = 0.0
    low, high = extent(model, episode)
    model.stat.extent = float(np.linalg.norm(high - low) / 2)
    # MuJoCo casts shadows around the light's position, up to `shadowclip` extents. They must reach
    # over what the cameras see.
    reach = min(model.stat.extent, 0.75 * max(camera.distance for camera in cameras))
    vis.map.shadowclip = reach / model.stat.extent
    # In extents. A wider range causes z-fighting.
    vis.map.znear = 0.1
    vis.map.zfar = 10.0
    if model.nlight:
        # Tilted along one axis only: otherwise the software renderer draws stripes on the floor.
        model.light_dir[0] = np.array([0.3, 0.0, -1.0]) / np.hypot(0.3, 1.0)
        model.light_diffuse[:] = 0.44
        model.light_specular[:] = 0.05
    option = mujoco.MjvOption()
    option.geomgroup[COLLISION_GROUP] = 0
    option.sitegroup[:] = 0
    view = mujoco.MjvCamera()
    view.type = mujoco.mjtCamera.mjCAMERA_FREE
    data = mujoco.MjData(model)
    gl_context = import_module("mujoco.rendering.classic.gl_context")
    gl_context.GLContext = _gl_context(backend)  # type: ignore[attr-defined]
    with mujoco.Renderer(model, size[1], size[0]) as renderer:
        for index, camera in enumerate(cameras):
            view.lookat[:] = camera.lookat
            view.distance = camera.distance
            view.azimuth = camera.azimuth
            view.elevation = camera.elevation
            pose(model, data, episode, index)
            if model.nlight:
                back = 2 * model.stat.extent * model.light_dir[0]
                model.light_pos[0] = np.array(camera.lookat) - back
            mujoco.mj_camlight(model, data)
            renderer.update_scene(data, view, option)
            add_marks(renderer.scene, episode.marks, index, size[1], camera.distance)
            yield renderer.render()


def render_frames(
    env: QuadrupedEnv,
    episode: Episode,
    views: Sequence[Camera] | None = None,
    size: tuple[int, int] = (960, 540),
    backend: str | None = "auto",
) -> Iterator[np.ndarray]:
    """Yields the episode's frames (H, W, 3) uint8; `size` is (width, height) in pixels.

    `views` holds a camera for each frame, by default those of the view `scene`. `backend` is `auto`
    (from `gl_backend`), `egl`, `osmesa`, or None for matplotlib's top view.
    """
    model = rendering_model(env.mj_model, episode)
    backend = gl_backend() if backend == "auto" else backend
    if backend is None:
        return draw_top(model, episode, size)
    if views is None:
        views = cameras(model, episode, "scene", size[0] / size[1])
    return _draw_gl(model, episode, views, size, backend)


def _check_fits(env: QuadrupedEnv, episode: Episode) -> None:
    """Raises an InputError for an episode that is empty, not finite, or of another task."""
    nq = env.mj_model.nq
    nmocap = env.mj_model.nmocap
    found = (*episode.qpos.shape[1:], *episode.mocap_pos.shape[1:2])
    if not len(episode) or found != (nq, nmocap):
        shape = f"{episode.qpos.shape} coordinates, {episode.mocap_pos.shape} of walls"
        raise InputError(
            f"episode: {shape}; {env.name} needs (frames, {nq}) and (frames, {nmocap}, 3)"
        )
    if not all(np.isfinite(x).all() for x in (episode.qpos, episode.mocap_pos, episode.mocap_quat)):
        raise InputError("episode: its coordinates hold NaN or infinite numbers")


def render_episode(
    env: QuadrupedEnv,
    episode: Episode,
    path: Path,
    *,
    view: str | None = None,
    size: tuple[Pixels, Pixels] | None = None,
    fps: FrameRate | None = None,
    speed: Speed = 1.0,
    at: Time | None = None,
    backend: Literal["auto", "egl", "osmesa"] | None = "auto",
) -> str:
    """Renders an episode to a file, in the format of its suffix, and returns the renderer's name.

    The renderer is `egl`, `osmesa` or `matplotlib`. Defaults: .mp4 960 x 540 at 25 frames/s, .gif
    and .webp 480 x 270 at 12.5 frames/s, .png 1280 x 720; view `follow` for a clip, `scene` for an
    image. `speed` below 1 is slow motion. `at` is the time of an image, s (default: the middle).
    Frames are a whole number of environment steps apart; a line says if `fps` differs for it. A
    legend names the teams' colours. Without GL, standard error names the packages that 3-D
    rendering needs.

    Example:
        ```python
        from pathlib import Path

        from mqe_jax.viz.recording import record_episodes
        from mqe_jax.viz.render import render_episode

        env = mqe_jax.make("go1gate")
        policy = mqe_jax.load_policy("go1gate", env)
        (episode,) = record_episodes(env, policy, jax.random.PRNGKey(0), seconds=3)
        render_episode(env, episode, Path("gate.png"), at=2.0)
        ```
    """
    path = check_output(Path(path), fps=fps, speed=speed, at=at)
    _check_fits(env, episode)
    suffix = path.suffix.lower()
    size = size or {".mp4": (960, 540), ".png": (1280, 720)}.get(suffix, (480, 270))
    asked = fps or (25.0 if suffix == ".mp4" else 12.5)
    chosen = gl_backend() if backend == "auto" else backend
    if chosen is None:
        echo(
            f"mqe: no GL library, rendered from above instead; for 3-D images install {GL_PACKAGES}"
        )
    shown = slice(None)
    last = len(episode) - 1
    if suffix == ".png":
        index = len(episode) // 2 if at is None else min(round(at / episode.dt), last)
        if at is not None and at > (last + 0.5) * episode.dt:
            echo(f"mqe: at: the episode ends after {last * episode.dt:g} s, which the image shows")
        shown = slice(index, index + 1)
        rate = asked
    else:
        episode = episode.cut(slice(None, None, max(1, round(speed / (asked * episode.dt)))))
        rate = speed / episode.dt
        if fps is not None and not math.isclose(rate, fps, rel_tol=1e-3):
            echo(f"mqe: fps: {rate:g}, not {fps:g}: frames are a whole number of steps apart")
        if suffix != ".mp4" and 3 * len(episode) * size[0] * size[1] > CLIP_BYTES:
            frames = f"{len(episode)} frames of {size[0]} x {size[1]} pixels"
            raise InputError(
                f"output: {frames} are too many for {suffix}; give a smaller width, fewer frames "
                "per second, or .mp4"
            )
    if view is None:
        view = "scene" if suffix == ".png" else "follow"
    model = rendering_model(env.mj_model, episode)
    views = cameras(model, episode, view, size[0] / size[1])
    if chosen is None:
        frames = draw_top(model, episode, size, shown)
    else:
        frames = _draw_gl(model, episode.cut(shown), views[shown], size, chosen)
    write_clip(path, map(legend(env, size, episode.marks), frames), rate)
    return chosen or "matplotlib"
