"""Physics on three engines: agreement with MuJoCo and with each other, finite states, crowds,
dropped contacts, calls of the host.

The soak compares all tasks. `python -m tests.engines` compares all engines.
"""

import dataclasses
import functools
import gc
import importlib.metadata
import os
import subprocess
import sys
import weakref
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import jax
import jax.export
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from mqe_jax.envs import TASKS, VectorEnv, make
from mqe_jax.physics import engines
from mqe_jax.physics.collision import GROUND_BIT
from mqe_jax.physics.engines import Engine, private
from mqe_jax.physics.engines import host_call as host_calls
from mqe_jax.physics.engines.c import CEngine, _Stepper
from mqe_jax.physics.engines.host_call import host_call
from mqe_jax.physics.engines.mjx import WarpMjxEngine
from mqe_jax.physics.engines.mjx_step import MarginStep
from mqe_jax.physics.robots.go1 import GO1
from mqe_jax.physics.scene import CompiledScene, Scene, compile_scene
from mqe_jax.terrain import Plane, Track
from tests import engines as comparison
from tests.inputs import refuses
from tests.states import initial, made

NEEDS_GPU = pytest.mark.gpu
IMPLS = ["c", "jax", *(pytest.param(name, marks=NEEDS_GPU) for name in ("warp", "warp-mjx"))]


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


@pytest.mark.soak
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


# On MJX-JAX the forces are compared with those of the C engine over 20 steps, below.
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
                3.0 - depth + env.robots[0].stand_height + STACK * np.arange(robots)
            )
            touched.append(0)
            for _ in range(100):
                swing = 0.2 * random.standard_normal((robots, 12))
                data.ctrl[index.actuator] = env.robots[0].default_joints + swing
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


# -- engines


# for a few steps
QUICK = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}


@pytest.mark.soak
@pytest.mark.parametrize("task", list(TASKS))
def test_mjx_agrees_with_the_c_engine_over_20_steps(task: str) -> None:
    figures = comparison.disagreement(task, "jax", comparison.record(task, num_envs=4))
    assert figures["standing/robots_1"] < 1e-3, figures
    assert figures["standing/robots_20"] < 0.02 and figures["standing/robots_20_max"] < 0.1, figures
    assert figures.get("standing/objects_20_max", 0.0) < 0.02, figures
    # Where a robot leans on an edge of a box, the engines put the contact points otherwise.
    assert figures["play/robots_1"] < 0.03 and figures["play/robots_20"] < 0.05, figures
    assert figures.get("play/objects_20", 0.0) < 0.05, figures


# with boxes, with sheep, a match with a ball, and with a defender
ENGINES = ("go1pushbox", "go1sheep-hard", "go1football-1vs1", "go1football-defender")


