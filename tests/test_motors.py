"""Motors: joint targets, torque-speed curves, joint speeds and limits on every engine; randomised physics and noise."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

from mqe_jax.core.errors import InputError
from mqe_jax.envs import Randomization, VectorEnv, make
from mqe_jax.physics import robots
from mqe_jax.physics.engines import c
from mqe_jax.physics.robots.go1 import GO1
from mqe_jax.physics.robots.index import Proprioception
from mqe_jax.physics.robots.motors import BAND, CLAMP, Motors, leg_response
from mqe_jax.physics.scene import Scene, compile_scene
from mqe_jax.terrain import Plane, Track
from tests.driving import MODES, drive, start_in_air
from tests.states import initial
from tests.test_engines import QUICK

SOAK = pytest.mark.soak


@pytest.mark.parametrize("scale", [1.0, 4.0])
def test_joint_targets_are_within_the_scaled_range_of_the_default_angles(scale: float) -> None:
    env = make("go1gate", impl="c", control="position", position_scale=scale)
    controller = env.controller
    still = Proprioception(jnp.zeros((2, 3)), jnp.zeros((2, 12)), jnp.zeros((2, 12)))
    targets, _ = controller.targets(controller.reset(), jnp.ones((2, 12)), still)
    expected = GO1.default_joints + scale * np.tile([0.125, 0.25, 0.25], 4)
    np.testing.assert_allclose(targets, np.tile(expected, (2, 1)), rtol=1e-6)


def test_a_range_of_zero_is_refused() -> None:
    with pytest.raises(InputError, match="position_scale"):
        make("go1gate", impl="c", control="position", position_scale=0.0)


def motors_of(name: str) -> Motors:
    scene = Scene(Track(blocks=(Plane(4.0),), walled=False, num_robots=1), num_robots=1, robot=robots.get(name))
    return compile_scene(scene).motors


def given(motors: Motors, torque: Any, velocity: Any) -> tuple[np.ndarray, np.ndarray]:
    """Torques and armature (12,) of torque-controlled motors that are asked for `torque` at `velocity`."""
    ones, bias = np.ones(12), np.zeros((12, 3))
    rows = np.broadcast_to(torque, 12), np.zeros(12), np.broadcast_to(velocity, 12)
    ctrl, armature = motors.limit(np, *rows, ones, bias)
    return np.clip(ctrl, -motors.torque, motors.torque), armature


@pytest.mark.parametrize("name", ["go1", "go2"])
def test_torque_falls_to_zero_at_the_speed_limit_and_brakes_above(name: str) -> None:
    motors = motors_of(name)
    speed, limit, stall = motors.speed, motors.torque, motors.stall
    for share in (0.0, 0.3, 0.9, 1.0):
        expected = np.minimum(limit, stall * (1 - share))
        np.testing.assert_allclose(given(motors, 100.0, share * speed)[0], expected, rtol=1e-5, atol=1e-4)
        np.testing.assert_allclose(given(motors, -100.0, -share * speed)[0], -expected, rtol=1e-5, atol=1e-4)
        # Against its speed a motor gives what the controller allows.
        np.testing.assert_allclose(given(motors, -100.0, share * speed)[0], -limit, rtol=1e-5)
    np.testing.assert_allclose(given(motors, 0.0, (1.0 + BAND / 2) * speed)[0], -0.5 * limit, rtol=1e-4)
    np.testing.assert_allclose(given(motors, 100.0, 1.5 * speed)[0], -limit, rtol=1e-4)
    asked = motors.limit(np, np.zeros(12), np.zeros(12), 5.0 * speed, np.ones(12), np.zeros((12, 3)))[0]
    np.testing.assert_allclose(asked, -limit, rtol=1e-4)  # not left to the limits of the model's actuators


@pytest.mark.parametrize("name", ["go1", "go2"])
def test_a_slow_leg_has_no_armature_and_its_control_is_unchanged(name: str) -> None:
    motors = motors_of(name)
    torque, armature = given(motors, 4.0, 0.4 * motors.speed.min())
    assert np.all(torque == 4.0) and np.all(armature == 0.0)
    # One fast joint gives the whole leg its armature, and no other leg.
    velocity = np.zeros(12)
    velocity[4] = motors.speed.min()
    np.testing.assert_array_equal(given(motors, 0.0, velocity)[1] > 0, np.repeat([False, True, False, False], 3))


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


def test_joint_targets_are_changed_so_that_the_actuators_give_the_motors_torque() -> None:
    motors, go1 = motors_of("go1"), robots.get("go1")
    gain, bias = np.full(12, go1.kp), np.tile([0.0, -go1.kp, -go1.kd], (12, 1))
    position, velocity = go1.default_joints, 0.9 * go1.joint_speed_limit
    ctrl, _ = motors.limit(np, position + 5.0, position, velocity, gain, bias)
    force = go1.kp * (ctrl - position) - go1.kd * velocity
    np.testing.assert_allclose(force, 0.1 * go1.stall_torque, rtol=1e-4)


def test_the_clamp_keeps_angle_and_speed_consistent() -> None:
    motors = motors_of("go1")
    velocity = np.where(np.arange(12) == 2, 3.0, 0.5) * motors.speed
    position, clamped = motors.clamp(np.zeros(12), velocity)
    assert clamped[2] == pytest.approx(CLAMP * motors.speed[2]) and np.all(np.delete(clamped == velocity, 2))
    assert position[2] == pytest.approx(-0.005 * (3.0 - CLAMP) * motors.speed[2]) and np.count_nonzero(position) == 1


def test_the_response_is_that_of_a_leg() -> None:
    """A calf is the lightest link, and a torque at the thigh turns the calf too."""
    response = leg_response(robots.get("go1"))
    assert response.shape == (3, 3) and np.all(np.diff(np.diag(response)[1:]) > 0) and response[1, 2] > 20.0
    np.testing.assert_allclose(response, response.T, rtol=1e-6)


# Shares of the speed limit: 99.9% of the joints, and the greatest; rad past a joint limit likewise.
BARS = {"speed_999": 1.1, "speed_max": 1.5, "excess_999": 0.1, "excess_max": 0.3}


@pytest.mark.parametrize(
    ("robot", "mode", "steps"),
    [
        ("go1", "saturated", 5_000),
        *(pytest.param(robot, mode, 1_000_000, marks=SOAK) for robot in ("go1", "go2") for mode in MODES),
    ],
)
def test_hard_driving_stays_within_the_limits(robot: str, mode: str, steps: int) -> None:
    figures = drive(robot, mode, steps)
    assert figures["diverged"] == 0
    assert all(figures[name] <= bar for name, bar in BARS.items()), figures


@pytest.mark.parametrize("robot", ["go1", "go2"])
def test_joints_in_the_air_start_along_their_torque_line(robot: str) -> None:
    """Explicit integration of a physics step exceeds the line, an implicit one stays below."""
    for joint, row in start_in_air(robot).items():
        for name in ("torque", "speed_5", "speed_10"):
            assert 0.75 < row[name] / row[f"line_{name}"] < 1.35, (joint, row)


@pytest.mark.parametrize("robot", ["go1", pytest.param("go2", marks=SOAK)])
def test_engines_agree_where_motors_saturate(robot: str) -> None:
    """One environment step under saturated torques, from joints in motion."""
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


def test_randomised_joint_mechanics_reach_the_physics() -> None:
    """Joints under 1 N m move less with their full inertia, damping and friction than with a tenth of it."""
    moved = {}
    for factor in (0.1, 1.0):
        params = {"joint_mechanics": True, "randomization": {"joint_mechanics": (factor, factor + 1e-3)}}
        env: Any = make("go1plane", impl="c", control="torque", num_agents=1, num_envs=1, **params)
        state = jax.jit(env.reset)(jax.random.PRNGKey(0))
        joints = env.index.joint_qpos[0]
        after = jax.jit(env.step)(state, jnp.full((1, 12), 0.05))
        moved[factor] = float(jnp.abs(after.data.qpos[joints] - state.data.qpos[joints]).sum())
    assert 0.0 < moved[1.0] < 0.7 * moved[0.1]
    with pytest.raises(InputError, match="joint_mechanics"):
        make("go1plane", impl="c", randomization={"joint_mechanics": (0.5, 2.0)})


# -- randomised physics and noise --------------------------------------------------------------------------------------


def test_randomisation_reaches_the_physics() -> None:
    """Each environment's friction, payload, motors, offsets, pushes and lag differ, and a heavier trunk sags more."""
    drawn: dict[str, Any] = {"friction": (0.5, 1.25), "payload": (0.0, 6.0), "center_of_mass": (-0.02, 0.02)}
    drawn |= {
        "motor_strength": (0.9, 1.1),
        "motor_offset": 0.02,
        "action_lag": 2,
        "push": 0.3,
        "observation_noise": 0.01,
    }
    still: dict[str, Any] = {"spawn_velocity": 0.0, "spawn_joint_scale": (1.0, 1.0), "spawn_height": 0.31}
    env = make("go1plane", impl="c", control="position", randomization=drawn, **still)
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 16))
    params = states.randomized
    assert np.ptp(np.asarray(params.friction)) > 0.3 and set(np.asarray(params.action_lag).tolist()) == {0, 1, 2}
    step, neutral = jax.jit(jax.vmap(env.step)), states.data.ctrl
    for waited in range(3):  # steps since the only action
        states = step(states, jnp.full((16, 2, 12), float(waited == 0)))
        change = np.asarray(states.data.ctrl - neutral)
        moved = np.abs(change).max(-1) > 0.1
        offset = np.asarray(params.motor_offset).reshape(change.shape)
        np.testing.assert_allclose(change[~moved], offset[~moved], atol=1e-6)
        np.testing.assert_array_equal(moved, np.asarray(params.action_lag) == waited)
    for _ in range(60):
        states = step(states, jnp.zeros((16, 2, 12)))
    height = np.asarray(jax.vmap(env.read)(states.data).position_w)[..., 2].ravel()
    payload = np.asarray(params.payload).ravel()
    assert np.corrcoef(height, payload)[0, 1] < -0.5


