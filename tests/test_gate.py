"""Narrow Gate on states made by hand; endings of every task."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mqe_jax.envs import TASKS, Moment, QuadrupedEnv, State
from tests.states import initial, made, moving, placed, robot_state, stepper, still


@pytest.fixture(scope="module")
def gate() -> QuadrupedEnv:
    return made("go1gate")


@pytest.fixture(scope="module")
def fresh(gate: QuadrupedEnv) -> State:
    return initial(gate)


@pytest.fixture(scope="module")
def gate_step(gate: QuadrupedEnv) -> Any:
    return stepper(gate.name)


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


# -- endings of every task: a fall, the time limit, and a collision in the tasks that end on one -----------------------


def ground_height(env: Any, x: float, y: float) -> float:
    """Height of the ground or object below (x, y), m."""
    model, data = env.compiled.model, mujoco.MjData(env.compiled.model)
    data.qpos[env.index.base_qpos[:, 2]] = 50.0
    mujoco.mj_kinematics(model, data)
    geom = np.zeros(1, np.int32)
    return 5.0 - mujoco.mj_ray(model, data, np.array([x, y, 5.0]), np.array([0, 0, -1.0]), None, 1, -1, geom)


@pytest.mark.parametrize("task", list(TASKS))
def test_endings(task: str) -> None:
    """From the spawn poses, at standing height."""
    env, step = made(task), stepper(task)
    pose = np.array(env.spawn_poses())
    height = [ground_height(env, x, y) + env.robot.stand_height + 0.01 for x, y, _ in pose]
    position, euler = np.c_[pose[:, :2], height], np.c_[np.zeros((len(pose), 2)), pose[:, 2]]

    after = step(placed(env, position, euler), still(env))
    assert not after.terminated and not after.truncated

    late = dataclasses.replace(placed(env, position, euler), step=jnp.int32(env.max_steps - 1))
    after = step(late, still(env))
    assert after.truncated and not after.terminated

    rolled, high = euler.copy(), position.copy()
    rolled[-1, 0], high[-1, 2] = env.params.max_roll + 0.1, high[-1, 2] + 0.5
    assert step(placed(env, high, rolled), still(env)).terminated
    rolled[-1, 0] = env.params.max_roll - 0.1
    assert not step(placed(env, high, rolled), still(env)).terminated

    # The first robot's trunk lies across the second's: they touch.
    if len(pose) > 1:
        touching, across = position.copy(), euler.copy()
        touching[0] = touching[1] + [0.0, 0.0, 0.09]
        across[0, 2] = pose[1, 2] + np.pi / 2
        bumped = step(placed(env, touching, across), still(env))
        assert bool(bumped.metrics["collision"])
        assert bool(bumped.terminated) == env.params.end_on_collision


@pytest.mark.parametrize(
    ("task", "time_limit", "end_on_collision"),
    [
        ("go1gate", 10, True),
        ("go1seesaw", 10, True),
        ("go1sheep-easy", 15, True),
        ("go1sheep-hard", 15, True),
        ("go1pushbox", 15, False),
        ("go1football-defender", 20, False),
        ("go1tug", 15, False),
        ("go1revolvingdoor", 5, False),
        ("go1wrestling", 15, False),
        ("go1bridge", 20, False),
        ("go1football-1vs1", 20, False),
        ("go1football-2vs2", 20, False),
    ],
)
def test_limits_are_those_of_the_paper(task: str, time_limit: float, end_on_collision: bool) -> None:
    params = made(task).params
    assert (params.episode_length, params.end_on_collision) == (time_limit, end_on_collision)
