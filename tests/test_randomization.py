"""Randomised physics and noise: their effect on the robots and what the observations contain of them."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mqe_jax.envs import Randomization, make
from tests.states import initial


def test_randomisation_reaches_the_physics() -> None:
    """Each environment's friction, payload, motors, pushes and lag differ, and a heavier trunk sags more."""
    env = make(
        "go1plane",
        impl="c",
        control="position",
        spawn_velocity=0.0,
        spawn_joint_scale=(1.0, 1.0),
        spawn_height=0.31,
        randomization={
            "friction": (0.5, 1.25),
            "payload": (0.0, 6.0),
            "center_of_mass": (-0.02, 0.02),
            "motor_strength": (0.9, 1.1),
            "action_lag": 2,
            "push": 0.3,
            "observation_noise": 0.01,
        },
    )
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 16))
    params = states.randomized
    assert np.ptp(np.asarray(params.friction)) > 0.3 and set(np.asarray(params.action_lag).tolist()) == {0, 1, 2}
    step, neutral = jax.jit(jax.vmap(env.step)), states.data.ctrl
    for waited in range(3):  # steps since the only action
        states = step(states, jnp.full((16, 2, 12), float(waited == 0)))
        moved = np.abs(np.asarray(states.data.ctrl - neutral)).max(-1) > 0.1
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


def test_observation_noise_spares_the_one_hots() -> None:
    env = make("go1gate", impl="c", control="position", randomization={"observation_noise": 0.1})
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 8))
    blocks = env.observation_layout.split(state.obs)
    np.testing.assert_array_equal(blocks["one_hot"], np.tile(np.eye(2), (8, 1, 1)))
    exact = jax.vmap(lambda state: env.observe(state, env.read(state.data))["gate"])(state)
    error = np.asarray(blocks["gate"] - exact)
    assert 0.05 < error.std() < 0.2


def test_the_privileged_observation_contains_the_randomised_physics_and_gait_phase() -> None:
    env = make(
        "go1gate",
        impl="c",
        num_envs=1,
        privileged_contact_forces=True,
        randomization=Randomization(
            friction=(0.5, 1.25),
            payload=(0.0, 2.0),
            center_of_mass=(-0.02, 0.02),
            motor_strength=(0.9, 1.1),
            action_lag=3,
        ),
    )
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


def test_motor_strength_is_a_factor_on_all_torques() -> None:
    """Also on those that the joint's angle and speed cause, in PD control."""
    env = make("go1plane", impl="c", control="position", num_envs=1, randomization={"motor_strength": (0.5, 0.8)})
    params, model = env.randomizer.sample(jax.random.PRNGKey(0)), env.compiled.model
    data, varied, forces = mujoco.MjData(model), model.__copy__(), []
    for name, value in env.randomizer.fields(params).items():
        getattr(varied, name)[:] = value
    data.ctrl[:], data.qvel[:] = data.qpos[env.index.joint_qpos].ravel() + 0.1, 0.5
    for used in (model, varied):
        mujoco.mj_forward(used, data)
        forces.append(data.actuator_force[env.index.actuator])
    strength = np.asarray(params.motor_strength)[:, None]
    assert 0.5 <= strength.min() < strength.max() <= 0.8 and np.abs(forces[0]).min() > 1.0
    np.testing.assert_allclose(forces[1], strength * forces[0], rtol=1e-5)


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
