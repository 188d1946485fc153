"""The engine on Warp: agreement with MJX's calls of it, batches, shared and freed arrays.

The tests marked `gpu` also run on a CPU with warp-lang, in the soak.
"""

import copy
import dataclasses
import functools
import gc
import importlib
import pickle
import weakref
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mqe_jax.core.memory import bytes_of
from mqe_jax.envs import VectorEnv, make
from mqe_jax.envs.registry import SHIPPED
from mqe_jax.physics.engines import STATE_FIELDS, private, warp_engine, warp_model
from mqe_jax.physics.engines.warp_engine import WarpEngine

EXAMPLES = Path(__file__).parents[1] / "examples"
COUNT = 10
IMPLS = "warp", "warp-mjx"
RANDOM = {
    "friction": (0.3, 1.2),
    "payload": (0.0, 2.0),
    "center_of_mass": (-0.05, 0.05),
    "motor_strength": (0.7, 1.1),
    "joint_mechanics": (0.5, 2.0),
}
SCENES: dict[str, tuple[str, str, Mapping[str, Any]]] = {
    "randomized": ("go1gate", "position", {"randomization": RANDOM, "joint_mechanics": True}),
    "torques": ("go1tug", "torque", {"robot": "go2"}),
    "two legs": ("go1plane", "position", {"robot": str(EXAMPLES / "robots" / "biped.xml")}),
    "unlike robots": (
        "go1gate",
        "position",
        {"robots": ("go1", str(EXAMPLES / "robots" / "biped.xml"))},
    ),
    "sparse solver": ("go1football-2vs2", "position", {"sparse_solver": True}),
}


def nudged(state: Any) -> Any:
    """A state with speeds that differ by a bit."""
    qvel = state.data.qvel * np.float32(1 + 2**-23)
    return dataclasses.replace(state, data=state.data.replace(qvel=qvel))


def test_a_process_of_several_has_its_own_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the second process JAX's id of the device is 1, and Warp has only device 0."""
    second = SimpleNamespace(platform="gpu", id=1, local_hardware_id=0)
    monkeypatch.setattr(jax, "local_devices", lambda: [second])
    monkeypatch.setattr(
        warp_engine, "_warp", lambda: SimpleNamespace(get_cuda_device=[7].__getitem__)
    )
    assert warp_engine._device() == 7


@pytest.mark.gpu
@pytest.mark.parametrize("name", SCENES)
def test_steps_are_those_of_mjx(name: str) -> None:
    """One step from each of 100 states, and 20 steps in a row.

    Four iterations of the solver, the default, do not always converge, which magnifies rounding.
    """
    task, control, settings = SCENES[name]
    settings = {"control": control, "num_envs": COUNT, "solver_iterations": 20, **settings}
    envs = [make(task, impl=x, **settings) for x in IMPLS]
    keys = jax.random.split(jax.random.PRNGKey(0), COUNT)
    mine, theirs = (jax.jit(jax.vmap(env.reset))(keys) for env in envs)
    step, reference = (jax.jit(jax.vmap(env.step)) for env in envs)
    shape = COUNT, envs[0].num_agents, envs[0].action_size
    alone = mine
    for number in range(40):
        action = jax.random.uniform(jax.random.PRNGKey(number), shape, minval=-1.0)
        after = reference(theirs, action)
        if number % 4 == 0:
            fields = {x: getattr(theirs.data, x) for x in STATE_FIELDS}
            start = dataclasses.replace(theirs, data=mine.data.replace(**fields))
            found = step(start, action)
            sensitive = reference(nudged(theirs), action)
            for field, tolerance in (("qpos", 1e-5), ("qvel", 1e-4), ("time", 1e-7)):
                found_x, after_x, sensitive_x = (
                    np.asarray(getattr(x.data, field)) for x in (found, after, sensitive)
                )
                apart = np.abs(found_x - after_x).max()
                assert apart <= max(tolerance, 3 * np.abs(sensitive_x - after_x).max())
            np.testing.assert_array_equal(found.metrics["overflow"], after.metrics["overflow"])
        if number < 20:
            alone = step(alone, action)
        if number == 19:
            apart = np.abs(np.asarray(alone.data.qpos - after.data.qpos)).max(axis=1)
            assert np.median(apart) < 1e-3
        theirs = after
    assert np.ptp(np.asarray(theirs.data.qpos), axis=0).max() > 0.1  # the robots moved


@functools.cache
def small() -> tuple[Any, Any]:
    """An environment, and data of six of it that differ."""
    env = make("go1gate", impl="warp", control="position", num_envs=6)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 6))
    return env, state.data


def steps_of(engine: Any) -> Any:
    return jax.jit(jax.vmap(lambda data: engine.step(data, data.ctrl)[0]))


def nested(tree: Any) -> Any:
    return jax.tree.map(lambda x: x.reshape(2, 3, *x.shape[1:]), tree)


