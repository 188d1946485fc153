"""Clips and pictures of episodes: record a rollout as numpy, draw it, write it whole.

Drawing is `mujoco.Renderer` on a GL library that works without a screen (EGL, then OSMesa). Where neither
works, the same episode is drawn from above with matplotlib, and one line says which packages give the real
picture.
"""

import copy
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mqe_jax.clips import check_output, write_clip

Act = Callable[[Any, Any, Any], tuple[Any, Any]]
"""`act(obs (N, A, O), memory, key) -> (action (N, A, action_size), memory)`."""

COLLISION_GROUP = 3
GL_PACKAGES = "libegl1 libgl1-mesa-dri (Debian, Ubuntu)"


@dataclass(frozen=True)
class Episode:
    """One world's episode, frame by frame, with everything that drawing needs."""

    qpos: np.ndarray  # (T, nq)
    mocap_pos: np.ndarray  # (T, n_mocap, 3) metre, world frame
    mocap_quat: np.ndarray  # (T, n_mocap, 4) wxyz
    dt: float  # s between frames
    success: float = 0.0  # `success` on the last step, 0 where the episode was cut
    reward: float = 0.0  # mean over steps of the sum of the reward terms

    def __len__(self) -> int:
        return len(self.qpos)

    def every(self, n: int) -> "Episode":
        """Keep every n-th frame."""
        kept = slice(None, None, n)
        return replace(
            self,
            qpos=self.qpos[kept],
            mocap_pos=self.mocap_pos[kept],
            mocap_quat=self.mocap_quat[kept],
            dt=self.dt * n,
        )


@dataclass(frozen=True)
class Camera:
    """A free camera: it looks at a point from a distance, angles in degrees as MuJoCo has them."""

    lookat: tuple[float, float, float]  # metre
    distance: float  # metre
    azimuth: float = 60.0  # 0 looks along +x, 90 along +y
    elevation: float = -46.0  # -90 looks straight down


