"""The tasks' contract, and Narrow Gate's scene, observation, rewards and endings on states made by hand."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mqe_jax
from mqe_jax.engines import Engine
from mqe_jax.envs import TASKS, Moment, QuadrupedEnv, Randomization, State, VectorEnv, make, replay
from mqe_jax.envs.gate import GateParams
from mqe_jax.envs.observation import Block, ObservationLayout
from mqe_jax.errors import InputError
from tests.states import initial, made, moving, placed, robot_state

Array = jax.Array


QUICK = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}  # for a few steps


@pytest.fixture(scope="module")
def gate() -> QuadrupedEnv:
    return made("go1gate")


@pytest.fixture(scope="module")
def fresh(gate: QuadrupedEnv) -> State:
    return initial(gate)


@pytest.fixture(scope="module")
def gate_step(gate: QuadrupedEnv) -> Any:
    return jax.jit(gate.step)


@pytest.mark.parametrize(("count", "steps"), [(8, 200), pytest.param(32, 1000, marks=pytest.mark.soak)])
@pytest.mark.parametrize("task", list(TASKS))
def test_contract(task: str, count: int, steps: int) -> None:
    """Random steps: shapes, finite numbers, same key same result, one trace, clean auto-reset."""
    env = made(task)
    batch = VectorEnv(env, count)
    shape = (count, env.num_agents, env.action_size)
    traces = []

    @jax.jit
    def step(state: State, key: Array) -> tuple[State, Array]:
        traces.append(1)
        state = batch.step(state, jax.random.uniform(key, shape, minval=-1.0))
        shown = (state.obs, state.final_obs, state.privileged_obs, state.reward, *state.metrics.values())
        finite = [jnp.all(jnp.isfinite(leaf)) for leaf in (*shown, state.data.qpos, state.data.qvel)]
        return state, jnp.all(jnp.stack(finite))

    reset = jax.jit(batch.reset)
    keys = list(jax.random.split(jax.random.PRNGKey(1), steps))

    def play() -> State:
        state = reset(jax.random.PRNGKey(0))
        for key in keys[:10]:
            state, _ = step(state, key)
        return state

    state = play()
    jax.tree.map(np.testing.assert_array_equal, state, play())
    assert env.observation_size == sum(block.width for block in env.observation_layout.blocks)
    assert [agent for team in env.teams for agent in team] == list(range(env.num_agents))
    assert state.obs.shape == (count, env.num_agents, env.observation_size)
    assert state.privileged_obs.shape == (count, env.privileged_observation_size)
    assert env.observation_space.shape == state.obs.shape[1:]
    assert env.action_space.shape == (env.num_agents, env.action_size)
    assert state.reward.shape == (count, env.num_agents)

    # Every second environment is at its time limit: it is reset, and its last observation is kept.
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


# Observation sizes in the paper and the released system; one-hots of matches are within the team.
@pytest.mark.parametrize(
    ("task", "size"),
    [
        ("go1plane", 14),
        ("go1gate", 16),
        ("go1seesaw", 14),
        ("go1sheep-easy", 18),
        ("go1sheep-hard", 34),
        ("go1pushbox", 22),
        ("go1football-defender", 20),
        ("go1tug", 10),
        ("go1revolvingdoor", 12),
        ("go1wrestling", 12),
        ("go1bridge", 12),
        ("go1football-1vs1", 19),
        ("go1football-2vs2", 32),
    ],
)
def test_observation_sizes_are_those_of_the_paper(task: str, size: int) -> None:
    assert made(task).observation_size == size


# Compiling a scene for MJX-JAX takes half a minute. Other objects: tests/test_engines.py, on one scene.
@pytest.mark.parametrize(
    "task", [task if task == "go1gate" else pytest.param(task, marks=pytest.mark.soak) for task in TASKS]
)
def test_two_engines_step_alike(task: str) -> None:
    """MuJoCo's C engine and MJX-JAX step from the same states to the same observations and rewards.

    On MJX-JAX 20 further steps of random actions, with auto-reset, break nothing.
    """
    envs, starts = on_both_engines(task)
    actions = jax.random.uniform(jax.random.PRNGKey(4), (21, 2, envs[0].num_agents, 12), minval=-1.0)
    steps, after = [], []
    for env, start in zip(envs, starts, strict=True):
        lowered = jax.jit(VectorEnv(env, 2).step).lower(start, actions[0])
        steps.append(lowered.compile(compiler_options=QUICK))
        after.append(steps[-1](start, actions[0]))
    for name in ("obs", "privileged_obs", "reward"):
        expected, actual = (np.asarray(getattr(state, name)) for state in after)
        assert np.all(np.isfinite(actual))
        np.testing.assert_allclose(actual, expected, rtol=3e-3, atol=5e-3)
    np.testing.assert_array_equal(after[0].terminated, after[1].terminated)
    env, step, state = envs[1], steps[1], after[1]
    for action in actions[1:]:
        state = step(state, action)
        assert np.all(np.isfinite(state.obs)) and np.all(np.isfinite(state.reward))
        assert not np.asarray(state.metrics["diverged"]).any() and not np.asarray(state.metrics["overflow"]).any()
        assert np.asarray(state.data.qpos)[:, env.index.base_qpos[:, 2]].min() > 0.02


@pytest.mark.parametrize("task", TASKS)
def test_two_engines_return_the_same_shapes(task: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The task's code accepts the state of both; their physics, which takes seconds to trace, stands still."""
    monkeypatch.setattr(Engine, "step", lambda self, data, ctrl, **_: (data, jnp.zeros((), bool)))
    shapes = []
    for env in (made(task), make(task, impl="jax", control="position", num_envs=2)):
        batch, action = VectorEnv(env, 2), jnp.zeros((2, env.num_agents, 12))
        state = jax.eval_shape(lambda key, b=batch, a=action: b.step(b.reset(key), a), jax.random.PRNGKey(0))
        shapes.append(jax.tree.map(lambda x: x.shape, dataclasses.replace(state, data=None)))
    assert shapes[0] == shapes[1]


