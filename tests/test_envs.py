"""The tasks' contract, and Narrow Gate's scene, observation, rewards and endings on states made by hand."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mqe_jax
from mqe_jax.envs import TASKS, QuadrupedEnv, State, VectorEnv, make
from tests.states import placed, robot_state

Array = jax.Array


@pytest.fixture(scope="module")
def gate() -> QuadrupedEnv:
    return make("go1gate", impl="c", control="position")


@pytest.fixture(scope="module")
def gate_step(gate: QuadrupedEnv) -> Any:
    return jax.jit(gate.step)


# Observation sizes of the paper's tasks (SPEC of the released system); one-hots of matches are within the team.
OBSERVATION = {
    "go1plane": 14, "go1gate": 16, "go1seesaw": 14, "go1sheep-easy": 18, "go1sheep-hard": 34, "go1pushbox": 22,
    "go1football-defender": 20, "go1tug": 10, "go1revolvingdoor": 12, "go1wrestling": 12, "go1bridge": 12,
    "go1football-1vs1": 19, "go1football-2vs2": 32,
}  # fmt: skip


@pytest.mark.parametrize("task", list(TASKS))
def test_contract(task: str) -> None:
    """Random steps: shapes, finite numbers, same key same result, one trace, clean auto-reset.

    8 worlds and 200 steps, or with MQE_SOAK=1 32 worlds and 1000 steps.
    """
    count, steps = (32, 1000) if os.environ.get("MQE_SOAK") else (8, 200)
    env = make(task, impl="c", control="position")
    worlds = VectorEnv(env, count)
    shape = (count, env.num_agents, env.action_size)
    traces = []

    @jax.jit
    def step(state: State, key: Array) -> tuple[State, Array]:
        traces.append(1)
        state = worlds.step(state, jax.random.uniform(key, shape, minval=-1.0))
        shown = (state.obs, state.final_obs, state.privileged_obs, state.reward, *state.metrics.values())
        finite = [jnp.all(jnp.isfinite(leaf)) for leaf in (*shown, state.data.qpos, state.data.qvel)]
        return state, jnp.all(jnp.stack(finite))

    reset = jax.jit(worlds.reset)
    keys = list(jax.random.split(jax.random.PRNGKey(1), steps))

    def play() -> State:
        state = reset(jax.random.PRNGKey(0))
        for key in keys[:10]:
            state, _ = step(state, key)
        return state

    state = play()
    jax.tree.map(np.testing.assert_array_equal, state, play())
    assert env.observation_size == OBSERVATION[task]
    assert [agent for team in env.teams for agent in team] == list(range(env.num_agents))
    assert state.obs.shape == (count, env.num_agents, env.observation_size)
    assert state.privileged_obs.shape == (count, env.privileged_observation_size)
    assert env.observation_space.shape == state.obs.shape[1:]
    assert env.action_space.shape == (env.num_agents, env.action_size)
    assert state.reward.shape == (count, env.num_agents)

    # Every other world is at its time limit: it starts over, and its last observation is kept.
    late = jnp.where(jnp.arange(count) % 2 == 0, env.max_steps - 1, state.step)
    state, _ = step(dataclasses.replace(state, step=late), keys[10])
    ended = np.asarray(state.terminated | state.truncated)
    assert ended[::2].all() and not ended.all()
    np.testing.assert_array_equal(np.asarray(state.step) == 0, ended)
    assert np.all(np.abs(np.asarray(state.obs - state.final_obs)).max((1, 2))[ended] > 0)
    np.testing.assert_array_equal(np.asarray(state.obs)[~ended], np.asarray(state.final_obs)[~ended])
    spawned = np.asarray(state.data.qpos)[ended][:, env.index.base_qpos[:, 2]]
    np.testing.assert_allclose(spawned, env.params.spawn_height, atol=1e-6)

    fine, diverged = [], []
    for key in keys[11:]:
        state, finite = step(state, key)
        fine.append(finite)
        diverged.append(state.metrics["diverged"])
    assert np.all(np.asarray(fine)) and not np.asarray(diverged).any()
    assert len(traces) == 1


# Scenes that between them have every kind of object: compiled for MJX-JAX, which takes half a minute each. The others
# are only traced, unless MQE_SOAK=1.
COMPILED = ("go1seesaw", "go1sheep-easy", "go1pushbox", "go1tug", "go1revolvingdoor", "go1bridge", "go1football-1vs1")


@pytest.mark.parametrize("task", list(TASKS))
def test_two_engines_step_alike(task: str) -> None:
    """Fresh worlds under jit and vmap: MuJoCo's C engine and MJX-JAX lead to the same observations and rewards."""
    envs = [make(task, impl=impl, control="position", num_envs=2) for impl in ("c", "jax")]
    state = jax.jit(jax.vmap(envs[0].reset))(jax.random.split(jax.random.PRNGKey(3), 2))
    action = jax.random.uniform(jax.random.PRNGKey(4), (2, envs[0].num_agents, 12), minval=-1.0)
    parts = [getattr(state.data, name) for name in ("qpos", "qvel", "mocap_pos", "ctrl")]
    starts = [dataclasses.replace(state, data=jax.vmap(env.physics.init)(*parts)) for env in envs]
    first, second = (jax.jit(jax.vmap(env.step)).lower(start, action) for env, start in zip(envs, starts, strict=True))
    shapes = [jax.tree.map(lambda x: x.shape, dataclasses.replace(low.out_info, data=None)) for low in (first, second)]
    assert shapes[0] == shapes[1]
    if task not in COMPILED and not os.environ.get("MQE_SOAK"):
        return
    quick = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}  # for a single step
    after = [
        low.compile(compiler_options=quick)(start, action) for low, start in zip((first, second), starts, strict=True)
    ]
    for name in ("obs", "privileged_obs", "reward"):
        expected, actual = (np.asarray(getattr(state, name)) for state in after)
        assert np.all(np.isfinite(actual))
        np.testing.assert_allclose(actual, expected, atol=5e-3)
    np.testing.assert_array_equal(after[0].terminated, after[1].terminated)