def test_a_pushed_robot_slides_further_the_smoother_its_feet_are() -> None:
    """Robots that stand are given 0.8 m/s ahead; the floor's friction, 1, does not replace theirs."""
    env = make("go1plane", impl="c", control="position", num_envs=16, randomization={"friction": (0.05, 1.5)})
    x, speed = env.index.base_qpos[:, 0], env.index.base_qvel[:, 0]
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 16))
    step = jax.jit(jax.vmap(env.step))
    for _ in range(30):
        state = step(state, jnp.zeros((16, 2, 12)))
    start = state.data.qpos[:, x]
    state = dataclasses.replace(state, data=state.data.replace(qvel=state.data.qvel.at[:, speed].set(0.8)))
    for _ in range(45):
        state = step(state, jnp.zeros((16, 2, 12)))
    slid = np.asarray(state.data.qpos[:, x] - start).ravel()
    friction = np.asarray(state.randomized.friction).ravel()
    smooth, rough = slid[friction < 0.3], slid[friction > 1.0]
    assert len(smooth) > 2 and len(rough) > 2
    assert np.median(smooth) > np.median(rough) + 0.2, (smooth, rough)


def test_pushes_come_once_per_period_on_average() -> None:
    """A period of 0.05 s is 2.5 environment steps; the robots are in the air, where nothing else brakes them."""
    env = make("go1plane", impl="c", control="position", randomization={"push": 10.0, "push_period": 0.05})
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 512))
    after = jax.jit(jax.vmap(env.step))(states, jnp.zeros((512, 2, 12)))
    columns = env.index.base_qvel[:, :2]
    change = np.asarray(after.data.qvel[:, columns] - states.data.qvel[:, columns])
    pushed = np.abs(change).max(-1) > 1.0  # m/s; 1% of the pushes are smaller
    assert 0.35 < pushed.mean() < 0.45
    assert np.abs(change).max() < 12.0 and np.abs(change.mean()) < 1.0


