"""Offscreen rendering by `mujoco.Renderer` (EGL, then OSMesa)."""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from functools import cache
from importlib import import_module
from typing import Any

import mujoco
import numpy as np

from mqe_jax.interrupts import child
from mqe_jax.viz.cameras import Camera
from mqe_jax.viz.geometry import COLLISION_GROUP, extent, pose
from mqe_jax.viz.recording import Episode

_PROBE = """
import mujoco
context = mujoco.GLContext(64, 64)
context.make_current()
model = mujoco.MjModel.from_xml_string("<mujoco/>")
mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value).free()
context.free()
"""


@cache
def gl_backend() -> str | None:
    """Returns the name of a working GL library (`egl` or `osmesa`), or None.

    Each candidate is tried in a subprocess, since a missing or broken library fails during MuJoCo's import or crashes.
    `MUJOCO_GL`, where set, is the only candidate.
    """
    chosen = os.environ.get("MUJOCO_GL", "").lower().strip()
    for name in [chosen] if chosen else ["egl", "osmesa"]:
        if name not in ("egl", "osmesa", "glfw"):
            return None
        environment = {k: v for k, v in os.environ.items() if k != "PYOPENGL_PLATFORM"} | {"MUJOCO_GL": name}
        quiet: Any = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        with contextlib.suppress(OSError, subprocess.TimeoutExpired):
            with child([sys.executable, "-c", _PROBE], env=environment, **quiet) as process:
                if process.wait(60) == 0:
                    return name
    return None


def _renderer(model: mujoco.MjModel, width: int, height: int, backend: str) -> mujoco.Renderer:
    """Returns a `mujoco.Renderer` on `backend`, independent of MUJOCO_GL at the import of MuJoCo."""
    os.environ["MUJOCO_GL"] = backend
    if os.environ.get("PYOPENGL_PLATFORM", backend) != backend:
        del os.environ["PYOPENGL_PLATFORM"]
    gl_context = import_module("mujoco.rendering.classic.gl_context")
    gl_context.GLContext = import_module(f"mujoco.{backend}").GLContext  # type: ignore[attr-defined]
    return mujoco.Renderer(model, height, width)


def draw_gl(
    model: mujoco.MjModel, episode: Episode, cameras: Sequence[Camera], size: tuple[int, int], backend: str
) -> Iterator[np.ndarray]:
    """Yields the frames (H, W, 3) uint8 of an episode, rendered by `mujoco.Renderer` with a camera for each."""
    width, height = size
    vis = model.vis
    vis.global_.offwidth, vis.global_.offheight = width, height
    vis.quality.shadowsize, vis.quality.offsamples = 2048, 4
    # One directional light and a headlight, together below saturation on a pale floor.
    vis.headlight.ambient[:] = 0.38
    vis.headlight.diffuse[:] = 0.22
    vis.headlight.specular[:] = 0.0
    # Shadows cover the scene: MuJoCo casts them around the light's position, up to `shadowclip` extents.
    low, high = extent(model, episode)
    model.stat.extent = float(np.linalg.norm(high - low) / 2)
    model.vis.map.shadowclip = 1.0
    model.vis.map.znear, model.vis.map.zfar = 0.1, 10.0  # extents; a wider range causes z-fighting
    if model.nlight:
        # Tilted along one axis only: otherwise the software renderer draws stripes on the floor.
        model.light_dir[0] = np.array([0.3, 0.0, -1.0]) / np.hypot(0.3, 1.0)
        model.light_pos[0] = (low + high) / 2 - 2 * model.stat.extent * model.light_dir[0]
        model.light_diffuse[:] = 0.45
        model.light_specular[:] = 0.05
    option = mujoco.MjvOption()
    option.geomgroup[COLLISION_GROUP] = 0
    option.sitegroup[:] = 0
    view = mujoco.MjvCamera()
    view.type = mujoco.mjtCamera.mjCAMERA_FREE
    data = mujoco.MjData(model)
    with _renderer(model, width, height, backend) as renderer:
        for index, camera in enumerate(cameras):
            view.lookat[:] = camera.lookat
            view.distance, view.azimuth, view.elevation = camera.distance, camera.azimuth, camera.elevation
            pose(model, data, episode, index)
            mujoco.mj_camlight(model, data)
            renderer.update_scene(data, view, option)
            yield renderer.render()