@pytest.mark.gpu
def test_nested_batches_are_one_batch_and_fields_need_no_rows() -> None:
    env, data = small()
    mass = jnp.asarray(env.physics.model.body_mass, jnp.float32)
    masses = mass * jnp.linspace(1.0, 3.0, 6)[:, None]

    def step(data: Any, mass: jax.Array) -> jax.Array:
        after = env.physics.step(data, data.ctrl + 0.3, fields={"body_mass": mass})[0]
        return after.qpos

    each = jax.vmap(step)
    shared = jax.vmap(step, (0, None))
    flat = jax.jit(each)
    cases = [
        (jax.vmap(each), nested(masses), masses),
        (jax.vmap(each, (0, None)), masses[:3], jnp.tile(masses[:3], (2, 1))),
        (jax.vmap(shared), masses[:2], jnp.repeat(masses[:2], 3, axis=0)),
        (jax.vmap(shared, (0, None)), mass, jnp.tile(mass, (6, 1))),
    ]
    seen = []
    for batched, rows, expected in cases:
        found = jax.jit(batched)(nested(data), rows)
        seen.append(np.asarray(flat(data, expected)))
        np.testing.assert_array_equal(found, nested(seen[-1]))
    assert np.abs(seen[0] - seen[-1]).max() > 1e-5  # the masses act
    first = jax.tree.map(lambda x: x[0], data)
    np.testing.assert_allclose(step(first, masses[0]), seen[0][0], rtol=0, atol=1e-5)


@pytest.mark.gpu
def test_calls_of_an_engine_share_arrays_but_no_state() -> None:
    env, data = small()
    force = jnp.zeros((6, env.physics.model.nbody, 6)).at[:, env.index.trunk_body, 2].set(200.0)
    armature = jnp.full((6, env.physics.model.nv), 0.3)

    def plain(data: Any) -> Any:
        return env.physics.step(data, data.ctrl)[0]

    def forced(data: Any, force: jax.Array, armature: jax.Array) -> Any:
        fields = {"dof_armature": armature}
        return env.physics.step(data, data.ctrl, fields=fields, xfrc_applied=force)[0]

    plain = jax.jit(jax.vmap(plain))
    forced = jax.jit(jax.vmap(forced))
    seen = [(plain(data).qpos, forced(data, force, armature).qpos) for _ in range(2)]
    np.testing.assert_allclose(seen[0], seen[1], rtol=0, atol=1e-6)
    assert np.abs(seen[0][0] - seen[0][1]).max() > 1e-3


@pytest.mark.gpu
def test_physics_steps_one_by_one_are_those_of_one_call() -> None:
    """As with an actuator network."""
    env, data = small()

    ctrl = data.ctrl + 0.5

    def step(num_substeps: int, data: Any, ctrl: jax.Array) -> Any:
        return env.physics.step(data, ctrl, num_substeps=num_substeps)[0]

    once = jax.jit(jax.vmap(functools.partial(step, 1)))
    four = jax.jit(jax.vmap(functools.partial(step, 4)))(data, ctrl)
    for _ in range(4):
        data = once(data, ctrl)
    for field in ("qpos", "qvel", "qacc_warmstart", "sensordata", "time"):
        np.testing.assert_allclose(getattr(data, field), getattr(four, field), rtol=1e-3, atol=1e-3)


@pytest.mark.gpu
def test_few_arrays_pass_between_jax_and_warp() -> None:
    env, data = small()
    lines = steps_of(env.physics).lower(data).as_text().splitlines()
    (call,) = [line for line in lines if "custom_call @warp_steps" in line]
    assert call.rpartition("} : ")[2].count("tensor<") == 7 + 6
    state = jax.eval_shape(VectorEnv(env, 6).reset, jax.random.PRNGKey(0))
    assert bytes_of(state) / 6 < 16_000


@pytest.mark.gpu
def test_terms_that_are_zero_and_early_sensors_are_skipped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    env, data = small()
    seen = []
    monkeypatch.setattr(private, "warp_step", lambda *given: seen.append(given[2]))
    engine = copy.deepcopy(env.physics)
    jax.block_until_ready(steps_of(engine)(data))
    bits = mujoco.mjtDisableBit
    unused = bits.mjDSBL_FRICTIONLOSS | bits.mjDSBL_SPRING | bits.mjDSBL_DAMPER
    assert seen == [unused | bits.mjDSBL_SENSOR] * 3 + [unused]


@pytest.mark.parametrize("task", SHIPPED)
def test_scenes_of_tasks_need_few_kernels(task: str) -> None:
    model = make(task, impl="c").physics.model
    assert warp_model.is_plain(model)
    for body, end in enumerate(warp_model.subtree_ends(model)):
        below = [body]
        for other in range(body + 1, model.nbody):
            below += [other] if model.body_parentid[other] in below else []
        assert below == list(range(body, end))


def test_other_models_have_their_own_step() -> None:
    spec = mujoco.MjSpec()
    spec.worldbody.add_body(mass=1.0, inertia=[1.0, 1.0, 1.0]).add_joint()
    assert not warp_model.is_plain(spec.compile())  # implicit damping
    spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    assert warp_model.is_plain(spec.compile())
    spec.worldbody.bodies[0].joints[0].name = "joint"
    spec.add_sensor(
        type=mujoco.mjtSensor.mjSENS_JOINTPOS, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname="joint"
    )
    assert not warp_model.is_plain(spec.compile())