def test_gate_observation_is_what_the_paper_lists(gate: QuadrupedEnv) -> None:
    state = gate.reset(jax.random.PRNGKey(0))
    both = robot_state([[1.0, 2.0, 0.3], [4.0, 5.0, 0.6]], yaw=(0.1, 0.2))
    state = dataclasses.replace(state, anchors=jnp.array([[3.4, 0.2]]))
    obs = gate.observation_layout.pack(gate.observe(state, both))
    first = [1, 0, 1, 2, 0.3, 0, 0, 0.1, 4, 5, 0.6, 0, 0, 0.2, 3.4, 0.2]
    second = [0, 1, 4, 5, 0.6, 0, 0, 0.2, 1, 2, 0.3, 0, 0, 0.1, 3.4, 0.2]
    np.testing.assert_allclose(obs, [first, second], atol=1e-6)


def test_gate_rewards_add_up_as_worked_out_by_hand(gate: QuadrupedEnv) -> None:
    from mqe_jax.envs.reward import weigh

    state = gate.reset(jax.random.PRNGKey(0))
    before = robot_state([[3.5, 0.75, 0.3], [3.5, 0.35, 0.3]])
    # Targets are (5.5, 0.75) and (5.5, -0.75): the first is 2 m away, the second hypot(2, 1.1) m.
    task = gate.reset_task(jax.random.PRNGKey(0), before, state.data, state.anchors)
    state = dataclasses.replace(state, anchors=jnp.array([[3.5, 0.0]]), task=task)
    after = robot_state([[3.8, 0.78, 0.3], [3.5, 0.35, 0.3]])
    terms, _ = gate.rewards(state, after, jnp.array(True))
    assert float(terms["success"]) == 1  # 0.3 m past the gate; the other stands in it
    assert float(terms["approach"]) == pytest.approx(2 - np.hypot(1.7, 0.03), abs=1e-5)
    # hypot(0.3, 0.43) = 0.524 m apart, which is not closer than 0.5 m
    assert float(terms["crowding"]) == 0
    reward, logged = weigh(terms, gate.params.rewards, 2)
    np.testing.assert_allclose(reward, [5 + 0.29974 - 2] * 2, atol=1e-4)
    near, _ = gate.rewards(state, robot_state([[3.6, 0.6, 0.3], [3.6, 0.4, 0.3]]), jnp.array(False))
    assert float(near["crowding"]) == pytest.approx(2 / 0.2**2, rel=1e-4)
    assert float(near["collision"]) == 0
    assert float(logged["average_step_reward"]) == pytest.approx(3.29974, abs=1e-4)