def record(env: Any, act: Act, memory: Any, key: jax.Array, *, worlds: int = 1, seconds: float = 20.0) -> list[Episode]:
    """Play one episode in each of `worlds` fresh worlds, without auto-reset.

    `act` and `memory` are batched over `worlds` as in `Act`. Every episode ends with the frame on which the
    world terminated or was truncated, or after `seconds`.
    """
    reset_key, act_key = jax.random.split(key)

    def frame(state: Any) -> tuple[jax.Array, ...]:
        return (state.data.qpos, state.data.mocap_pos, state.data.mocap_quat)

    def one_step(carry: tuple[Any, Any], key: jax.Array) -> tuple[tuple[Any, Any], Any]:
        state, memory = carry
        action, memory = act(state.obs, memory, key)
        state = jax.vmap(env.step)(state, action)
        done = state.terminated | state.truncated
        reward = state.metrics.get("average_step_reward", state.reward.mean(-1))
        success = state.metrics.get("success", jnp.zeros_like(reward))
        return (state, memory), (*frame(state), done, reward, success)

    chunk = jax.jit(lambda carry, keys: jax.lax.scan(one_step, carry, keys))
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(reset_key, worlds))
    first = [np.asarray(x)[None] for x in frame(state)]
    rows: list[list[np.ndarray]] = []
    steps, length = max(1, round(seconds / env.dt)), 50
    carry = (state, memory)
    for index in range(-(-steps // length)):
        keys = jax.random.split(jax.random.fold_in(act_key, index), length)
        carry, out = chunk(carry, keys)
        rows.append([np.asarray(x) for x in out])
        if np.concatenate([row[3] for row in rows]).any(0).all():
            break
    columns = [np.concatenate([row[i] for row in rows])[:steps] for i in range(6)]
    done, reward, success = columns[3:]
    episodes = []
    for world in range(worlds):
        last = int(done[:, world].argmax()) if done[:, world].any() else len(done) - 1
        poses = [np.concatenate([f, c])[: last + 2, world] for f, c in zip(first, columns[:3], strict=True)]
        won = float(success[last, world]) if done[last, world] else 0.0
        mean = float(reward[: last + 1, world].mean())
        episodes.append(Episode(poses[0], poses[1], poses[2], float(env.dt), won, mean))
    return episodes


def best(episodes: list[Episode]) -> Episode:
    """The episode that shows most: success first, then average step reward."""
    return max(episodes, key=lambda episode: (episode.success, episode.reward))


# ---------------------------------------------------------------- the scene as plain geometry


def robot_bases(model: mujoco.MjModel) -> list[int]:
    """Ids of the bodies that are robots' trunks: a free joint above at least twelve hinges."""
    bases = []
    hinges = model.jnt_type == int(mujoco.mjtJoint.mjJNT_HINGE)
    for joint in np.flatnonzero(model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)):
        body = int(model.jnt_bodyid[joint])
        inside = model.body_rootid[model.jnt_bodyid] == model.body_rootid[body]
        if np.count_nonzero(hinges & inside) >= 12:
            bases.append(body)
    return bases


def _paint(model: mujoco.MjModel, trunk: int) -> tuple[float, ...]:
    """Colour (red, green, blue, alpha) of a robot: of the first shape on its trunk that is looked at."""
    geoms = model.body_geomadr[trunk] + np.arange(model.body_geomnum[trunk])
    seen = [geom for geom in geoms if model.geom_group[geom] != COLLISION_GROUP]
    return tuple(map(float, model.geom_rgba[seen[0]]))


def _pose(model: mujoco.MjModel, data: mujoco.MjData, episode: Episode, index: int) -> None:
    """Put frame `index` of the episode into `data`."""
    data.qpos[:] = episode.qpos[index]
    if model.nmocap:
        data.mocap_pos[:] = episode.mocap_pos[index]
        data.mocap_quat[:] = episode.mocap_quat[index]
    mujoco.mj_kinematics(model, data)


def _box_corners(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> np.ndarray:
    """World corners (8, 3) of the geom's bounding box."""
    centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    return data.geom_xpos[geom] + (centre + signs * half) @ data.geom_xmat[geom].reshape(3, 3).T


def _scenery(model: mujoco.MjModel) -> list[int]:
    """Ids of the shown geoms that are neither ground nor part of a robot."""
    robots = {int(model.body_rootid[body]) for body in robot_bases(model)}
    return [
        geom
        for geom in range(model.ngeom)
        if int(model.geom_type[geom]) not in (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))
        and int(model.geom_group[geom]) != COLLISION_GROUP
        and int(model.body_rootid[model.geom_bodyid[geom]]) not in robots
    ]


def _extent(model: mujoco.MjModel, episode: Episode) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corner (3,) of what the clip should hold: the scene and every robot's way."""
    data = mujoco.MjData(model)
    points = []
    for index in np.unique(np.linspace(0, len(episode) - 1, 30).astype(int)):
        _pose(model, data, episode, int(index))
        for body in robot_bases(model):
            points += [data.xpos[body] - [0.4, 0.4, 0.3], data.xpos[body] + [0.4, 0.4, 0.2]]
    for geom in _scenery(model):
        points += list(_box_corners(model, data, geom))
    if not points:
        points = [np.full(3, -1.0), np.full(3, 1.0)]
    return np.min(points, axis=0), np.max(points, axis=0)


def default_camera(model: mujoco.MjModel, episode: Episode, aspect: float = 16 / 9) -> Camera:
    """A three-quarter view from behind and above that holds the whole track and every robot's way."""
    low, high = _extent(model, episode)
    centre = (low + high) / 2
    camera = Camera((float(centre[0]), float(centre[1]), 0.2), 1.0)
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (0, high[2])])
    azimuth, elevation = np.radians(camera.azimuth), np.radians(camera.elevation)
    forward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    up = np.cross(right, forward)
    tangent = np.tan(np.radians(model.vis.global_.fovy) / 2)
    lookat, distance = np.array(camera.lookat), 1.0
    for _ in range(60):  # put the middle of what is seen into the middle of the picture, then step back or forth
        offset = corners - lookat
        # A corner is in the picture when |offset right| <= depth tan aspect and |offset up| <= depth tan.
        need = np.maximum(np.abs(offset @ right) / aspect, np.abs(offset @ up)) / tangent - offset @ forward
        distance = need.max()
        depth = distance + offset @ forward
        across, along = offset @ right / depth, offset @ up / depth
        shift = distance * ((across.max() + across.min()) * right + (along.max() + along.min()) * up) / 4
        lookat = lookat + shift
    distance = float(np.clip(1.04 * distance, 1.5, 60.0))
    return replace(camera, lookat=(float(lookat[0]), float(lookat[1]), float(lookat[2])), distance=distance)


