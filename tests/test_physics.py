"""Physics on three engines: agreement with MuJoCo, finite states, crowds."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from mqe_jax import make
from mqe_jax.envs import TASKS
from mqe_jax.physics import engines
from mqe_jax.physics.collision import GROUND_BIT
from mqe_jax.physics.engines import private
from mqe_jax.physics.engines.c import CEngine
from mqe_jax.physics.engines.mjx_step import MarginStep
from mqe_jax.physics.robots.go1 import GO1
from mqe_jax.physics.scene import CompiledScene, Scene, compile_scene
from mqe_jax.terrain import Plane, Track
from tests.inputs import refuses
from tests.states import initial, made

NEEDS_GPU = pytest.mark.gpu
IMPLS = ["c", "jax", pytest.param("warp", marks=NEEDS_GPU)]


@pytest.fixture(scope="module")
def plane() -> CompiledScene:
    return compile_scene(
        Scene(Track(blocks=(Plane(4.0),), walled=False, num_robots=1), num_robots=1)
    )


def standing(scene: CompiledScene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A robot that has settled on its feet on MuJoCo itself: qpos, qvel, ctrl."""
    model = scene.model
    data = mujoco.MjData(model)
    data.qpos[scene.index.base_qpos[0]] = [0, 0, 0.33, 1, 0, 0, 0]
    data.qpos[scene.index.joint_qpos[0]] = GO1.default_joints
    data.ctrl[scene.index.actuator[0]] = GO1.default_joints
    mujoco.mj_step(model, data, 300)
    return data.qpos.copy(), data.qvel.copy(), data.ctrl.copy()


@pytest.mark.parametrize("impl", IMPLS)
def test_standing_robot_moves_as_in_mujoco(impl: str, plane: CompiledScene) -> None:
    qpos, qvel, ctrl = standing(plane)
    reference = mujoco.MjData(plane.model)
    reference.qpos[:] = qpos
    reference.qvel[:] = qvel
    reference.ctrl[:] = ctrl
    engine = engines.make(plane.model, impl=impl, num_envs=1, num_substeps=1)
    data = engine.init(jnp.asarray(qpos), jnp.asarray(qvel), jnp.zeros((0, 3)), jnp.asarray(ctrl))

    def advance(state: Any, _: None) -> tuple[Any, jax.Array]:
        state = engine.step(state, jnp.asarray(ctrl, jnp.float32))[0]
        return state, state.qpos

    run = jax.jit(jax.vmap(lambda _: jax.lax.scan(advance, data, None, 50)[1]))
    found = np.asarray(run(np.zeros(1)))[0]
    for steps, row, atol in ((1, 0, 1e-4), (49, -1, 5e-3)):
        mujoco.mj_step(plane.model, reference, steps)
        assert np.abs(found[row] - reference.qpos).max() < atol


CONTACTS = """
<mujoco>
  <option timestep="0.005"><flag eulerdamp="disable"/></option>
  <worldbody>
    <geom name="floor" type="plane" size="9 9 1"/>
    <body><freejoint/><geom name="box" type="box" size="0.5 0.5 0.5" mass="6"/></body>
    <body><freejoint/><geom name="wall" type="box" size="0.04 1 0.3" mass="6"/></body>
    <body><freejoint/>
      <geom name="trunk" type="capsule" size="0.065 0.185" mass="5" margin="0.003"/></body>
  </worldbody>
</mujoco>
"""


def poses(model: mujoco.MjModel) -> np.ndarray:
    """A tilted box on the floor; a capsule that points at the end of the wall, 1 mm inside or
    outside: qpos (N, 21).
    """
    data = mujoco.MjData(model)
    found = []

    def turned(axis: tuple[float, float, float], angle: float) -> np.ndarray:
        quaternion = np.zeros(4)
        mujoco.mju_axisAngle2Quat(quaternion, np.array(axis), angle)
        return quaternion

    def near(first: str, second: str, position: slice, way_to: np.ndarray, dist: float) -> None:
        start = data.qpos[position].copy()
        (low, high) = (0.0, 1.0)
        for _ in range(40):
            way = 0.5 * (low + high)
            data.qpos[position] = start + way * way_to
            mujoco.mj_kinematics(model, data)
            reached = mujoco.mj_geomDistance(
                model, data, model.geom(first).id, model.geom(second).id, 5.0, None
            )
            low, high = (way, high) if reached > dist else (low, way)

    for tilt in (0.0, 2e-3, 4e-3, 0.3):
        # m; the capsule's tip beyond the wall's end
        for beyond in (-0.2, -0.02, 0.0, 0.002, 0.005, 0.009, 0.03):
            for yaw, dist in ((0.0, -1e-3), (0.02, 1e-3), (0.3, -1e-3)):
                data.qpos[:] = 0.0
                data.qpos[:3] = [6.0, 0.0, 2.0]
                data.qpos[3:7] = turned((0.6, 0.8, 0.0), tilt)
                data.qpos[7:11] = [0.0, 0.0, 0.5, 1.0]
                data.qpos[14:17] = [-1.0, 1.0 + beyond - 0.185 * np.sin(yaw), 0.5]
                across = turned((0.0, 1.0, 0.0), np.pi / 2)
                flat = turned((0.0, 0.0, 1.0), yaw)
                mujoco.mju_mulQuat(data.qpos[17:21], flat, across)
                near("box", "floor", slice(0, 3), np.array([0.0, 0.0, -2.0]), -3e-3)
                near("trunk", "wall", slice(14, 17), np.array([0.75, 0.0, 0.0]), dist)
                found.append(data.qpos.copy())
    return np.array(found)


