"""Drawing by `mujoco.Renderer` on a GL library that works without a screen (EGL, then OSMesa)."""

import os
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from importlib import import_module

import mujoco
import numpy as np

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
    """Name of the GL library that draws here (`egl` or `osmesa`); None where there is none.

    Each candidate is tried in a process of its own: a missing or broken library fails while MuJoCo is being
    imported, or crashes. `MUJOCO_GL`, where set, is the only candidate.
    """
    chosen = os.environ.get("MUJOCO_GL", "").lower().strip()
    for name in [chosen] if chosen else ["egl", "osmesa"]:
        if name not in ("egl", "osmesa", "glfw"):
            return None
        environment = {k: v for k, v in os.environ.items() if k != "PYOPENGL_PLATFORM"} | {"MUJOCO_GL": name}
        try:
            found = subprocess.run(
                [sys.executable, "-c", _PROBE], env=environment, capture_output=True, timeout=60
            ).returncode
        except (OSError, subprocess.TimeoutExpired):
            found = 1
        if found == 0:
            return name
    return None


def _renderer(model: mujoco.MjModel, width: int, height: int, backend: str) -> mujoco.Renderer:
    """A `mujoco.Renderer` on `backend`, whatever MUJOCO_GL was when MuJoCo was imported."""
    os.environ["MUJOCO_GL"] = backend
    if os.environ.get("PYOPENGL_PLATFORM", backend) != backend:
        del os.environ["PYOPENGL_PLATFORM"]
    gl_context = import_module("mujoco.rendering.classic.gl_context")
    gl_context.GLContext = import_module(f"mujoco.{backend}").GLContext  # type: ignore[attr-defined]
    return mujoco.Renderer(model, height, width)


def draw_gl(
    model: mujoco.MjModel, episode: Episode, camera: Camera, size: tuple[int, int], backend: str
) -> Iterator[np.ndarray]:
    """Frames (H, W, 3) uint8 of the episode, drawn by `mujoco.Renderer`."""
    width, height = size
    vis = model.vis
    vis.global_.offwidth, vis.global_.offheight = width, height
    vis.quality.shadowsize, vis.quality.offsamples = 2048, 4
    # One sun and some light from the camera, together short of white on a pale floor.
    vis.headlight.ambient[:] = 0.38
    vis.headlight.diffuse[:] = 0.22
    vis.headlight.specular[:] = 0.0
    # Shadows reach as far as the scene: MuJoCo casts them around the sun's place, up to `shadowclip` extents.
    low, high = extent(model, episode)
    model.stat.extent = float(np.linalg.norm(high - low) / 2)
    model.vis.map.shadowclip = 1.0
    model.vis.map.znear, model.vis.map.zfar = 0.1, 10.0  # extents; a wider range blurs depth into stripes
    if model.nlight:
        # Leaning along one axis only: otherwise the software renderer draws stripes on the floor.
        model.light_dir[0] = np.array([0.3, 0.0, -1.0]) / np.hypot(0.3, 1.0)
        model.light_pos[0] = (low + high) / 2 - 2 * model.stat.extent * model.light_dir[0]
        model.light_diffuse[:] = 0.45
        model.light_specular[:] = 0.05
    option = mujoco.MjvOption()
    option.geomgroup[COLLISION_GROUP] = 0
    option.sitegroup[:] = 0
    view = mujoco.MjvCamera()
    view.type = mujoco.mjtCamera.mjCAMERA_FREE
    view.lookat[:] = camera.lookat
    view.distance, view.azimuth, view.elevation = camera.distance, camera.azimuth, camera.elevation
    data = mujoco.MjData(model)
    with _renderer(model, width, height, backend) as renderer:
        for index in range(len(episode)):
            pose(model, data, episode, index)
            mujoco.mj_camlight(model, data)
            renderer.update_scene(data, view, option)
            yield renderer.render()