def on_both_engines(task: str) -> tuple[list[QuadrupedEnv], list[State]]:
    """The task on both engines, and the same two initial states on each."""
    envs = [make(task, impl=impl, control="position", num_envs=2) for impl in ("c", "jax")]
    state = jax.jit(jax.vmap(envs[0].reset))(jax.random.split(jax.random.PRNGKey(3), 2))
    parts = [getattr(state.data, name) for name in ("qpos", "qvel", "mocap_pos", "ctrl")]
    starts = [dataclasses.replace(state, data=jax.vmap(env.physics.init)(*parts)) for env in envs]
    return envs, starts


def test_gate_observation_is_what_the_paper_lists(gate: QuadrupedEnv, fresh: State) -> None:
    state = fresh
    both = robot_state([[1.0, 2.0, 0.3], [4.0, 5.0, 0.6]], yaw=(0.1, 0.2))
    state = dataclasses.replace(state, anchors=jnp.array([[3.4, 0.2]]))
    obs = gate.observation_layout.pack(gate.observe(state, both))
    first = [1, 0, 1, 2, 0.3, 0, 0, 0.1, 4, 5, 0.6, 0, 0, 0.2, 3.4, 0.2]
    second = [0, 1, 4, 5, 0.6, 0, 0, 0.2, 1, 2, 0.3, 0, 0, 0.1, 3.4, 0.2]
    np.testing.assert_allclose(obs, [first, second], atol=1e-6)