def test_contacts_with_boxes_are_those_of_the_c_engine() -> None:
    """All corners of a tilted box; a capsule near a box's edge, which MJX alone does not detect."""
    model = mujoco.MjModel.from_xml_string(CONTACTS)
    qpos = poses(model).astype(np.float32)
    step = MarginStep(model)
    fresh = mjx.make_data(model, impl="jax")
    after = jax.jit(jax.vmap(lambda q: step(step.model, fresh.replace(qpos=q))))(jnp.asarray(qpos))
    contact = jax.tree.map(np.asarray, private.contact(after))
    reference = mujoco.MjData(model)
    floor = model.geom("floor").id
    wall = model.geom("wall").id
    for number, q in enumerate(qpos):
        reference.qpos[:] = q
        mujoco.mj_fwdPosition(model, reference)
        active = contact.dist[number] < contact.includemargin[number]
        for geom in (floor, wall):
            mine = active & (contact.geom[number] == geom).any(axis=1)
            theirs = (reference.contact.geom == geom).any(axis=1)
            dist = contact.dist[number][mine]
            c_dist = reference.contact.dist[theirs]
            assert len(dist) and len(c_dist), f"{q}: not in contact with {model.geom(geom).name}"
            if geom == floor:
                np.testing.assert_allclose(np.sort(dist), np.sort(c_dist), atol=2e-6)
            first = np.argmin(dist)
            c_first = np.argmin(c_dist)
            assert dist[first] == pytest.approx(c_dist[c_first], abs=2e-5)
            if geom == wall:
                position = reference.contact.pos[theirs][c_first]
                np.testing.assert_allclose(contact.pos[number][mine][first], position, atol=1e-3)
                normal = reference.contact.frame[theirs][c_first][:3]
                np.testing.assert_allclose(contact.frame[number][mine][first, 0], normal, atol=0.02)


# On MJX-JAX tests/test_engines.py compares the forces with those of the C engine.
@pytest.mark.parametrize(
    "impl",
    ["c", pytest.param("jax", marks=pytest.mark.soak), pytest.param("warp", marks=NEEDS_GPU)],
)
def test_trunk_force_is_read(impl: str) -> None:
    env = make("go1gate", impl=impl, control="position", num_envs=2, spawn_velocity=0.0)
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    index = env.index
    near = state.data.qpos.at[index.base_qpos[0, :3]].set(jnp.array([1.0, 0.0, 0.30]))
    near = near.at[index.base_qpos[1, :3]].set(jnp.array([1.0, 0.10, 0.30]))
    low = state.data.qpos.at[index.base_qpos[0, 2]].set(0.05)
    both = jax.vmap(lambda qpos: state.data.replace(qpos=qpos))(jnp.stack([near, low]))
    ctrl = jnp.asarray(state.data.ctrl)
    after = jax.jit(jax.vmap(lambda data: env.physics.step(data, ctrl, num_substeps=1)[0]))(both)
    robot_state = jax.vmap(env.read)(after)
    assert float(robot_state.trunk_force[0].min()) > 1.0
    assert (
        float(robot_state.trunk_force[1, 0]) > 1.0 and float(robot_state.trunk_force[1, 1]) == 0.0
    )


def test_gate_stands_where_each_environment_drew_it() -> None:
    env = make("go1gate", impl="c", control="position")
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 3))
    gap = states.anchors[:, 0]
    assert len(np.unique(np.asarray(gap[:, 0]))) == 3
    assert np.all(np.abs(np.asarray(gap) - [3.5, 0.0]) <= 0.5)
    right = states.data.mocap_pos[:, 0]
    left = states.data.mocap_pos[:, 1]
    half = np.asarray(env.compiled.model.geom("wall/gate1_left").size)[1]
    np.testing.assert_allclose(left[:, 1] - half - gap[:, 1], 0.3, atol=1e-5)
    np.testing.assert_allclose(gap[:, 1] - right[:, 1] - half, 0.3, atol=1e-5)


class Frozen(CEngine):
    impl = "frozen"

    def advance(
        self, data: Any, fields: Any, forced: bool, num_substeps: int
    ) -> tuple[Any, jax.Array]:
        return data, jnp.ones((), bool)


