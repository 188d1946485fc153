"""Penetration depths in scripted episodes, measured against the full collision geometry of the Unitree Go1.

    python -m tests.penetration [--tasks TASK ...] [--episodes 200] [-o FILE]

Episodes are played on the C engine; their poses are then put into a second model, in which the robots have the
shapes of the public description (trunk and head box, hip cylinder, thigh and calf box, foot sphere) whatever shapes
the physics uses, and MuJoCo's own collision detection measures the depths. The edges of a box reach
beyond a capsule of half its width, so that the edges of the slim limbs may cut up to 2 x 3 mm into each other,
and those of the trunk up to 2 cm, before the physics sees a contact; that counts as penetration here.

Depths in m. A frame is one environment step (0.02 s). "Body" is trunk, head and hip, "limb" thigh, calf and foot.
"""

from __future__ import annotations

import argparse
import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np

from mqe_jax.collision import robot_bits
from mqe_jax.envs import PLANNERS, TASKS, make
from mqe_jax.envs.autoreset import autoreset
from mqe_jax.policies import all_agents, load_policy
from mqe_jax.robots.build import build_robot
from mqe_jax.robots.index import prefix
from mqe_jax.robots.robot import JOINTS, LEGS
from mqe_jax.scene import Scene
from mqe_jax.terrain import build_terrain

NEAR_ROBOT = 0.8  # m, between two trunks
NEAR_WALL = 0.5  # m, from a trunk to a wall or object
BODY_LIMIT, LIMB_LIMIT = 0.02, 0.008  # m, deeper than this is counted
ON_GROUND = 0.005  # m, a foot nearer to the ground than this stands on it
THREADS = 2

# Kinds of shapes in the measuring model.
GROUND, WALL, OBJECT, BODY, LIMB, FOOT, HALO = range(7)


class Played(NamedTuple):
    """Frames of one match-up: N environments, T environment steps."""

    qpos: np.ndarray  # (T, N, nq)
    mocap: np.ndarray  # (T, N, nmocap, 3)
    counted: np.ndarray  # (T, N) bool; belongs to one of the counted episodes
    first: np.ndarray  # (T, N) bool; first frame after a reset


class Measured(NamedTuple):
    """Measurements of F frames of R robots; depths in m, 0 without contact."""

    body_robot: np.ndarray  # (F,) body against any part of another robot
    body_scene: np.ndarray  # (F,) body against walls, objects and ground
    limb_limb: np.ndarray  # (F,) limb against limb of another robot
    limb_scene: np.ndarray  # (F,) limb against walls and objects
    foot_ground: np.ndarray  # (F, R, 4) each foot in the ground; negative above it, -inf if farther than ON_GROUND
    foot_wall: np.ndarray  # (F,) foot in walls and objects
    near_wall: np.ndarray  # (F,) bool, a trunk is near a wall or object


def full_model(scene: Scene) -> mujoco.MjModel:
    """Compiles a scene whose robots have the full shapes of their description; the layout of qpos is the scene's."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    build_terrain(spec, scene.track, visual=False)
    for robot in range(scene.num_robots):
        body = build_robot(scene.robot, robot, visual=False)
        for geom in body.geoms:
            geom.contype = geom.conaffinity = 0
        _add_full_shapes(body, robot)
        spec.attach(body, prefix=prefix(robot), frame=spec.worldbody.add_frame())
    for name, item in scene.objects.items():
        item.add(spec, f"object/{name}", False)
    return spec.compile()


def _add_full_shapes(spec: mujoco.MjSpec, robot: int) -> None:
    """Adds the description's collision shapes to one robot, named `full/<kind>/...`."""
    box, sphere = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_SPHERE
    contype, conaffinity = robot_bits(robot)
    bits = {"contype": contype, "conaffinity": conaffinity}
    trunk = spec.body("trunk")
    trunk.add_geom(name="full/body/trunk", type=box, size=(0.3762 / 2, 0.0935 / 2, 0.114 / 2), **bits)
    trunk.add_geom(name="full/body/head", type=box, size=(0.02, 0.05, 0.05), pos=(0.27, 0, 0), **bits)
    trunk.add_geom(name="full/halo/trunk", type=sphere, size=(NEAR_WALL, 0, 0), contype=0, conaffinity=2 | 4)
    for leg in LEGS:
        hip, thigh, calf = (spec.body(f"{leg}_{joint}") for joint in JOINTS)
        left = 1 if leg[1] == "L" else -1
        hip.add_geom(
            name=f"full/body/{leg}_hip", type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=(0.046, 0, 0),
            fromto=(0, left * 0.06, 0, 0, left * 0.1, 0), **bits,
        )  # fmt: skip
        thigh.add_geom(
            name=f"full/limb/{leg}_thigh", type=box, size=(0.034 / 2, 0.0245 / 2, 0.213 / 2), pos=(0, 0, -0.213 / 2),
            **bits,
        )  # fmt: skip
        calf.add_geom(
            name=f"full/limb/{leg}_calf", type=box, size=(0.008, 0.008, 0.213 / 2), pos=(0, 0, -0.213 / 2), **bits
        )
        calf.add_geom(
            name=f"full/foot/{leg}", type=sphere, size=(0.02, 0, 0), pos=(0, 0, -0.213), margin=ON_GROUND, **bits
        )


