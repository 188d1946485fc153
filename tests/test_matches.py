"""The matches: mirrored views, zero-sum rewards, results and endings on states made by hand."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax.envs import TASKS, QuadrupedEnv, make
from mqe_jax.envs.match import Match
from tests.states import initial, made, observation, placed, stepper, still, terms_of

MATCHES = [name for name, task in TASKS.items() if issubclass(task, Match)]
PI = np.pi


def stepped(env: QuadrupedEnv, state: Any) -> Any:
    return stepper(env.name)(state, still(env))


def result(env: Any, state: Any) -> tuple[float, float]:
    """Wins of both teams, as if the episode ended now."""
    out = env.result(state, env.read(state.data), jnp.array(False))
    assert out.result.sum(axis=1).tolist() == [1, 1]
    assert out.win.tolist() == out.loss[::-1].tolist() == out.success.tolist()
    return float(out.win[0]), float(out.win[1])


@pytest.mark.parametrize("task", MATCHES)
def test_teams_and_zero_sum(task: str) -> None:
    env = made(task)
    half = env.num_agents // 2
    assert env.teams == (tuple(range(half)), tuple(range(half, 2 * half)))
    state = initial(env)
    for seed in range(3):
        action = jax.random.uniform(jax.random.PRNGKey(seed), (env.num_agents, 12), minval=-1.0)
        state = stepper(task)(state, action)
        assert float(jnp.sum(state.reward)) == pytest.approx(0.0, abs=1e-5)
        assert np.abs(np.asarray(state.reward)).max() < 1


@pytest.mark.parametrize("task", MATCHES)
def test_both_sides_observe_the_same_of_a_mirrored_state(task: str) -> None:
    env = made(task)
    random = np.random.default_rng(0)
    agents = env.num_agents
    position = random.uniform([1, -2, 0.3], [4, 2, 0.5], (agents, 3))
    euler = random.uniform(-0.5, 0.5, (agents, 3)) + np.array([0, 0, 1.0])
    middle = np.array([*env.center, 0.0])
    if env.symmetry == "turn":
        other = 2 * middle - position
        turned = euler + np.array([0, 0, PI])
        other[:, 2] = position[:, 2]
    else:
        other = position * [1, -1, 1]
        turned = euler * [-1, 1, -1]
    swap = np.roll(np.arange(agents), agents // 2)
    there = {}
    here = {}
    if "cylinder" in env.objects:
        there = {"cylinder": [0.3]}
        here = {"cylinder": [-0.3]}
    if "ball" in env.objects:
        there = {"ball": [6.0, 1.0, 0.1, 1, 0, 0, 0]}
        here = {"ball": [8.0, -1.0, 0.1, 1, 0, 0, 0]}
    first = placed(env, position, euler, there)
    second = placed(env, other[swap], turned[swap], here)
    if "cylinder" in env.objects:
        first = dataclasses.replace(
            first, task=dataclasses.replace(first.task, previous_y=jnp.float32(0.2))
        )
        second = dataclasses.replace(
            second, task=dataclasses.replace(second.task, previous_y=jnp.float32(-0.2))
        )
    np.testing.assert_allclose(observation(env, first), observation(env, second)[swap], atol=1e-5)
    assert np.abs(observation(env, first) - observation(env, second)).max() > 0.1


def test_actions_are_mirrored_where_left_and_right_are_swapped() -> None:
    command = TASKS["go1revolvingdoor"](impl="c")
    action = jnp.array([[0.1, 0.2, 0.3]] * 2)
    np.testing.assert_allclose(
        command.unmirror_action(action), action * np.array([[1, 1, 1], [1, -1, -1]])
    )
    env = made("go1revolvingdoor")
    legs = jnp.arange(12.0)[None] / 12
    mirrored = 12 * np.asarray(env.unmirror_action(jnp.tile(legs, (2, 1))))
    np.testing.assert_allclose(mirrored[0], np.arange(12))
    np.testing.assert_allclose(mirrored[1], [-3, 4, 5, -0, 1, 2, -9, 10, 11, -6, 7, 8], atol=1e-5)
    turned = made("go1tug")
    np.testing.assert_allclose(turned.unmirror_action(jnp.tile(legs, (2, 1)))[1], legs[0])


def tug_state(env: Any, y: float, ends: tuple[float, float] = (-1.3, 1.63)) -> Any:
    """Robot 0 is 1.43 m and robot 1 1.5 m from the axis when the cylinder is at 0.13."""
    position = [[1.6, end, 0.3] for end in ends]
    state = placed(env, position, [[0, 0, PI / 2], [0, 0, -PI / 2]], {"cylinder": [y]})
    return dataclasses.replace(
        state, task=dataclasses.replace(state.task, previous_y=jnp.float32(0.08))
    )


def test_tug_observation_and_rewards() -> None:
    env = made("go1tug")
    state = tug_state(env, 0.13)
    obs = observation(env, state)
    np.testing.assert_allclose(
        obs[0], [1.6, -1.3, 0.3, 0, 0, PI / 2, 0.13, 0, 1.43, 0.08], atol=1e-5
    )
    np.testing.assert_allclose(
        obs[1], [1.6, -1.63, 0.3, 0, 0, PI / 2, -0.13, 0, 1.5, -0.08], atol=1e-5
    )
    before = tug_state(env, 0.1, ends=(-1.4, 1.5))
    terms, reward = terms_of(env, before, state)
    # Own terms: the cylinder is 0.13 m on robot 1's half, and moved on; robot 0 came 0.07 m closer
    # to it, robot 1 got 0.1 m away. Less the opponent's: 0.13 m and 0.17 m.
    np.testing.assert_allclose(terms["push"], [0.13, -0.13], atol=1e-6)
    np.testing.assert_allclose(terms["approach"], [0.17, -0.17], atol=1e-6)
    np.testing.assert_allclose(reward, [10 * 0.13 + 2 * 0.17, -10 * 0.13 - 2 * 0.17], atol=1e-5)
    # From y 0.1 back to 0.06, still on robot 1's half: that counts half. On robot 0's half: it
    # counts for robot 1.
    np.testing.assert_allclose(
        terms_of(env, before, tug_state(env, 0.06))[0]["push"], [0.03, -0.03], atol=1e-6
    )
    np.testing.assert_allclose(
        terms_of(env, before, tug_state(env, -0.2))[0]["push"], [-0.2, 0.2], atol=1e-6
    )
    # At rest it counts whole, on either half.
    for y in (0.1, -0.1):
        rest = tug_state(env, y)
        np.testing.assert_allclose(terms_of(env, rest, rest)[0]["push"], [y, -y], atol=1e-6)


def test_tug_result_and_end() -> None:
    env = made("go1tug")
    assert result(env, tug_state(env, 0.13)) == (1, 0)
    assert result(env, tug_state(env, -0.13)) == (0, 1)
    assert result(env, tug_state(env, 0.05)) == (0, 0)
    state = tug_state(env, 0.0)
    assert not stepped(env, state).terminated
    assert stepped(env, dataclasses.replace(state, step=jnp.int32(env.max_steps - 1))).truncated
    fallen = placed(
        env, [[1.6, -2, 0.3], [1.6, 2, 0.3]], [[0.9, 0, 0], [0, 0, 0]], {"cylinder": [0.13]}
    )
    assert stepped(env, fallen).terminated
    assert result(env, fallen) == (0, 1)  # a fall loses, also with the cylinder on the other half
    both = placed(
        env, [[1.6, -2, 0.3], [1.6, 2, 0.3]], [[0.9, 0, 0], [0.9, 0, 0]], {"cylinder": [0.13]}
    )
    assert result(env, both) == (0, 0)


def test_the_arena_moves_the_middle_and_spawn_noise_counts() -> None:
    env: Any = make("go1tug", impl="c", control="position", cylinder={"x": 2.1}, spawn_noise=0.05)
    assert env.center == (2.1, 0.0)
    spawn = np.asarray(jax.jit(jax.vmap(env.spawn))(jax.random.split(jax.random.PRNGKey(0), 64)))
    assert (
        np.abs(spawn[..., 0] - 2.1).max() <= 1.05
        and 0.04 < np.abs(np.abs(spawn[..., 1]) - 2.5).max() <= 0.05
    )


def test_a_diverged_match_is_a_draw() -> None:
    env = made("go1wrestling")
    state = initial(env)
    state = dataclasses.replace(
        state, data=state.data.replace(qvel=jnp.full_like(state.data.qvel, jnp.nan))
    )
    after = stepped(env, state)
    assert after.terminated and float(after.metrics["diverged"]) == 1
    assert after.outcome.result.tolist() == [[0, 1, 0]] * 2


@pytest.mark.parametrize("task", ["go1revolvingdoor", "go1wrestling", "go1bridge"])
def test_a_duel_is_seen_by_both_in_their_own_frames(task: str) -> None:
    env = made(task)
    obs = observation(
        env, placed(env, [[1.0, -0.5, 0.3], [2.0, 0.7, 0.4]], [[0.1, 0.2, 0.3], [0, 0, -1.0]])
    )
    first = [1.0, -0.5, 0.3, 0.1, 0.2, 0.3]
    second = [2.0, 0.7, 0.4, 0, 0, -1.0]
    x = 2 * env.center[0]
    mirrored = {
        "reflect": ([2.0, -0.7, 0.4, 0, 0, 1.0], [1.0, 0.5, 0.3, -0.1, 0.2, -0.3]),
        "turn": ([x - 2.0, -0.7, 0.4, 0, 0, PI - 1.0], [x - 1.0, 0.5, 0.3, 0.1, 0.2, 0.3 - PI]),
    }[env.symmetry]
    np.testing.assert_allclose(obs[0], [*first, *second], atol=1e-5)
    np.testing.assert_allclose(obs[1], [*mirrored[0], *mirrored[1]], atol=1e-5)


def test_door_rewards_result_and_end() -> None:
    env = made("go1revolvingdoor")
    state = placed(env, [[3.9, 0.0, 0.3], [3.0, 0.5, 0.3]])
    # 0.08 m and 1 m from the line's middle
    before = placed(env, [[3.93, 0.0, 0.3], [2.85, 0.0, 0.3]])
    terms, reward = terms_of(env, before, state)
    np.testing.assert_allclose(terms["win"], [1, -1])
    # Robot 0 is 0.05 m from the line's middle, robot 1 hypot(0.85, 0.5) = 0.98615 m: 0.03 m and
    # 0.01385 m closer.
    np.testing.assert_allclose(terms["approach"], [0.01615, -0.01615], atol=1e-4)
    np.testing.assert_allclose(reward, [10.01615, -10.01615], atol=1e-4)
    assert result(env, state) == (1, 0) and stepped(env, state).terminated
    assert result(env, placed(env, [[3.0, 0.0, 0.3], [3.9, 0.5, 0.3]])) == (0, 1)
    assert result(env, placed(env, [[3.9, 0.0, 0.3], [3.9, 0.5, 0.3]])) == (0, 0)
    fallen = placed(env, [[3.0, 0.0, 0.3], [3.0, 0.5, 0.3]], [[0, 0, 0], [0.9, 0, 0]])
    assert result(env, fallen) == (1, 0)
    np.testing.assert_allclose(terms_of(env, fallen, fallen)[0]["win"], [1, -1])
    both = placed(env, [[0.6, -1.0, 0.3], [0.6, 1.0, 0.3]])
    assert not stepped(env, both).terminated
    assert env.max_steps == 250


def ring(env: Any, first: Any, second: Any, roll: float = 0.0) -> Any:
    return placed(env, [first, second], [[0, 0, PI / 2], [roll, 0, -PI / 2]])


def test_wrestling_rewards_result_and_end() -> None:
    env = made("go1wrestling")
    inside = [3.1, -0.5, 0.7]
    out = [3.1, 1.75, 0.7]
    play = ring(env, inside, [3.1, 0.6, 0.7])
    assert result(env, play) == (0, 0) and not stepped(env, play).terminated
    np.testing.assert_allclose(terms_of(env, play, play)[1], [0, 0])
    won = ring(env, inside, out)
    assert result(env, won) == (1, 0) and stepped(env, won).terminated
    np.testing.assert_allclose(terms_of(env, won, won)[1], [10, -10])
    np.testing.assert_allclose(
        terms_of(env, play, ring(env, [1.3, 0.0, 0.7], [3.1, 0.6, 0.7]))[1], [-10, 10]
    )
    assert result(env, ring(env, [3.1, -1.75, 0.7], out)) == (0, 0)
    assert result(env, ring(env, inside, [3.1, 0.6, 0.7], roll=1.26)) == (1, 0)  # over 0.4 pi
    assert result(env, ring(env, inside, [3.1, 0.6, 0.7], roll=1.25)) == (0, 0)
    assert result(env, ring(env, inside, [3.1, 0.6, 0.15])) == (1, 0)


def test_wrestling_has_terms_for_pushing_and_approach_that_only_training_weighs() -> None:
    env = made("go1wrestling")
    before = ring(env, [3.1, -0.5, 0.7], [3.1, 0.6, 0.7])
    after = ring(env, [3.1, 0.1, 0.7], [3.1, 1.0, 0.7])
    terms, reward = terms_of(env, before, after)
    np.testing.assert_allclose(reward, [0, 0])
    # The first robot came 0.4 m nearer to the centre and pushed the other 0.4 m away from it.
    np.testing.assert_allclose(terms["push"], [0.4, -0.4], rtol=1e-4)
    np.testing.assert_allclose(terms["approach"], [1.1 - 0.9] * 2, rtol=1e-4)


def test_bridge_rewards_result_and_end() -> None:
    env = made("go1bridge")
    facing = [[0, 0, 0], [0, 0, PI]]
    apart = placed(env, [[3.1, 0, 1.32], [6.9, 0, 1.32]], facing)
    np.testing.assert_allclose(terms_of(env, apart, apart)[1], [0, 0])
    assert result(env, apart) == (0, 0) and not stepped(env, apart).terminated
    across = placed(env, [[7.1, 0.9, 1.32], [7.8, 0, 1.32]], facing)
    np.testing.assert_allclose(terms_of(env, across, across)[1], [1, -1])
    assert result(env, across) == (1, 0) and not stepped(env, across).terminated
    swapped = placed(env, [[7.1, 0.3, 1.32], [2.9, 0, 1.32]], facing)
    np.testing.assert_allclose(terms_of(env, swapped, swapped)[1], [0, 0])
    assert result(env, swapped) == (0, 0)
    off = placed(env, [[7.1, 0.3, 1.32], [5.0, 0.6, 0.45]], facing)
    np.testing.assert_allclose(terms_of(env, off, off)[1], [11, -11])
    assert result(env, off) == (1, 0) and stepped(env, off).terminated
    both = placed(env, [[5.0, -0.6, 0.4], [5.0, 0.6, 0.45]], facing)
    assert result(env, both) == (0, 0) and stepped(env, both).terminated
    assert result(env, placed(env, [[3.0, 0, 1.32], [5.0, 0.6, 0.45]], facing)) == (1, 0)


STARTS = {
    "go1tug": ([[1.6, -2.5, 0.34, PI / 2], [1.6, 2.5, 0.34, -PI / 2]], [1.0, 0, 0, 0]),
    "go1revolvingdoor": ([[0.5, -1, 0.42, 0], [0.5, 1, 0.42, 0]], [0.1, 0.1, 0, 0]),
    "go1wrestling": ([[3.1, -1, 0.74, PI / 2], [3.1, 1, 0.74, -PI / 2]], [0.1, 0.1, 0, 0]),
    "go1bridge": ([[2.5, 0, 1.4, 0], [7.5, 0, 1.4, PI]], [0.1, 0.1, 0, 0]),
}
"""Mean x, y, z, yaw of both robots, m and rad, and half the widths of their ranges."""


@pytest.mark.parametrize("task", STARTS)
def test_robots_start_as_listed(task: str) -> None:
    env = made(task)
    (mean, spread) = STARTS[task]
    away = (
        np.asarray(jax.jit(jax.vmap(env.spawn))(jax.random.split(jax.random.PRNGKey(0), 64))) - mean
    )
    assert np.all(np.abs(away) <= np.array(spread) + 1e-5)
    for side in (away, -away):
        assert np.all(side[..., 0].max(axis=0) > 0.8 * spread[0])
    assert env.compiled.scene.colors == (0, 2)