def test_a_new_engine_is_one_class_and_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(engines.ENGINES, "frozen", f"{__name__}:Frozen")
    env = make("go1gate", impl="frozen", control="position")
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    after = jax.jit(env.step)(state, jnp.ones((2, 12)))
    np.testing.assert_array_equal(after.data.qpos, state.data.qpos)
    assert env.impl == "frozen" and float(after.metrics["overflow"]) == 1.0
    assert engines.resolve() != "frozen"


def test_an_engine_that_cannot_run_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(private, "warp_is_installed", lambda: False)
    refuses(r"impl 'warp' needs the package warp-lang", engines.resolve, "warp")


MARGIN = 0.2  # m; from a trunk's centre to what stands beside it
STACK = 0.35  # m; each robot starts that much above the one before


def crowds(env: Any, data: mujoco.MjData) -> dict[str, tuple[np.ndarray, list[np.ndarray]]]:
    """For each object of the task, its geoms and the places (R, 2) at which a crowd starts.

    The robots stand on the object, close around it if it is solid, and at both ends of a supporting
    surface. Of objects with equal geoms only the first is used; without objects the crowd is at the
    spawn poses.
    """
    model = env.compiled.model
    robots = env.index.num_robots
    start = data.qpos[env.index.base_qpos[:, :2]]
    turn = 2 * np.pi * np.arange(robots) / robots
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    found = {}
    shapes = set()
    for name, item in env.objects.items():
        geoms = np.flatnonzero((model.geom_bodyid == item.body) & (model.geom_contype > 0))
        shape = (*model.geom_type[geoms], *model.geom_size[geoms].ravel())
        if not len(geoms) or shape in shapes:
            continue
        shapes.add(shape)
        half = np.max(model.geom_pos[geoms] + model.geom_aabb[geoms, 3:], axis=0)[:2]
        middle = data.xpos[item.body][:2]
        places = [middle + 0.2 * ring]
        if np.any(model.geom_contype[geoms] & GROUND_BIT):
            end = np.array([half[0] - 0.45, 0.0])
            places += [middle - end + 0.2 * ring, middle + end + 0.2 * ring]
        else:
            for quarter in (0.0, np.pi / 2):  # from the first robot's start, and at right angles
                angle = turn + quarter + np.arctan2(*(start[0] - middle)[::-1])
                around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
                side = np.min(half / np.maximum(np.abs(around), 1e-6), axis=1)
                place = middle + (side + MARGIN)[:, None] * around
                places.append(np.maximum(place, [0.25, -np.inf]))  # clear of the back wall at x = 0
        found[name] = geoms, places
    return found or {"": (np.array([], int), [start.mean(0) + 0.15 * ring])}


@pytest.mark.parametrize("task", list(TASKS))
def test_a_crowd_fits_into_the_buffers(task: str) -> None:
    env = made(task)
    model = env.compiled.model
    index = env.index
    start = jax.tree.map(np.asarray, initial(env))
    random = np.random.default_rng(0)
    robots = index.num_robots
    data = mujoco.MjData(model)
    data.qpos[:] = start.data.qpos
    if model.nmocap:
        data.mocap_pos[:] = start.data.mocap_pos
    mujoco.mj_forward(model, data)
    qpos = data.qpos.copy()
    for name, (geoms, places) in crowds(env, data).items():
        touched = []
        contacts = []
        rows = []
        for place in places:
            data.qpos[:] = qpos
            data.qvel[:] = 0.0
            # out of the way of the rays that find the ground
            data.qpos[index.base_qpos[:, 2]] = 100.0
            mujoco.mj_forward(model, data)
            hit = np.zeros(1, np.int32)
            down = np.array([0.0, 0.0, -1.0])
            depth = np.array(
                [mujoco.mj_ray(model, data, [*at, 3.0], down, None, 1, -1, hit) for at in place]
            )
            data.qpos[index.base_qpos[:, :2]] = place
            data.qpos[index.base_qpos[:, 2]] = (
                3.0 - depth + env.robot.stand_height + STACK * np.arange(robots)
            )
            touched.append(0)
            for _ in range(100):
                data.ctrl[index.actuator] = env.robot.default_joints + 0.2 * random.standard_normal(
                    (robots, 12)
                )
                mujoco.mj_step(model, data, 4)
                contacts.append(data.ncon)
                rows.append(data.nefc)
                touched[-1] += bool(np.isin(data.contact.geom, geoms).any())
        print(
            f"{task} {name}: {max(contacts)} contacts, {max(rows)} rows at most; touched in "
            f"{touched} of 100 steps"
        )
        assert max(contacts) >= 2 * robots, f"{name}: too few contacts: the scene is not crowded"
        assert not len(geoms) or max(touched) >= 10, (
            f"{name}: touched in {touched} of 100 steps: no robot is near"
        )
        assert max(contacts) <= env.params.contacts_per_robot * robots
        assert max(rows) <= env.params.constraints_per_robot * robots