def test_gate_rewards_add_up_as_worked_out_by_hand(gate: QuadrupedEnv, fresh: State) -> None:
    state = fresh
    from mqe_jax.envs.reward import weigh

    before = robot_state([[3.5, 0.75, 0.3], [3.5, 0.35, 0.3]])
    # Targets are (5.5, 0.75) and (5.5, -0.75): the first is 2 m away, the second hypot(2, 1.1) m.
    state = dataclasses.replace(state, anchors=jnp.array([[3.5, 0.0]]))
    after = robot_state([[3.8, 0.78, 0.3], [3.5, 0.35, 0.3]])
    terms = gate.rewards(Moment(state, before), Moment(state, after), jnp.array(True))
    assert float(terms["success"]) == 1  # 0.3 m past the gate; the other stands in it
    assert float(terms["approach"]) == pytest.approx(2 - np.hypot(1.7, 0.03), abs=1e-5)
    # hypot(0.3, 0.43) = 0.524 m apart, which is not closer than 0.5 m
    assert float(terms["crowding"]) == 0
    reward, logged = weigh(terms, gate.params.rewards, 2)
    np.testing.assert_allclose(reward, [5 + 0.29974 - 2] * 2, atol=1e-4)
    close = robot_state([[3.6, 0.6, 0.3], [3.6, 0.4, 0.3]])
    near = gate.rewards(Moment(state, after), Moment(state, close), jnp.array(False))
    assert float(near["crowding"]) == pytest.approx(2 / 0.2**2, rel=1e-4)
    assert float(near["collision"]) == 0
    assert float(logged["average_step_reward"]) == pytest.approx(3.29974, abs=1e-4)


def test_gate_success_needs_both_through_and_no_failure(gate: QuadrupedEnv, fresh: State) -> None:
    state = dataclasses.replace(fresh, anchors=jnp.array([[3.5, 0.0]]))
    both, one = robot_state([[3.8, 0, 0.3], [4.5, 0, 0.3]]), robot_state([[3.8, 0, 0.3], [3.7, 0, 0.3]])
    fine = jnp.array(False)
    assert float(gate.outcome(state, both, fine)["success"]) == 1
    assert float(gate.outcome(state, both, ~fine)["success"]) == 0
    assert float(gate.outcome(state, one, fine)["success"]) == 0
    assert float(gate.outcome(state, one, fine)["success/one"]) == 1


def test_gate_endings(gate: QuadrupedEnv, gate_step: Any) -> None:
    """A fall, a trunk too low or too high, a collision and the time limit end an episode; standing does not."""
    state = jax.jit(gate.reset)(jax.random.PRNGKey(1))
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
    turned = [[0.0, 0.0, np.pi], [0.0, 0.0, 0.0]]  # the head against the back wall
    at_wall = placed(gate, [[0.33, -0.75, 0.31], [1.0, 0.75, 0.31]], turned, state=state)
    bumped = gate_step(moving(gate, at_wall, [-1.5, 0.0, 0.0]), still)
    assert bumped.terminated and float(bumped.metrics["reward/collision"]) == -2.0


def test_a_diverged_environment_ends_with_finite_numbers_and_is_counted(
    gate: QuadrupedEnv, fresh: State, gate_step: Any
) -> None:
    state = fresh
    broken = dataclasses.replace(state, data=state.data.replace(qvel=state.data.qvel.at[0].set(jnp.nan)))
    after = gate_step(broken, jnp.zeros((2, 12)))
    assert after.terminated and float(after.metrics["diverged"]) == 1
    assert np.all(np.asarray(after.reward) == 0) and np.isfinite(after.obs).all()
    bad = gate_step(state, jnp.full((2, 12), jnp.nan))
    assert bad.terminated and float(bad.metrics["diverged"]) == 1
    assert np.isfinite(np.asarray(bad.data.qpos)).all()


