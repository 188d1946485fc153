"""Motors: joint targets, torque-speed curves, joint speeds and limits on every engine; randomised physics and noise."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

from mqe_jax.envs import VectorEnv, make
from mqe_jax.physics import robots
from mqe_jax.physics.engines import c
from mqe_jax.physics.robots.motors import Motors, leg_response
from mqe_jax.physics.scene import Scene, compile_scene
from mqe_jax.terrain import Plane, Track
from tests.driving import start_in_air
from tests.test_engines import QUICK

SOAK = pytest.mark.soak


def motors_of(name: str) -> Motors:
    scene = Scene(Track(blocks=(Plane(4.0),), walled=False, num_robots=1), num_robots=1, robot=robots.get(name))
    return compile_scene(scene).motors


@pytest.mark.parametrize("name", ["go1", "go2"])
def test_idle_motors_keep_their_control_and_have_no_armature(name: str) -> None:
    motors = motors_of(name)
    random = np.random.default_rng(0)
    scale = random.uniform(0.0, 1.2, (2, 4000, 1))
    shares = (scale * random.uniform(-1.0, 1.0, (2, 4000, 12))).astype(np.float32)
    asked, velocity = shares[0] * motors.torque, shares[1] * motors.speed
    arguments = asked, np.zeros_like(asked), velocity, np.ones(12, np.float32), np.zeros((12, 3), np.float32)
    ctrl, armature = motors.limit(np, *arguments)
    acts = (ctrl != asked).any(axis=1) | armature.any(axis=1)
    idle = motors.idle(*arguments)
    assert not np.any(idle & acts)
    assert idle.sum() > 0.5 * (~acts).sum() and acts.any()
    asked[0, 0] = np.nan
    assert not motors.idle(*arguments)[0]


def test_steps_without_limits_are_taken_only_where_limits_have_no_effect(monkeypatch: Any) -> None:
    """Twenty steps under actions of 0 to 100% are the same when the limits are evaluated in all environments."""
    params = {"control": "torque", "num_agents": 1, "randomization": {"motor_strength": (0.7, 1.3)}}
    env: Any = make("go1plane", impl="c", num_envs=32, **params)
    vector, keys = VectorEnv(env, 32), jax.random.split(jax.random.PRNGKey(1), 20)
    start, step = jax.jit(vector.reset)(jax.random.PRNGKey(0)), jax.jit(vector.step)
    scale, states, rollouts = jnp.linspace(0.0, 1.0, 32)[:, None, None], [], []
    rollout = Batch.rollout
    monkeypatch.setattr(Batch, "rollout", lambda *a, ids, **k: rollouts.append(len(ids)) or rollout(*a, ids=ids, **k))
    for share in (0.0, 1.0):
        monkeypatch.setattr(c, "SHARE", share)
        state = start
        for key in keys:
            state = step(state, scale * jax.random.uniform(key, (32, 1, env.action_size), minval=-1.0))
        states.append(jax.tree.map(np.asarray, state))
    assert len(rollouts) == 20 and 0 < sum(rollouts) < 20 * 32
    jax.tree.map(np.testing.assert_array_equal, *states)


def test_a_step_that_is_interrupted_leaves_no_armature(monkeypatch: Any) -> None:
    env: Any = make("go1plane", impl="c", control="torque", num_agents=1, num_envs=2)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 2))
    data = state.data.replace(qvel=state.data.qvel.at[:, env.index.joint_qvel[0]].set(env.robot.joint_speed_limit))
    arrays = [
        np.asarray(x) for x in (data.qpos, data.qvel, data.qacc_warmstart, np.tile(env.robot.torque_limit, (2, 1)))
    ]
    call = lambda: env.physics._stepper.call((), False, env.physics.num_substeps, *arrays)  # noqa: E731
    expected = call()

    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Batch, "step", interrupted)
        call()
    np.testing.assert_array_equal(call(), expected)


def test_the_clamp_keeps_angle_and_speed_consistent() -> None:
    motors = motors_of("go1")
    velocity = np.where(np.arange(12) == 2, 3.0, 0.5) * motors.speed
    position, clamped = motors.clamp(np.zeros(12), velocity)
    assert clamped[2] == pytest.approx(1.09 * motors.speed[2]) and np.all(np.delete(clamped == velocity, 2))
    assert position[2] == pytest.approx(-0.005 * (3.0 - 1.09) * motors.speed[2]) and np.count_nonzero(position) == 1


def test_the_response_is_that_of_a_leg() -> None:
    response = leg_response(robots.get("go1"))
    assert response.shape == (3, 3) and np.all(np.diff(np.diag(response)[1:]) > 0) and response[1, 2] > 20.0
    np.testing.assert_allclose(response, response.T, rtol=1e-6)


def test_joints_in_the_air_start_along_their_torque_line() -> None:
    """Explicit integration of a physics step exceeds the line, an implicit one stays below."""
    for joint, row in start_in_air("go2").items():
        for name in ("torque", "speed_5", "speed_10"):
            assert 0.75 < row[name] / row[f"line_{name}"] < 1.35, (joint, row)


@pytest.mark.parametrize("robot", ["go1", pytest.param("go2", marks=SOAK)])
def test_engines_agree_where_motors_saturate(robot: str) -> None:
    states = {}
    for impl in ("c", "jax"):
        env: Any = make("go1plane", impl=impl, control="torque", robot=robot, num_agents=1, num_envs=4)
        state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 4))
        speed = 0.9 * env.robot.joint_speed_limit * jax.random.uniform(jax.random.PRNGKey(1), (4, 12), minval=-1.0)
        data = state.data.replace(qvel=state.data.qvel.at[:, env.index.joint_qvel[0]].set(speed))
        torque = jnp.where(speed > 0, 1.0, -1.0) * env.robot.torque_limit
        step = jax.jit(jax.vmap(lambda d, t, env=env: env.physics.step(d, t)[0]))
        states[impl] = step.lower(data, torque).compile(compiler_options=QUICK)(data, torque)
    for field, atol in (("qpos", 1e-4), ("qvel", 0.02)):
        expected, other = (np.asarray(getattr(states[impl], field)) for impl in ("c", "jax"))
        np.testing.assert_allclose(other, expected, atol=atol, err_msg=field)
    assert np.all(np.asarray(states["c"].ctrl) == np.asarray(torque))  # of the step, not of its last physics step


def test_joint_mechanics_are_in_the_model() -> None:
    env: Any = make("go1plane", impl="c", num_agents=1, joint_mechanics=True)
    joints, model = env.index.joint_qvel[0], env.compiled.model
    np.testing.assert_allclose(model.dof_armature[joints], env.robot.rotor_inertia)
    np.testing.assert_allclose(model.dof_damping[joints], env.robot.joint_damping)
    assert not model.dof_dampingpoly.any()
    np.testing.assert_allclose(model.dof_frictionloss[joints], env.robot.friction_loss)
    plain: Any = make("go1plane", impl="c", num_agents=1)
    assert not plain.compiled.model.dof_armature.any() and not plain.compiled.model.dof_frictionloss.any()


@pytest.mark.parametrize("robot", ["go1", "go2"])
def test_legs_with_joint_mechanics_stay_finite(robot: str) -> None:
    settings: dict[str, Any] = {"num_agents": 2, "num_envs": 8, "control": "position", "robot": robot}
    env: Any = make("go1plane", impl="c", joint_mechanics=True, **settings)
    step, key = jax.jit(jax.vmap(env.step)), jax.random.PRNGKey(0)
    state, fastest = jax.jit(jax.vmap(env.reset))(jax.random.split(key, 8)), 0.0
    for each in jax.random.split(key, 50):
        state = step(state, 0.3 * jax.random.normal(each, (8, 2, env.action_size)))
        fastest = max(fastest, float(jnp.abs(state.data.qvel[:, env.index.joint_qvel]).max()))
    assert 1.0 < fastest < 35.0


# -- randomised physics and noise --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "impl", ["c", pytest.param("jax", marks=pytest.mark.soak), pytest.param("warp", marks=pytest.mark.gpu)]
)
def test_payloads_act_as_in_models_compiled_with_them(impl: str) -> None:
    env = make("go1plane", impl=impl, control="position", num_envs=2, randomization={"payload": (0.0, 6.0)})
    model, trunk = env.compiled.model, env.index.trunk_body
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 2))
    start = state.data.replace(qpos=state.data.qpos.at[:, env.index.base_qpos[:, 2]].set(2.0))
    fields = jax.vmap(env.randomizer.fields)(state.randomized)

    def fall(data: Any, fields: dict[str, jax.Array]) -> jax.Array:
        return env.physics.step(data, data.ctrl, fields=fields, num_substeps=20)[0].qvel

    after = np.asarray(jax.jit(jax.vmap(fall))(start, fields))
    for number in (0, 1):
        payload = np.asarray(state.randomized.payload[number])
        compiled = model.__copy__()
        compiled.body_mass[trunk] += payload
        compiled.body_inertia[trunk] *= (1 + payload / model.body_mass[trunk])[:, None]
        data = mujoco.MjData(compiled)
        mujoco.mj_setConst(compiled, data)
        qvel = []
        for used in (compiled, model):
            mujoco.mj_resetData(used, data)
            data.qpos[:], data.qvel[:], data.ctrl[:] = start.qpos[number], start.qvel[number], start.ctrl[number]
            mujoco.mj_step(used, data, 20)
            qvel.append(data.qvel.copy())
        np.testing.assert_allclose(after[number], qvel[0], atol=1e-3)
        assert np.abs(after[number] - qvel[1]).max() > 0.01