def play(env: Any, opponent: str | None, episodes: int, seed: int) -> Played:
    """Runs episodes of the scripted policy; each environment contributes its first ones, as in an evaluation."""
    count = min(episodes, 64)
    quota = episodes // count + (np.arange(count) < episodes % count)
    scripted = load_policy("scripted", env)
    policy = all_agents(env, scripted, None if opponent is None else load_policy(opponent, env))

    def one(state: Any, action: jax.Array) -> tuple[Any, tuple[jax.Array, jax.Array, jax.Array]]:
        state = env.step(state, action)
        return autoreset(env, state), (state.data.qpos, state.data.mocap_pos, state.terminated | state.truncated)

    @jax.jit
    def run(state: Any, key: jax.Array) -> Any:
        def step(state: Any, key: jax.Array) -> Any:
            return jax.vmap(one)(state, policy.act(state.obs, policy.initial_memory(count), key)[0])

        return jax.lax.scan(step, state, jax.random.split(key, 100))

    key = jax.random.PRNGKey(seed)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(key, count))
    blocks: list[Any] = []
    finished = np.zeros(count, int)
    while np.any(finished < quota):
        key, step_key = jax.random.split(key)
        state, block = run(state, step_key)
        blocks.append(jax.tree.map(np.asarray, block))
        finished += blocks[-1][2].sum(0)
    qpos, mocap, done = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    before = np.cumsum(done, axis=0) - done
    first = np.concatenate([np.ones((1, count), bool), done[:-1]])
    return Played(qpos, mocap, before < quota, first)