def _drawn_model(model: mujoco.MjModel, episode: Episode) -> mujoco.MjModel:
    """A copy to draw from, in which moving walls end at the track's side walls.

    A gate's walls are long enough for every place that its gap may take, so that they stand out behind the
    side walls; what stands out is not drawn.
    """
    model = copy.deepcopy(model)
    box = int(mujoco.mjtGeom.mjGEOM_BOX)
    shown = [geom for geom in _scenery(model) if int(model.geom_type[geom]) == box]
    fixed = [geom for geom in shown if int(model.geom_bodyid[geom]) == 0]
    if not fixed:
        return model
    data = mujoco.MjData(model)
    _pose(model, data, episode, 0)
    sides = np.concatenate([_box_corners(model, data, geom)[:, 1] for geom in fixed])
    for geom in shown:
        if model.body_mocapid[model.geom_bodyid[geom]] < 0:
            continue
        wall = _box_corners(model, data, geom)[:, 1]
        low, high = max(wall.min(), sides.min() + 0.005), min(wall.max(), sides.max() - 0.005)
        if low < high and (low, high) != (wall.min(), wall.max()):
            model.geom_pos[geom, 1] += (low + high) / 2 - data.geom_xpos[geom, 1]
            model.geom_sameframe[geom] = 0  # or MuJoCo takes the body's pose for the geom's
            model.geom_size[geom, 1] = model.geom_aabb[geom, 4] = (high - low) / 2
    return model


# ---------------------------------------------------------------- mujoco.Renderer

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