def test_gate_success_needs_both_through_and_no_failure(gate: QuadrupedEnv) -> None:
    state = dataclasses.replace(gate.reset(jax.random.PRNGKey(0)), anchors=jnp.array([[3.5, 0.0]]))
    both, one = robot_state([[3.8, 0, 0.3], [4.5, 0, 0.3]]), robot_state([[3.8, 0, 0.3], [3.7, 0, 0.3]])
    fine = jnp.array(False)
    assert float(gate.outcome(state, both, fine)["success"]) == 1
    assert float(gate.outcome(state, both, ~fine)["success"]) == 0
    assert float(gate.outcome(state, one, fine)["success"]) == 0
    assert float(gate.outcome(state, one, fine)["success/one"]) == 1


def test_gate_endings(gate: QuadrupedEnv, gate_step: Any) -> None:
    """A fall, a trunk too low or too high, a collision and the time limit end an episode; standing does not."""
    state = gate.reset(jax.random.PRNGKey(1))
    still = jnp.zeros((2, 12))
    stand = placed(gate, [[1.0, -0.75, 0.31], [1.0, 0.75, 0.31]], state=state)
    after = gate_step(stand, still)
    assert not after.terminated and not after.truncated
    late = gate_step(dataclasses.replace(stand, step=jnp.int32(gate.max_steps - 1)), still)
    assert late.truncated and not late.terminated
    rolled = [[0.9, 0.0, 0.0], [0.0, 0.0, 0.0]]
    assert gate_step(placed(gate, [[1.0, -0.75, 0.9], [1.0, 0.75, 0.31]], rolled, state=state), still).terminated
    pitched = [[0.0, 1.2, 0.0], [0.0, 0.0, 0.0]]
    assert not gate_step(placed(gate, [[1.0, -0.75, 0.9], [1.0, 0.75, 0.31]], pitched, state=state), still).terminated
    assert gate_step(placed(gate, [[1.0, -0.75, 1.6], [1.0, 0.75, 0.31]], state=state), still).terminated
    fallen = gate.fallen(robot_state([[1.0, 0.0, 0.07], [1.0, 1.0, 0.3]]))
    assert fallen.tolist() == [True, False]
    bumped = gate_step(placed(gate, [[0.16, -0.75, 0.31], [1.0, 0.75, 0.31]], state=state), still)
    assert bumped.terminated and float(bumped.metrics["reward/collision"]) == -2.0


def test_diverged_world_ends_with_finite_numbers_and_is_counted(gate: QuadrupedEnv, gate_step: Any) -> None:
    state = gate.reset(jax.random.PRNGKey(0))
    broken = dataclasses.replace(state, data=state.data.replace(qvel=state.data.qvel.at[0].set(jnp.nan)))
    after = gate_step(broken, jnp.zeros((2, 12)))
    assert after.terminated and float(after.metrics["diverged"]) == 1
    assert np.all(np.asarray(after.reward) == 0) and np.isfinite(after.obs).all()
    bad = gate_step(state, jnp.full((2, 12), jnp.nan))
    assert bad.terminated and float(bad.metrics["diverged"]) == 1
    assert np.isfinite(np.asarray(bad.data.qpos)).all()


def test_aid_holds_one_agent_and_is_off_by_default(gate: QuadrupedEnv) -> None:
    plain = jax.vmap(gate.reset)(jax.random.split(jax.random.PRNGKey(0), 32))
    assert not np.asarray(plain.frozen_steps).any()
    aided = jax.vmap(lambda key: gate.reset(key, 1.0))(jax.random.split(jax.random.PRNGKey(0), 32))
    hold = np.asarray(aided.frozen_steps)
    assert np.all((hold > 0).sum(1) <= 1) and (hold[:, 0] > 0).any() and (hold[:, 1] > 0).any()
    assert frozen_steps.max() <= gate.params.frozen_time / gate.dt