@pytest.mark.parametrize(
    "task",
    [pytest.param(task, marks=() if task in ENGINES else pytest.mark.soak) for task in TASKS],
)
def test_two_engines_return_the_same_shapes(task: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The task's code accepts the state of both; their physics, which takes seconds to trace,
    stands still.
    """
    monkeypatch.setattr(Engine, "step", lambda self, data, ctrl, **_: (data, jnp.zeros((), bool)))
    shapes = []
    for env in (made(task), make(task, impl="jax", control="position", num_envs=2)):
        batch = VectorEnv(env, 2)
        action = jnp.zeros((2, env.num_agents, 12))
        state = jax.eval_shape(
            lambda key, b=batch, a=action: b.step(b.reset(key), a), jax.random.PRNGKey(0)
        )
        shapes.append(jax.tree.map(lambda x: x.shape, dataclasses.replace(state, data=None)))
    assert shapes[0] == shapes[1]


@pytest.mark.parametrize(
    ("impl", "limit"),
    [
        pytest.param("jax", {"contacts_per_robot": 2}, marks=pytest.mark.soak),
        pytest.param("warp", {"constraints_per_robot": 8}, marks=pytest.mark.gpu),
    ],
)
def test_a_step_that_drops_contacts_is_counted(impl: str, limit: dict[str, Any]) -> None:
    env = make(
        "go1plane",
        impl=impl,
        control="position",
        num_envs=3,
        num_agents=1,
        contacts="minimal",
        **limit,
    )

    start = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 3))
    qpos = np.array(start.data.qpos)
    qvel = np.zeros_like(start.data.qvel)
    qpos[:, env.index.base_qpos[0]] = [(1, 0, height, 1, 0, 0, 0) for height in (0.3, 1.3, 0.3)]
    qpos[:, env.index.joint_qpos[0]] = env.robots[0].default_joints
    qvel[:, env.index.base_qvel[0, 2]] = 0.0, 0.0, 3.0
    start = dataclasses.replace(
        start, data=start.data.replace(qpos=jnp.asarray(qpos), qvel=jnp.asarray(qvel))
    )
    step = (
        jax.jit(jax.vmap(env.step))
        .lower(start, jnp.zeros((3, 1, 12)))
        .compile(compiler_options=QUICK)
    )
    after = step(start, jnp.zeros((3, 1, 12)))
    assert after.metrics["overflow"].tolist() == [1.0, 0.0, 1.0]
    lifted = after.data.qpos.at[:, env.index.base_qpos[0, 2]].add(1.0)
    after = step(
        dataclasses.replace(after, data=after.data.replace(qpos=lifted)), jnp.zeros((3, 1, 12))
    )
    assert after.metrics["overflow"].tolist() == [0.0, 0.0, 0.0]  # of this step, not of one before


@pytest.mark.parametrize(
    ("robots", "asked", "version", "found"),
    [
        (4, None, private._READ, False),
        (5, None, private._READ, True),
        (5, False, private._READ, False),
        (3, True, private._READ, True),
        (
            2,
            True,
            private._READ,
            "None or False: .* but those of 36 degrees of freedom are dense",
        ),
        (5, None, "3.99.0", False),
        (5, True, "3.99.0", f"None or False: .* mujoco-mjx {private._READ}, not 3.99.0"),
    ],
)
def test_warp_skips_zeros_where_it_pays(
    robots: int,
    asked: bool | None,
    version: str,
    found: bool | str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # of another one compare the Newton step
    assert importlib.metadata.version("mujoco-mjx") == private._READ
    monkeypatch.setattr(importlib.metadata, "version", lambda name: version)
    monkeypatch.setattr(private, "warp_is_installed", lambda: True)
    monkeypatch.setattr(private, "keep_streams", lambda: None)
    settings = {} if asked is None else {"sparse_solver": asked}
    build = functools.partial(make, "go1gate", impl="warp", num_agents=robots, **settings)
    if isinstance(found, str):
        refuses(f"sparse_solver: True is not allowed; it must be {found}", build)
    else:
        env: Any = build()
        assert env.physics.skips_zeros == found


@pytest.mark.gpu
def test_warp_skips_zeros_with_the_same_result(monkeypatch: pytest.MonkeyPatch) -> None:
    """Robots stand alone in one environment; in the other the last one stands in the first."""
    from mqe_jax.physics.engines import newton

    def counted(*arguments: Any, **options: Any) -> None:
        calls.append(arguments)
        step(*arguments, **options)

    after = []
    calls = []
    step = newton.step
    monkeypatch.setattr(newton, "step", counted)
    for sparse in (True, False):
        calls.clear()  # a model of the other kind in this process changes nothing
        options = {"num_envs": 2, "num_agents": 4, "sparse_solver": sparse}
        env: Any = make("go1football-1vs1", impl="warp", control="position", **options)
        state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 2))
        first = env.index.base_qpos[0, :3]
        last = env.index.base_qpos[3, :3]
        qpos = state.data.qpos.at[1, last].set(
            state.data.qpos[1, first] + jnp.array([0.0, 0.05, 0.1])
        )
        state = dataclasses.replace(state, data=state.data.replace(qpos=qpos))
        walk = (
            jax.jit(jax.vmap(env.step))
            .lower(state, jnp.zeros((2, 4, 12)))
            .compile(compiler_options=QUICK)
        )
        for _ in range(4):
            state = walk(state, jnp.zeros((2, 4, 12)))
        after.append(np.asarray(state.data.qpos))
        assert bool(calls) == sparse
    np.testing.assert_allclose(after[1], after[0], rtol=0, atol=1e-4)


class Owner:
    """Keeps its functions alive."""


def called(function: Any, number: int, owner: Owner) -> Any:
    """A compiled program that calls a host function of two arrays (3,)."""
    result = jax.ShapeDtypeStruct((3,), jnp.float32)
    return jax.jit(jax.vmap(lambda x, y: host_call(number, owner, function, result, (x, y))))


class _Stream:
    """A stand-in for Warp's handle to a stream of JAX: any that is collected releases the
    stream.
    """

    known: ClassVar[set[int]] = set()

    def __init__(self, address: int, owner: bool) -> None:
        self.address = address
        self.owner = owner
        self.known.add(address)

    def __del__(self) -> None:
        self.known.discard(self.address)


def test_warp_keeps_a_stream_of_jax_when_an_old_handle_to_it_is_collected(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "warp", SimpleNamespace(Stream=_Stream))
    private.keep_streams.__wrapped__()
    old = _Stream(1, False)
    new = _Stream(1, False)
    owned = _Stream(2, True)
    del old, owned
    gc.collect()
    assert _Stream.known == {new.address}


class _Mjx:
    """A stand-in for MJX in which Warp is MJX-JAX and nothing moves; keeps what Warp gets."""

    def __init__(self) -> None:
        self.mjx: Any = private.load_mjx()
        self.models: list[mujoco.MjModel] = []
        self.flags: list[int] = []

    def put_model(self, model: mujoco.MjModel, device: Any, impl: str) -> Any:
        self.models.append(model)
        return self.mjx.put_model(model, device, impl="jax")

    def make_data(self, model: mujoco.MjModel, device: Any, impl: str, **sizes: int) -> Any:
        self.models.append(model)
        return self.mjx.make_data(model, device, impl="jax")

    def step(self, model: Any, data: Any) -> Any:
        self.flags.append(int(model.opt.disableflags))
        return data


@pytest.fixture
def warp(monkeypatch: pytest.MonkeyPatch) -> _Mjx:
    stand_in = _Mjx()
    monkeypatch.setattr(private, "load_mjx", lambda: stand_in)
    monkeypatch.setattr(private, "keep_streams", lambda: None)
    for name in ("without_warnings", "without_overflow"):
        monkeypatch.setattr(private, name, lambda x: x)
    monkeypatch.setattr(private, "sparse_newton_needs", lambda model: "another model")
    monkeypatch.setattr(private, "overflow", lambda data: jnp.zeros((), bool))
    return stand_in


def content(model: mujoco.MjModel) -> bytes:
    buffer = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


BIT = mujoco.mjtDisableBit
FRICTION = BIT.mjDSBL_FRICTIONLOSS
PASSIVE = BIT.mjDSBL_SPRING | BIT.mjDSBL_DAMPER


@pytest.mark.parametrize(
    ("part", "attribute", "fields", "unused"),
    [
        ("joint", "", (), FRICTION | PASSIVE),
        ("joint", "", ("geom_friction", "dof_armature"), FRICTION | PASSIVE),
        ("joint", "", ("dof_armature", "dof_damping", "dof_frictionloss"), 0),
        ("joint", "", ("body_gravcomp",), FRICTION),
        ("joint", "frictionloss='0.1'", (), PASSIVE),
        ("joint", "stiffness='0.1'", (), FRICTION),
        ("fixed", "frictionloss='0.1'", (), PASSIVE),
        ("motor", "damping='0.1'", (), FRICTION),
        ("body", "gravcomp='1'", (), FRICTION),
        ("option", "viscosity='1'", (), FRICTION),
    ],
)
def test_warp_computes_no_terms_that_are_zero(
    part: str, attribute: str, fields: tuple[str, ...], unused: int, warp: _Mjx
) -> None:
    xml = """<mujoco><option/>
      <worldbody><body><joint name="j"/><geom size="0.1"/></body></worldbody>
      <tendon><fixed><joint joint="j" coef="1"/></fixed></tendon>
      <actuator><motor joint="j"/></actuator></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml.replace(f"<{part}", f"<{part} {attribute}", 1))
    before = content(model)
    engine = WarpMjxEngine(model)
    values = {name: jnp.asarray(getattr(model, name)) for name in fields}
    jax.eval_shape(lambda data: engine.step(data, data.ctrl, fields=values), engine.blank())
    assert set(warp.flags) == {unused, unused | BIT.mjDSBL_SENSOR}
    assert content(model) == before and engine.model is model