def test_assistance_freezes_one_agent_and_is_off_by_default(gate: QuadrupedEnv) -> None:
    reset = jax.jit(jax.vmap(gate.reset, (0, None)))
    keys = jax.random.split(jax.random.PRNGKey(0), 32)
    assert not np.asarray(reset(keys, 0.0).frozen_steps).any()
    assisted = reset(keys, 1.0)
    frozen = np.asarray(assisted.frozen_steps)
    assert np.all((frozen > 0).sum(1) <= 1) and (frozen[:, 0] > 0).any() and (frozen[:, 1] > 0).any()
    assert frozen.max() <= gate.params.frozen_time / gate.dt


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
    step = jax.jit(jax.vmap(env.step))
    for _ in range(60):
        states = step(states, jnp.zeros((16, 2, 12)))
    height = np.asarray(jax.vmap(env.read)(states.data).position_w)[..., 2].ravel()
    payload = np.asarray(params.payload).ravel()
    assert np.corrcoef(height, payload)[0, 1] < -0.5


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: make("go1gat"), r"task: unknown id 'go1gat' \(did you mean 'go1gate'\?\); allowed: go1plane, go1gate"),
        (lambda: make("go1gate", impl="mjx"), r"impl: unknown engine 'mjx'.*allowed: auto, warp, c, jax"),
        (lambda: make("go1gate", control="comand"), r"control: unknown mode 'comand' \(did you mean 'command'\?\)"),
        (lambda: make("go1gate", gate_widht=1.0), r"gate_widht: unknown name .*did you mean 'gate_width'"),
        (lambda: make("go1gate", rewards={"colision": 1.0}), r"rewards.colision.*did you mean 'collision'"),
        (lambda: make("go1gate", gate_width="wide"), r"gate_width: 'wide' is not allowed; it must be a valid number"),
        (lambda: make("go1gate", gate_width=-1), r"gate_width: -1 is not allowed; it must be greater than 0"),
        (lambda: make("go1gate", gate_width=4.0), r"gate_width: 4.0 .* less than the width of the track, 3.0"),
        (lambda: make("go1gate", gate_width=True), r"gate_width: True"),
        (lambda: make("go1gate", episode_length=float("inf")), r"episode_length: inf"),
        (lambda: make("go1gate", gate_random=(0.5, -0.1)), r"gate_random: \(0.5, -0.1\)|gate_random.*-0.1"),
        (lambda: make("go1gate", min_height=2.0), r"min_height: 2.0 .* less than max_height, 1.5"),
        (lambda: make("go1gate", randomization={"payload": (3, 1)}), r"randomization.payload: .*lowest"),
        (lambda: make("go1gate", randomization={"payload": (-9, 1)}), r"randomization.payload: .*mass of the trunk"),
        (lambda: make("go1gate", randomization={"friction": (0, 1)}), r"randomization.friction: .*greater than 0"),
        (lambda: make("go1gate", randomization={"action_lag": 1.5}), r"randomization.action_lag: 1.5 .*valid integer"),
        (lambda: make("go1seesaw", plank_start=-0.3), r"plank_start: -0.3 .*within \+-plank.limit"),
        (lambda: make("go1tug", cylinder={"radius": 0}), r"cylinder.radius: 0 .*greater than 0"),
        (lambda: make("go1revolvingdoor", gap=1.5), r"door.size: .*narrower than the gap, 1.5"),
        (lambda: make("go1bridge", platform_x=(3.0, 4.0)), r"platform_x: .*more than a platform's length"),
        (lambda: make("go1gate", num_agents=3), r"num_agents: 3; go1gate requires 2"),
        (lambda: make("go1gate", num_envs=0), r"num_envs: 0 must be at least 1"),
        (lambda: make("go1plane", gait="gallop"), r"gait: unknown name 'gallop'"),
        (lambda: make("go1plane", commands=("vx", "vz")), r"commands: unknown command 'vz'"),
        (lambda: make("go1plane", skill_weights="/nowhere"), r"walk policy: no file /nowhere"),
    ],
)
def test_bad_parameters_are_named(call: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        call()


def test_bad_actions_are_named(gate: QuadrupedEnv, fresh: State) -> None:
    state = fresh
    with pytest.raises(ValueError, match=r"action: shape \(2, 3\); expected \(2, 12\)"):
        gate.step(state, jnp.zeros((2, 3)))
    with pytest.raises(ValueError, match=r"action: dtype int32"):
        gate.step(state, jnp.zeros((2, 12), jnp.int32))
    with pytest.raises(ValueError, match=r"action: contains NaN"):
        gate.step(state, jnp.full((2, 12), jnp.nan))
    for count, allowed in ((0, "must be at least 1"), (1.5, "must be an integer")):
        with pytest.raises(InputError, match=f"num_envs: {count} {allowed}"):
            VectorEnv(gate, count)  # type: ignore[arg-type]
    for shape in ((2, 2, 12), (3, 12)):  # another number of environments, no axis of agents
        with pytest.raises(InputError, match=r"action: shape .*; expected \(3, 2, 12\) \(environments, agents"):
            VectorEnv(gate, 3).step(state, jnp.zeros(shape))


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
    assert set(mqe_jax.tasks()) == set(TASKS)
    assert type(make("go1bridgewrestling", impl="c", control="position")) is TASKS["go1wrestling"]


# -- actions, noise, layouts ------------------------------------------------------------------------------------------


def test_a_captured_constant_action_is_stepped_in_compiled_code(gate: QuadrupedEnv, fresh: State) -> None:
    state = fresh
    action = jnp.zeros((2, 12))
    after = jax.jit(lambda state: jax.lax.scan(lambda state, _: (gate.step(state, action), None), state, None, 2)[0])
    assert int(after(state).step) == 2


def test_observation_noise_spares_the_one_hots() -> None:
    env = make("go1gate", impl="c", control="position", randomization={"observation_noise": 0.1})
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 8))
    blocks = env.observation_layout.split(state.obs)
    np.testing.assert_array_equal(blocks["one_hot"], np.tile(np.eye(2), (8, 1, 1)))
    exact = jax.vmap(lambda state: env.observe(state, env.read(state.data))["gate"])(state)
    error = np.asarray(blocks["gate"] - exact)
    assert 0.05 < error.std() < 0.2