def test_the_privileged_observation_contains_the_randomised_physics_and_gait_phase() -> None:
    ranges: dict[str, Any] = {"friction": (0.5, 1.25), "payload": (0.0, 2.0), "center_of_mass": (-0.02, 0.02)}
    drawn = Randomization(**ranges, motor_strength=(0.9, 1.1), action_lag=3)
    env = make("go1gate", impl="c", num_envs=1, privileged_contact_forces=True, randomization=drawn)
    state = initial(env)
    step = jax.jit(env.step)
    for _ in range(60):  # 1.2 s: the robots have landed, and the gait of 3 Hz is at 0.6 of a cycle
        state = step(state, jnp.zeros((2, 3)))
    blocks = env.privileged_layout.split(state.privileged_obs)
    assert state.privileged_obs.shape == (env.privileged_observation_size,)
    for name in ("friction", "payload", "motor_strength"):
        np.testing.assert_allclose(blocks[name], getattr(state.randomized, name), rtol=1e-6)
    np.testing.assert_allclose(blocks["center_of_mass"], np.ravel(state.randomized.center_of_mass), rtol=1e-6)
    assert float(blocks["action_lag"][0]) == int(state.randomized.action_lag)
    angle = 2 * np.pi * 0.6
    np.testing.assert_allclose(blocks["gait_phase"], [np.sin(angle), np.cos(angle)] * 2, atol=1e-4)
    force = np.asarray(blocks["contact_force"]).reshape(2, 5)
    assert np.all(force[:, 0] == 0) and np.all(force[:, 1:].sum(1) > 20)  # N; a Go1 weighs 111 N
    np.testing.assert_allclose(blocks["robot1/position"], env.read(state.data).position_w[1], rtol=1e-6)


@pytest.mark.parametrize(
    "impl", ["c", pytest.param("jax", marks=pytest.mark.soak), pytest.param("warp", marks=pytest.mark.gpu)]
)
def test_payloads_act_as_in_models_compiled_with_them(impl: str) -> None:
    """Two environments in free fall under motor torques, with different payloads on trunks of scaled inertia."""
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