def test_randomisation_reaches_the_physics() -> None:
    """Each world's friction, payload, motors, pushes and lag differ, and a heavier trunk sags more."""
    env = make(
        "go1plane", impl="c", control="position", spawn_velocity=0.0, spawn_joint_scale=(1.0, 1.0), spawn_height=0.31,
        randomization={
            "friction": (0.5, 1.25), "payload": (0.0, 6.0), "center_of_mass": (-0.02, 0.02),
            "motor_strength": (0.9, 1.1), "action_lag": 2, "push": 0.3, "observation_noise": 0.01,
        },
    )  # fmt: skip
    states = jax.vmap(env.reset)(jax.random.split(jax.random.PRNGKey(0), 16))
    world = states.world
    assert np.ptp(np.asarray(world.friction)) > 0.3 and set(np.asarray(world.action_lag).tolist()) == {0, 1, 2}
    step = jax.jit(jax.vmap(env.step))
    for _ in range(60):
        states = step(states, jnp.zeros((16, 2, 12)))
    height = np.asarray(jax.vmap(env.read)(states.data).position_w)[..., 2].ravel()
    payload = np.asarray(world.payload).ravel()
    assert np.corrcoef(height, payload)[0, 1] < -0.5


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: make("go1gat"), r"task: unknown id 'go1gat' \(did you mean 'go1gate'\?\); allowed: go1plane, go1gate"),
        (lambda: make("go1gate", impl="mjx"), r"impl: unknown engine 'mjx'.*allowed: auto, jax, warp, c"),
        (lambda: make("go1gate", control="comand"), r"control: unknown mode 'comand' \(did you mean 'command'\?\)"),
        (lambda: make("go1gate", gate_widht=1.0), r"gate_widht: unknown parameter \(did you mean 'gate_width'\?\)"),
        (lambda: make("go1gate", rewards={"colision": 1.0}), r"rewards.colision.*did you mean 'collision'"),
        (lambda: make("go1gate", gate_width="wide"), r"gate_width: 'wide' is not a number"),
        (lambda: make("go1gate", gate_width=4.0), r"gate: width 4.0 must be between 0 and"),
        (lambda: make("go1gate", num_agents=3), r"num_agents: 3; go1gate is for 2"),
        (lambda: make("go1gate", num_envs=0), r"num_envs: 0 must be at least 1"),
        (lambda: make("go1plane", gait="gallop"), r"gait: unknown name 'gallop'"),
        (lambda: make("go1plane", commands=("vx", "vz")), r"commands: unknown command 'vz'"),
        (lambda: make("go1plane", walk_policy="/nowhere"), r"walk policy: no file /nowhere"),
    ],
)
def test_bad_parameters_are_named(call: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()


def test_bad_actions_are_named(gate: QuadrupedEnv) -> None:
    state = gate.reset(jax.random.PRNGKey(0))
    with pytest.raises(ValueError, match=r"action: shape \(2, 3\); expected \(2, 12\)"):
        gate.step(state, jnp.zeros((2, 3)))
    with pytest.raises(ValueError, match=r"action: dtype int32"):
        gate.step(state, jnp.zeros((2, 12), jnp.int32))
    with pytest.raises(ValueError, match=r"action: holds NaN"):
        gate.step(state, jnp.full((2, 12), jnp.nan))
    with pytest.raises(ValueError, match="num_envs: 0"):
        VectorEnv(gate, 0)


def test_overrides_reach_every_level() -> None:
    env = make("go1gate", impl="c", control="torque", gate_width=0.8, **{"rewards.collision": -5})
    assert env.params.gate_width == 0.8 and env.params.rewards.collision == -5.0
    assert env.action_size == 12 and float(env.compiled.model.actuator_gainprm[0, 0]) == 1.0


def test_making_and_stepping_imports_no_foreign_learning_library() -> None:
    code = (
        "import sys, jax, mqe_jax, mqe_jax.train.runner, mqe_jax.walk.training\n"
        "env = mqe_jax.make('go1plane', impl='c', control='position')\n"
        "env.reset(jax.random.PRNGKey(0))\n"
        "print([m for m in ('flax', 'optax', 'brax', 'torch') if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.strip().splitlines()[-1] == "[]"
    assert mqe_jax.tasks() == (
        "go1plane", "go1gate", "go1seesaw", "go1sheep-easy", "go1sheep-hard", "go1pushbox", "go1football-defender",
        "go1tug", "go1revolvingdoor", "go1wrestling", "go1bridge", "go1football-1vs1", "go1football-2vs2",
    )  # fmt: skip
    assert type(make("go1bridgewrestling", impl="c", control="position")) is TASKS["go1wrestling"]