def shape_tables(model: mujoco.MjModel, scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the kind, robot (-1 for none) and leg (-1 for none) of each geom (ngeom,)."""
    kind, owner, leg = np.full(model.ngeom, GROUND), np.full(model.ngeom, -1), np.full(model.ngeom, -1)
    kinds = {"body": BODY, "limb": LIMB, "foot": FOOT, "halo": HALO}
    for geom in range(model.ngeom):
        path = model.geom(geom).name.split("/")
        if len(path) == 4 and path[1] == "full":
            kind[geom], owner[geom] = kinds[path[2]], int(path[0].removeprefix("robot"))
            leg[geom] = LEGS.index(path[3][:2]) if path[3][:2] in LEGS else -1
        elif model.geom_contype[geom] & 4:
            kind[geom] = OBJECT
        elif model.geom_contype[geom] & 2:
            kind[geom] = WALL
    return kind, owner, leg


def measure(model: mujoco.MjModel, scene: Scene, qpos: np.ndarray, mocap: np.ndarray) -> Measured:
    """Measures frames (F, nq), (F, nmocap, 3)."""
    kind, owner, leg = shape_tables(model, scene)
    chunks = np.array_split(np.arange(len(qpos)), THREADS)
    with ThreadPoolExecutor(THREADS) as pool:
        parts = list(pool.map(lambda c: _measure(model, scene.num_robots, kind, owner, leg, qpos[c], mocap[c]), chunks))
    return Measured(*(np.concatenate(field) for field in zip(*parts, strict=True)))


def _measure(
    model: mujoco.MjModel, robots: int, kind: np.ndarray, owner: np.ndarray, leg: np.ndarray, qpos: np.ndarray,
    mocap: np.ndarray,
) -> Measured:  # fmt: skip
    frames = len(qpos)
    depths = {name: np.zeros(frames) for name in ("body_robot", "body_scene", "limb_limb", "limb_scene", "foot_wall")}
    foot_ground, near = np.full((frames, robots, 4), -np.inf), np.zeros(frames, bool)
    data = mujoco.MjData(model)
    for frame in range(frames):
        data.qpos[:] = qpos[frame]
        data.mocap_pos[:] = mocap[frame]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        geom, depth = data.contact.geom, -data.contact.dist
        kinds = np.sort(kind[geom], axis=1)
        low, high = kinds[:, 0], kinds[:, 1]
        near[frame] = np.any(high == HALO)
        fixed = (low == WALL) | (low == OBJECT)
        groups = {
            "body_robot": (low == BODY) & (high < HALO),
            "body_scene": (low < BODY) & (high == BODY),
            "limb_limb": (low > BODY) & (high < HALO),
            "limb_scene": fixed & ((high == LIMB) | (high == FOOT)),
            "foot_wall": fixed & (high == FOOT),
        }
        for name, chosen in groups.items():
            depths[name][frame] = depth[chosen].max(initial=0.0)
        for index in np.flatnonzero((low == GROUND) & (high == FOOT)):
            foot = geom[index][np.argmax(kind[geom[index]])]
            place = (frame, owner[foot], leg[foot])
            foot_ground[place] = max(foot_ground[place], depth[index])
    return Measured(foot_ground=foot_ground, near_wall=near, **depths)


def limb_axes(model: mujoco.MjModel, count: int, qpos: np.ndarray) -> np.ndarray:
    """Returns the ends of all limb axes, thighs then calves (F, R, 8, 2, 3), m, world frame."""
    points = np.zeros((len(qpos), count, 3, 4, 3))
    joints = [
        [[model.body(f"{prefix(r)}{leg}_{joint}").id for leg in LEGS] for joint in ("thigh", "calf")]
        for r in range(count)
    ]
    feet = [[model.geom(f"{prefix(r)}full/foot/{leg}").id for leg in LEGS] for r in range(count)]
    data = mujoco.MjData(model)
    for frame, pose in enumerate(qpos):
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        points[frame, :, :2] = data.xpos[joints]
        points[frame, :, 2] = data.geom_xpos[feet]
    return np.concatenate([np.stack([points[:, :, i], points[:, :, i + 1]], axis=3) for i in (0, 1)], axis=2)


def crossings(before: np.ndarray, after: np.ndarray) -> int:
    """Counts limb axes of two robots that pass through each other between frames (F, R, 8, 2, 3).

    The ends move in straight lines in between. Two axes can only cross where their four ends lie in one plane,
    at a change of sign of the volume that they span, which bisection finds.
    """
    total = 0
    for first in range(before.shape[1]):
        for second in range(first + 1, before.shape[1]):
            old = _pairs(before[:, first], before[:, second])
            new = _pairs(after[:, first], after[:, second])
            change = _volume(old) * _volume(new) < 0
            old, new = old[change], new[change]
            low, high = np.zeros(len(old)), np.ones(len(old))
            sign = _volume(old) > 0
            for _ in range(40):
                middle = (low + high) / 2
                same = (_volume(old + middle[:, None, None] * (new - old)) > 0) == sign
                low, high = np.where(same, middle, low), np.where(same, high, middle)
            total += int(np.sum(_meet(old + low[:, None, None] * (new - old))))
    return total


def _pairs(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """All pairs of axes (F, 8, 2, 3) x (F, 8, 2, 3) as four ends (F * 64, 4, 3)."""
    frames, axes = one.shape[:2]
    shape = (frames, axes, axes, 2, 3)
    pairs = np.concatenate([np.broadcast_to(one[:, :, None], shape), np.broadcast_to(two[:, None], shape)], axis=3)
    return pairs.reshape(-1, 4, 3)


def _volume(ends: np.ndarray) -> np.ndarray:
    """Six times the signed volume spanned by four points (P, 4, 3)."""
    a, b, c, d = np.moveaxis(ends, 1, 0)
    return np.sum(np.cross(b - a, d - c) * (c - a), axis=-1)


def _meet(ends: np.ndarray) -> np.ndarray:
    """Whether two segments (P, 4, 3) that lie in one plane cross (P,)."""
    a, b, c, d = np.moveaxis(ends, 1, 0)
    u, v, w = b - a, d - c, c - a
    normal = np.cross(u, v)
    scale = np.maximum(np.sum(normal**2, axis=-1), 1e-18)
    s = np.sum(np.cross(w, v) * normal, axis=-1) / scale
    t = np.sum(np.cross(w, u) * normal, axis=-1) / scale
    return (s > 0) & (s < 1) & (t > 0) & (t < 1)


def report(task: str, episodes: int, seed: int = 0, **overrides: Any) -> dict[str, Any]:
    """Plays and measures one task; half of a match's episodes are against an idle opponent."""
    env: Any = make(task, impl="c", **overrides)
    scene: Scene = env.compiled.scene
    model = full_model(scene)
    match = len(env.teams) > 1
    played = [play(env, "idle" if match else None, (episodes + 1) // 2 if match else episodes, seed)]
    if match:
        played.append(play(env, "scripted", episodes // 2, seed + 1))
    parts: list[Measured] = []
    distances: list[np.ndarray] = []
    crossed = 0
    for frames in played:
        qpos = frames.qpos[frames.counted]
        parts.append(measure(model, scene, qpos, frames.mocap[frames.counted]))
        base = frames.qpos[..., env.index.base_qpos[:, :3]]
        apart = np.linalg.norm(base[..., :, None, :] - base[..., None, :, :], axis=-1)
        apart += np.where(np.eye(scene.num_robots), np.inf, 0.0)
        nearest = apart.min((-1, -2))
        distances.append(nearest[frames.counted])
        close = (nearest[1:] < 1.2) & frames.counted[1:] & ~frames.first[1:]
        old, new = (limb_axes(model, scene.num_robots, part[close]) for part in (frames.qpos[:-1], frames.qpos[1:]))
        crossed += crossings(old, new)
    measured = Measured(*(np.concatenate(field) for field in zip(*parts, strict=True)))
    return {"task": task, **figures(measured, np.concatenate(distances), crossed, episodes)}


def figures(measured: Measured, distance: np.ndarray, crossed: int, episodes: int) -> dict[str, float | int]:
    """Sums up frames; shares in percent, depths in mm."""
    close, near = distance < NEAR_ROBOT, measured.near_wall
    body = np.maximum(np.where(close, measured.body_robot, 0.0), np.where(near, measured.body_scene, 0.0))
    deepest = np.max(
        [measured.body_robot, measured.body_scene, measured.limb_limb, measured.limb_scene,
         measured.foot_ground.max((1, 2))], axis=0,
    )  # fmt: skip
    feet = measured.foot_ground[np.isfinite(measured.foot_ground)]
    walled = measured.foot_wall[measured.foot_wall > 0]

    def share(chosen: np.ndarray, among: np.ndarray) -> float:
        return round(100 * float(np.mean(chosen[among])), 3) if np.any(among) else 0.0

    def depth(values: np.ndarray, percentile: float) -> float:
        return round(1000 * float(np.percentile(values, percentile)), 2) if len(values) else 0.0

    return {
        "frames": len(distance),
        "frames_close": int(close.sum()),
        "frames_near_wall": int(near.sum()),
        "body_deep_%": share(body > BODY_LIMIT, close | near),
        "body_robot_deep_%": share(measured.body_robot > BODY_LIMIT, close),
        "body_scene_deep_%": share(measured.body_scene > BODY_LIMIT, near),
        "limb_limb_deep_%": share(measured.limb_limb > LIMB_LIMIT, close),
        "limb_scene_deep_%": share(measured.limb_scene > LIMB_LIMIT, near),
        "crossings_per_100": round(100 * crossed / episodes, 2),
        "depth_99.9_mm": depth(deepest, 99.9),
        "deepest_mm": depth(deepest, 100.0),
        "foot_median_mm": depth(feet, 50.0),
        "foot_99_mm": depth(feet, 99.0),
        "foot_wall_99_mm": depth(walled, 99.0),
    }


def main() -> None:
    """Prints one line of JSON per task, and writes all of them to a file on request."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    scripted = [task for task in TASKS if task in PLANNERS]
    parser.add_argument("--tasks", nargs="+", choices=scripted, default=scripted)
    parser.add_argument("--episodes", type=int, default=200, help="of each task")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--output", type=Path, help="JSON file")
    args = parser.parse_args()
    rows = []
    for task in args.tasks:
        rows.append(report(task, args.episodes, args.seed))
        print(json.dumps(rows[-1]), flush=True)
    if args.output is not None:
        args.output.parent.mkdir(parents=True, exist_ok=True)
        args.output.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