@pytest.fixture(params=["handler", "callback"])
def host(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both ways of calling a host function: by XLA's C interface and, where its version differs, by
    JAX's callback.
    """
    assert host_calls.FITS
    monkeypatch.setattr(host_calls, "FITS", request.param == "handler")


@pytest.mark.usefixtures("host")
def test_a_host_function_gets_all_arguments_as_one_batch_that_it_cannot_change() -> None:
    seen = []

    def add(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        seen.append((x.shape, y.dtype.name, x.flags.writeable))
        return x + y

    owner = Owner()
    x = jnp.arange(6.0).reshape(2, 3)
    y = jnp.array([[1, 2, 3], [4, 5, 6]], jnp.int32)
    np.testing.assert_array_equal(called(add, 1, owner)(x, y), x + y)
    assert seen == [((2, 3), "int32", False)]


@pytest.mark.parametrize(("version", "fits"), [((0, 3), True), ((0, 4), False), ((1, 0), False)])
def test_a_host_function_needs_this_version_of_the_c_interface(
    monkeypatch: pytest.MonkeyPatch, version: tuple[int, int], fits: bool
) -> None:
    monkeypatch.setattr(host_calls, "_VERSION", version)
    assert host_calls._fits() == fits


@pytest.mark.usefixtures("host")
def test_what_a_host_function_raises_ends_the_program() -> None:
    def fail(*arrays: np.ndarray) -> np.ndarray:
        raise KeyboardInterrupt

    owner = Owner()
    with pytest.raises(jax.errors.JaxRuntimeError, match="KeyboardInterrupt"):
        called(fail, 2, owner)(jnp.zeros((2, 3)), jnp.zeros((2, 3))).block_until_ready()


def test_a_program_outlives_its_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    # no other environment of this physics
    monkeypatch.setattr("mqe_jax.physics.engines.host_call._owners", {})
    seen: list[Any] = []

    def walk() -> Any:
        env: Any = make("go1plane", impl="c", control="position")
        seen[:] = weakref.ref(env.physics), env.physics._stepper

        def run(key: jax.Array) -> jax.Array:
            state = jax.vmap(env.reset)(jax.random.split(key, 3))
            step = jax.vmap(env.step)
            action = jnp.zeros((3, 2, 12))
            return jax.lax.scan(lambda state, _: (step(state, action), ()), state, None, 100)[
                0
            ].data.qpos

        return run

    kept = walk()
    expected = jax.jit(kept)(jax.random.PRNGKey(0)).block_until_ready()
    assert sum(map(len, seen[1]._idle.values())) == 1
    del kept
    qpos = jax.jit(walk())(jax.random.PRNGKey(0))
    gc.collect()
    assert seen[0]() is None
    np.testing.assert_array_equal(qpos, expected)
    assert not any(seen[1]._idle.values())


SECOND_START = """
import jax, mqe_jax
hits = []
jax.monitoring.register_event_listener(lambda event, **_: hits.append(event.rsplit("/", 1)[-1]))
env = mqe_jax.VectorEnv(mqe_jax.make("go1plane", impl="c", control="position"), 2)
state = jax.jit(env.reset)(jax.random.PRNGKey(0))
for _ in range(3):
    state = jax.jit(env.step)(state, jax.numpy.full((2, env.num_agents, 12), 0.3))
print(hits.count("cache_hits"), hits.count("cache_misses"), float(state.data.qpos.sum()))
"""


@pytest.mark.soak
def test_a_second_process_compiles_no_step_of_the_c_engine(tmp_path: Path) -> None:
    keep = {
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    run = [sys.executable, "-c", SECOND_START]
    first, second = (
        subprocess.run(
            run, env={**os.environ, **keep}, capture_output=True, text=True, check=True
        ).stdout.split()
        for _ in range(2)
    )
    assert (
        int(first[1]) >= 2
        and int(second[1]) == 0
        and int(second[0]) == int(first[0]) + int(first[1])
    )
    assert first[2] == second[2]


@pytest.mark.soak
@pytest.mark.parametrize("task", list(TASKS))
def test_reset_and_step_are_lowered_for_a_tpu(task: str) -> None:
    env = make(task, impl="jax", num_envs=2)
    reset = jax.jit(jax.vmap(env.reset))
    step = jax.jit(jax.vmap(env.step))
    key = jax.ShapeDtypeStruct((2, 2), jnp.uint32)
    action = jax.ShapeDtypeStruct((2, env.num_agents, env.action_size), jnp.float32)
    for exported in (
        jax.export.export(reset, platforms=["tpu"])(key),
        jax.export.export(step, platforms=["tpu"])(jax.eval_shape(reset, key), action),
    ):
        assert exported.platforms == ("tpu",) and "custom_call @mqe" not in exported.mlir_module()


def test_a_program_that_still_runs_at_the_end_of_the_interpreter_is_awaited() -> None:
    """Otherwise XLA's thread would call Python while it is finalised, which ends the process with
    SIGSEGV.
    """
    code = """
import time
import jax, numpy as np
from mqe_jax.physics.engines.host_call import host_call
from mqe_jax.physics.engines.mjx import WarpMjxEngine
class Owner: pass
owner = Owner()
def slow(x):
    time.sleep(0.02)
    return x + 1
shape = jax.ShapeDtypeStruct((300, 300), np.float32)
def call(i, x):
    return host_call(1, owner, slow, shape, [x @ x])
f = jax.jit(lambda x: jax.lax.fori_loop(0, 40, call, x))
running = f(np.zeros((300, 300), np.float32))
"""
    ended = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120
    )
    assert ended.returncode == 0, ended.stderr


def test_the_c_engine_has_as_many_threads_as_the_process_has_cores(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: range(5))
    model = mujoco.MjModel.from_xml_string("<mujoco><worldbody/></mujoco>")
    tasks = Path("/proc/self/task")
    before = len(list(tasks.iterdir()))
    stepper = _Stepper(model, None)
    empty = np.zeros((64, 0))
    stepper.call((), False, 1, empty, empty, empty, empty)
    assert len(list(tasks.iterdir())) == before + 4  # and the calling one