def test_every_one_hot_is_marked_as_categorical() -> None:
    for task in TASKS:
        layout = made(task).observation_layout
        assert [block.name for block in layout.blocks if block.categorical] == [
            name for name in layout.names if name == "one_hot"
        ]


def test_a_layout_slices_packs_and_splits() -> None:
    layout = ObservationLayout((Block("id", 1, categorical=True), Block("place", 2), Block("speed", 3)))
    values = {"id": jnp.ones((4, 1)), "place": jnp.full((4, 2), 2.0), "speed": jnp.full((4, 3), 3.0)}
    packed = layout.pack(values)
    assert packed.shape == (4, 6) and layout.slice("place") == slice(1, 3) and layout.slice("speed") == slice(3, 6)
    np.testing.assert_array_equal(packed[:, layout.slice("place")], values["place"])
    jax.tree.map(np.testing.assert_array_equal, layout.split(packed), values)
    np.testing.assert_array_equal(layout.continuous, [0, 1, 1, 1, 1, 1])
    with pytest.raises(KeyError, match="unknown name 'plaice'; allowed: id, place, speed"):
        layout.slice("plaice")


# -- privileged observation and randomised physics --------------------------------------------------------------------


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

    def fall(data: Any, fields: dict[str, Array]) -> Array:
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


@pytest.mark.parametrize(
    ("impl", "limit"),
    [("jax", {"contacts_per_robot": 2}), pytest.param("warp", {"constraints_per_robot": 8}, marks=pytest.mark.gpu)],
)
def test_a_step_that_drops_contacts_is_counted(impl: str, limit: dict[str, Any]) -> None:
    """A robot with all feet on the ground, in the air, and on the ground in the first physics step only."""
    env = make("go1plane", impl=impl, control="position", num_envs=3, num_agents=1, contacts="minimal", **limit)

    def start_at(key: Array, height: Array, speed: Array) -> Any:
        position = jnp.array([[1.0, 0.0, 0.0]]).at[0, 2].set(height)
        return moving(env, placed(env, position, state=env.reset(key)), [0.0, 0.0, speed])

    keys = jax.random.split(jax.random.PRNGKey(0), 3)
    start = jax.vmap(start_at)(keys, jnp.array([0.3, 1.3, 0.3]), jnp.array([0.0, 0.0, 3.0]))
    step = jax.jit(jax.vmap(env.step)).lower(start, jnp.zeros((3, 1, 12))).compile(compiler_options=QUICK)
    after = step(start, jnp.zeros((3, 1, 12)))
    assert after.metrics["overflow"].tolist() == [1.0, 0.0, 1.0]
    lifted = after.data.qpos.at[:, env.index.base_qpos[0, 2]].add(1.0)
    after = step(dataclasses.replace(after, data=after.data.replace(qpos=lifted)), jnp.zeros((3, 1, 12)))
    assert after.metrics["overflow"].tolist() == [0.0, 0.0, 0.0]  # of this step, not of one before