def _draw_gl(
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
    low, high = _extent(model, episode)
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
            _pose(model, data, episode, index)
            mujoco.mj_camlight(model, data)
            renderer.update_scene(data, view, option)
            yield renderer.render()


# ---------------------------------------------------------------- the view from above


def _outline(points: np.ndarray) -> np.ndarray:
    """Convex hull (K, 2) of points (N, 2), counter-clockwise."""
    ordered = sorted(map(tuple, np.round(points, 6)))

    def half(points: list[tuple[float, ...]]) -> list[tuple[float, ...]]:
        chain: list[tuple[float, ...]] = []
        for p in points:
            while len(chain) > 1:
                (ax, ay), (bx, by) = chain[-2], chain[-1]
                if (bx - ax) * (p[1] - ay) - (by - ay) * (p[0] - ax) > 0:
                    break
                chain.pop()
            chain.append(p)
        return chain[:-1]

    return np.array(half(ordered) + half(ordered[::-1]))


def _draw_top(model: mujoco.MjModel, episode: Episode, size: tuple[int, int]) -> Iterator[np.ndarray]:
    """Frames (H, W, 3) uint8 of the episode from above: walls, objects, robots with their trails."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Polygon

    low, high = _extent(model, episode)
    dpi = 100
    figure = Figure((size[0] / dpi, size[1] / dpi), dpi=dpi, facecolor="#eceef2")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.01, 0.01, 0.98, 0.98))
    axes.set(xlim=(low[0] - 0.3, high[0] + 0.3), ylim=(low[1] - 0.3, high[1] + 0.3), aspect="equal")
    axes.axis("off")
    data = mujoco.MjData(model)
    bases = robot_bases(model)
    scenery, robots = [], []
    for geom in _scenery(model):
        moves = model.body_dofnum[model.body_rootid[model.geom_bodyid[geom]]] > 0
        face = "#c9ced6" if moves else "#3a3d45"
        patch = Polygon(np.zeros((3, 2)), facecolor=face, edgecolor="#23252b", lw=0.6, zorder=2)
        scenery.append((geom, axes.add_patch(patch)))
    body_shape = np.array([[-0.25, -0.13], [0.2, -0.13], [0.33, 0.0], [0.2, 0.13], [-0.25, 0.13]])
    for body in bases:
        colour = _paint(model, body)
        (trail,) = axes.plot([], [], color=colour, lw=1.5, alpha=0.5, zorder=3)
        patch = axes.add_patch(Polygon(body_shape, facecolor=colour, edgecolor="#1b1d22", lw=1, zorder=4))
        robots.append((body, patch, trail, []))
    label = axes.text(0.99, 0.01, "", ha="right", va="bottom", transform=axes.transAxes, fontsize=9)
    for index in range(len(episode)):
        _pose(model, data, episode, index)
        for geom, patch in scenery:
            patch.set_xy(_outline(_box_corners(model, data, geom)[:, :2]))
        for body, patch, trail, way in robots:
            rotation = data.xmat[body].reshape(3, 3)
            yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
            turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
            patch.set_xy(body_shape @ turn + data.xpos[body][:2])
            way.append(data.xpos[body][:2].copy())
            trail.set_data(*np.array(way).T)
        label.set_text(f"{index * episode.dt:.1f} s")
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


# ---------------------------------------------------------------- an episode's picture


def render_frames(
    env: Any,
    episode: Episode,
    camera: Camera | None = None,
    size: tuple[int, int] = (960, 540),
    backend: str | None = "auto",
) -> Iterator[np.ndarray]:
    """Yield the episode's frames (H, W, 3) uint8; `size` is (width, height) in pixels.

    `backend` is `auto` (what `gl_backend` finds), `egl`, `osmesa`, or None for matplotlib's view from above.
    """
    model = _drawn_model(env.mj_model, episode)
    if backend == "auto":
        backend = gl_backend()
    if backend is None:
        return _draw_top(model, episode, size)
    return _draw_gl(model, episode, camera or default_camera(model, episode, size[0] / size[1]), size, backend)


def render_episode(
    env: Any,
    episode: Episode,
    path: Path,
    *,
    camera: Camera | None = None,
    size: tuple[int, int] | None = None,
    fps: float | None = None,
    backend: str | None = "auto",
) -> str:
    """Draw an episode into a file chosen by suffix; returns what drew it (`egl`, `osmesa`, `matplotlib`).

    Defaults: .mp4 960 x 540 at 25 frames/s, .gif 480 x 270 at 12.5 frames/s, .png 1280 x 720, middle frame.
    Where GL is missing, one line on standard error names the packages that give the real picture.
    """
    check_output(path)
    suffix = path.suffix.lower()
    size = size or {".mp4": (960, 540), ".gif": (480, 270), ".png": (1280, 720)}[suffix]
    fps = fps or {".mp4": 25.0, ".gif": 12.5, ".png": 1.0}[suffix]
    if backend == "auto":
        backend = gl_backend()
    if backend is None:
        print(
            f"mqe: no GL library, drawn from above instead; for the 3-D picture install {GL_PACKAGES}",
            file=sys.stderr,
        )
    if suffix == ".png":
        camera = camera or default_camera(_drawn_model(env.mj_model, episode), episode, size[0] / size[1])
        middle = len(episode) // 2
        if backend is not None:
            episode = replace(
                episode,
                qpos=episode.qpos[middle : middle + 1],
                mocap_pos=episode.mocap_pos[middle : middle + 1],
                mocap_quat=episode.mocap_quat[middle : middle + 1],
            )
    else:
        episode = episode.every(max(1, round(1 / (fps * episode.dt))))
        fps = 1 / episode.dt
    write_clip(path, render_frames(env, episode, camera, size, backend), fps)
    return backend or "matplotlib"