@pytest.mark.gpu
@pytest.mark.parametrize("task", ["go1pushbox", "go1tug"])
def test_few_kernels_compute_the_same(task: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Robots that lie on their backs, and robots that stand."""
    count = 6
    settings = {"control": "position", "num_envs": count, "solver_iterations": 20}
    env = make(task, impl="warp", **settings)
    data = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), count)).data
    place = env.index.base_qpos[:, 2:]
    data = data.replace(qpos=data.qpos.at[:4, place].set(jnp.array([0.06, 0.0, 1.0, 0.0, 0.0])))

    def after(own: bool) -> Any:
        monkeypatch.setattr(warp_model, "is_plain", lambda model: own)
        return steps_of(copy.deepcopy(env.physics))(data)

    few = after(True)
    many = after(False)
    assert np.abs(many.sensordata).max() > 20.0
    for field, tolerance in (("qpos", 1e-6), ("qvel", 1e-4), ("sensordata", 0.01)):
        found = getattr(few, field)
        np.testing.assert_allclose(found, getattr(many, field), rtol=1e-3, atol=tolerance)


@pytest.mark.gpu
def test_arrays_are_freed_with_the_engine() -> None:
    env, data = small()

    def run() -> tuple[Any, list[Any]]:
        engine = copy.deepcopy(env.physics)
        program = steps_of(engine).lower(data).compile()
        expected = jax.block_until_ready(program(data))
        arrays = engine._stepper._arrays
        solver = sum(array.capacity for array in arrays._solvers[6]._scratch)
        assert engine.own_bytes(6) == private._bytes_of_arrays(arrays.data[6]) + solver
        again = pickle.loads(pickle.dumps(engine))
        assert again._stepper._arrays is None
        after = steps_of(again)(data)
        np.testing.assert_allclose(after.qpos, expected.qpos, rtol=0, atol=1e-5)
        held = arrays, arrays.model.body_mass, arrays.data[6].efc.J
        return program, [weakref.ref(x) for x in held]

    program, held = run()
    gc.collect()
    assert [x() for x in held] == [None] * 3
    with pytest.raises((ValueError, jax.errors.JaxRuntimeError), match="no longer exists"):
        jax.block_until_ready(program(data))


@pytest.mark.gpu
def test_a_program_outlives_its_environment_on_warp() -> None:
    def walk() -> Any:
        env = make("go1plane", impl="warp", control="position", num_envs=3)
        kept.append(weakref.ref(env.physics))

        def run(key: jax.Array) -> jax.Array:
            state = jax.vmap(env.reset)(jax.random.split(key, 3))
            step = jax.vmap(env.step)
            action = jnp.zeros((3, 2, 12))
            last, _ = jax.lax.scan(lambda x, _: (step(x, action), ()), state, None, 100)
            return last.data.qpos

        return run

    kept: list[Any] = []
    qpos = jax.jit(walk())(jax.random.PRNGKey(0))
    gc.collect()
    assert np.isfinite(np.asarray(qpos)).all()
    assert kept[0]() is None


@pytest.mark.gpu
def test_model_and_data_are_those_of_mjx() -> None:
    """What no longer fits after a new version of MuJoCo or Warp."""
    env, _ = small()
    model: Any = env.physics._stepper.model
    put: Any = private.without_warnings(private.load_mjx().put_model(model, impl="warp"))
    mine = private.warp_model(model, sparse=False)

    def compare(mine: Any, theirs: Any) -> int:
        compared = 0
        for name, value in vars(mine).items():
            expected = vars(theirs).get(name, vars(theirs._impl).get(name))
            if isinstance(expected, jax.Array | np.ndarray) and hasattr(value, "numpy"):
                found = value.numpy().reshape(expected.shape)
                np.testing.assert_array_equal(found, expected, name)
                compared += 1
            elif isinstance(expected, bool | int):
                assert value == expected, name
                compared += 1
        return compared

    assert compare(mine, put) > 300
    assert compare(mine.opt, put.opt) > 20


@pytest.mark.gpu
def test_graphs_are_forgotten_by_attributes_that_warp_has() -> None:
    env, data = small()
    engine = copy.deepcopy(env.physics)
    jax.block_until_ready(steps_of(engine)(data))
    ((call, _),) = engine._stepper._calls.values()
    (traced,) = call.call_descriptors.values()
    assert {"capture", *private._STAGED} <= set(vars(traced))
    for name in ("capture", *private._STAGED):
        setattr(traced, name, object())
    call.captures["key"] = object()
    private.forget_graphs(call)
    assert {getattr(traced, name) for name in ("capture", *private._STAGED)} == {None}
    assert not call.captures
    modes = importlib.import_module("warp").JaxCallableGraphMode.__members__
    assert WarpEngine.graph_mode in modes