def test_a_physics_step_that_does_not_fit_the_walk_policy_is_refused() -> None:
    class Fast(TASKS["go1plane"]):
        def scene(self) -> Any:
            return dataclasses.replace(super().scene(), timestep=0.004)

    with pytest.raises(InputError, match=r"Scene.timestep: 0.004 s x 4 substeps is 0.016 s; .* 0.02 s"):
        Fast(impl="c")
    assert Fast(impl="c", control="position").dt == pytest.approx(0.016)


# -- recordings -------------------------------------------------------------------------------------------------------


def test_a_divergence_is_recorded_and_replayed(tmp_path: Any) -> None:
    """A robot with a huge velocity diverges, and again from the file, which holds the last episode only."""
    env = made("go1plane")
    actions = jax.random.uniform(jax.random.PRNGKey(0), (60, 2, 12), minval=-1.0)
    late = dataclasses.replace(jax.jit(env.reset)(jax.random.PRNGKey(1)), step=jnp.int32(env.max_steps - 2))
    before = replay.trajectory(env, late, actions)
    assert np.asarray(before.step[:4]).tolist() == [498, 499, 0, 1]
    index, data = env.index, before.data
    data = data.replace(
        qpos=data.qpos.at[2, index.base_qpos[0, 2]].set(50.0), qvel=data.qvel.at[2, index.base_qvel[0, 0]].set(990.0)
    )
    thrown = jax.tree.map(lambda leaf: leaf[2], dataclasses.replace(before, data=data))
    after = replay.trajectory(env, thrown, actions[2:])
    end = int(np.flatnonzero(np.asarray(after.metrics["diverged"]))[0])  # metrics belong to the step before
    assert end > 10
    states = jax.tree.map(lambda first, rest: jnp.concatenate([first[:2], rest[:end]]), before, after)

    file = tmp_path / "diverged.npz"
    replay.save_recording(file, env, states, actions[: 2 + end])
    recording = replay.load_recording(file)
    assert recording.task == "go1plane" and recording.states["step"].tolist() == list(range(end))
    again = replay.replay(recording)
    assert np.asarray(again.metrics["diverged"]).tolist() == [0.0] * (end - 1) + [1.0]
    np.testing.assert_array_equal(again.data.qpos[:-1], after.data.qpos[1:end])
    assert [path.name for path in tmp_path.iterdir()] == ["diverged.npz"]


def test_bad_recordings_are_named(gate: QuadrupedEnv, fresh: State, tmp_path: Any) -> None:
    with pytest.raises(InputError, match=r"none.npz: cannot be read as a recording"):
        replay.load_recording(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("nothing")
    with pytest.raises(InputError, match=r"text.npz: cannot be read as a recording"):
        replay.load_recording(tmp_path / "text.npz")
    states = replay.trajectory(gate, fresh, jnp.zeros((2, 2, 12)))
    replay.save_recording(tmp_path / "gate.npz", gate, states, jnp.zeros((2, 2, 12)))
    recording = replay.load_recording(tmp_path / "gate.npz")
    with pytest.raises(InputError, match=r"recording of go1gate: anchors has shape \(1, 2\); expected shape \(0, 2\)"):
        replay.replay(recording, made("go1seesaw"))


def test_parameters_are_made_by_keyword() -> None:
    assert GateParams(gate_width=0.7).gate_width == 0.7
    with pytest.raises(InputError, match="gate_width: 0 is not allowed"):
        GateParams(gate_width=0)
    env = make("go1gate", impl="c", control="position", gate_width=np.float32(0.5), solver_iterations=np.int64(2))
    assert env.params.gate_width == 0.5 and env.params.solver_iterations == 2
