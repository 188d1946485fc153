"""The matches and football on states made by hand: mirrored views, zero-sum rewards, results and
endings, the defender's play.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mqe_jax.envs import TASKS, QuadrupedEnv, State, make
from mqe_jax.envs.match import Match
from tests.states import (
    ending,
    initial,
    made,
    moment,
    observation,
    placed,
    stepped,
    stepper,
    terms_of,
    with_object,
)

MATCHES = [name for name, task in TASKS.items() if issubclass(task, Match)]
PI = np.pi


@functools.cache
def programs(env: Any) -> tuple[Any, Any]:
    """Compiled: the result of a state, and the task's own state after a step."""

    def verdict(state: State) -> Any:
        return env.result(state, env.read(state.data), jnp.array(False))

    return jax.jit(verdict), jax.jit(env.step_task)


def result(env: Any, state: Any) -> tuple[float, float]:
    """Wins of both teams, as if the episode ended now."""
    out = programs(env)[0](state)
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


# -- football


FOOTBALL = ("go1football-defender", "go1football-1vs1", "go1football-2vs2")


duel = pytest.fixture(scope="module")(lambda: made("go1football-1vs1"))
attack = pytest.fixture(scope="module")(lambda: made("go1football-defender"))


def with_ball(
    env: QuadrupedEnv, state: State, position: Any, velocity: Any = (0.0, 0.0, 0.0)
) -> State:
    """The state with the ball somewhere else, moving; on the ground if only x and y are given."""
    return with_object(
        env, state, "ball", [*position, 0.1] if len(position) == 2 else position, velocity
    )


def standing(env: QuadrupedEnv, state: State, places: Any, roll: float = 0.0) -> State:
    """The state with all robots at x, y, yaw, standing still; the first one, instead, rolled over
    at yaw 0.
    """
    places = np.asarray(places)
    euler = np.c_[np.zeros((len(places), 2)), places[:, 2]]
    if roll:
        euler[0] = [roll, 0.0, 0.0]
    return placed(env, np.c_[places[:, :2], np.full(len(places), 0.31)], euler, state=state)


@pytest.mark.parametrize("task", FOOTBALL)
def test_everything_starts_as_listed(task: str) -> None:
    env = made(task)
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 64))
    robots = jax.jit(jax.vmap(env.read))(states.data)
    listed = {
        "go1football-defender": ([(4, -2), (4, 2), (10, 0)], [0, 0, 1], (5, -2.1)),
        "go1football-1vs1": ([(4, 0), (10, 0)], [0, 1], (7, 0)),
        "go1football-2vs2": ([(4, -2), (4, 2), (10, 2), (10, -2)], [0, 0, 1, 1], (7, 0)),
    }
    places, turned, ball = listed[task]
    away = np.abs(np.asarray(robots.position_w)[..., :2] - np.array(places))
    assert away.max() <= 0.1 + 1e-5 and away.max() > 0.09
    np.testing.assert_allclose(robots.position_w[..., 2], 0.42, atol=1e-6)
    np.testing.assert_allclose(
        np.cos(robots.euler[..., 2]), np.tile(1 - 2 * np.array(turned), (64, 1)), atol=1e-5
    )
    np.testing.assert_allclose(
        jax.jit(jax.vmap(env.ball))(states.data), np.tile([*ball, 0.1], (64, 1)), atol=1e-6
    )
    assert env.max_steps == 1000


def test_the_ball_can_start_between_the_attackers() -> None:
    changes: dict[str, Any] = {"ball_between": 0.5, "ball_noise": 0.2, "head_start": 0.5}
    env: Any = make("go1football-defender", impl="c", control="position", **changes)
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 256))
    y = np.asarray(jax.jit(jax.vmap(env.ball))(states.data))[:, 1]
    between = np.abs(y) <= 0.2
    assert 0.4 < between.mean() < 0.6 and np.all(np.abs(y[~between] + 2.1) <= 0.2)


def test_the_field_has_two_goals_and_walls_all_around(duel: Any) -> None:
    model = duel.compiled.model
    data = mujoco.MjData(duel.compiled.model)
    data.qpos[duel.index.base_qpos[:, 1]] = 4.0  # the robots out of the way, in a corner
    data.qpos[duel.index.base_qpos[:, 0]] = [3.0, 4.0]
    data.qpos[duel.objects["ball"].qpos[:3]] = [11.0, -4.0, 0.1]
    mujoco.mj_forward(model, data)

    def reach(x: float, y: float, direction: tuple[float, float], z: float = 0.1) -> float:
        geom = np.zeros(1, np.int32)
        return mujoco.mj_ray(
            model, data, np.array([x, y, z]), np.array([*direction, 0.0]), None, 1, -1, geom
        )

    for y in (-0.95, 0.0, 0.95):  # through the mouths
        assert reach(7.0, y, (1, 0)) == pytest.approx(13.0 - 7.0, abs=1e-3)
        assert reach(7.0, y, (-1, 0)) == pytest.approx(7.0, abs=1e-3)
    for y in (-1.05, 1.05, -3.0):  # beside them, up to the walls' height
        for z in (0.1, 0.99):
            assert reach(7.0, y, (1, 0), z) == pytest.approx(12.0 - 7.0, abs=1e-3)
            assert reach(7.0, y, (-1, 0), z) == pytest.approx(7.0 - 2.0, abs=1e-3)
    assert reach(12.5, 0.0, (0, 1)) == pytest.approx(1.0, abs=1e-3)  # the goal's own side
    assert reach(7.0, 0.0, (0, 1)) == reach(7.0, 0.0, (0, -1)) == pytest.approx(4.5, abs=1e-3)
    np.testing.assert_allclose(model.geom_size[duel.objects["ball"].geom, 0], 0.1)
    assert model.body_mass[duel.objects["ball"].body] == pytest.approx(0.318)


PLACES = [(4.2, 0.7, 0.3), (9.1, -1.2, 2.8), (8.4, 2.2, -2.0), (10.6, 0.4, 3.0)]


def turned(places: Any) -> np.ndarray:
    return np.array([(14 - x, -y, yaw + np.pi) for x, y, yaw in places])


def test_observations_are_what_is_listed() -> None:
    env = made("go1football-2vs2")
    state = with_ball(env, standing(env, initial(env), PLACES), (6.3, 1.1), (0.8, -0.3, 0.1))
    obs = observation(env, state)
    info = [[x, y, 0.31, 0, 0, yaw] for x, y, yaw in PLACES]
    ball = [6.3, 1.1, 0.1, 0.8, -0.3, 0.1]
    np.testing.assert_allclose(
        obs[0], [1, 0, *info[0], *info[1], *info[2], *info[3], *ball], atol=1e-5
    )
    np.testing.assert_allclose(
        obs[1], [0, 1, *info[1], *info[0], *info[2], *info[3], *ball], atol=1e-5
    )
    other = [
        [x, y, 0.31, 0, 0, (yaw + np.pi) % (2 * np.pi) - np.pi] for x, y, yaw in turned(PLACES)
    ]
    ball = [7.7, -1.1, 0.1, -0.8, 0.3, 0.1]
    np.testing.assert_allclose(
        obs[3], [0, 1, *other[3], *other[2], *other[0], *other[1], *ball], atol=1e-5
    )

    env = made("go1football-1vs1")
    state = with_ball(env, standing(env, initial(env), PLACES[:2]), (6.3, 1.1))
    obs = observation(env, state)
    np.testing.assert_allclose(
        obs[1], [1, *other[1], *other[0], 7.7, -1.1, 0.1, 0, 0, 0], atol=1e-5
    )

    env = made("go1football-defender")
    state = with_ball(env, standing(env, initial(env), PLACES[:3]), (6.3, 1.1), (0.8, -0.3, 0.1))
    obs = observation(env, state)
    ball = [6.3, 1.1, 0.1, 0.8, -0.3, 0.1]
    np.testing.assert_allclose(obs[0], [1, 0, *info[0], *info[1], *ball], atol=1e-5)
    np.testing.assert_allclose(obs[1], [0, 1, *info[1], *info[0], *ball], atol=1e-5)


GOALS = {
    (1, 0): [(12.01, 0.0), (12.01, 0.99), (12.9, -0.9)],
    (0, 1): [(1.99, 0.0), (1.99, -0.99)],
    (0, 0): [(11.99, 0.0), (12.01, 1.01), (12.01, -1.01), (2.01, 0.0), (1.99, 1.01), (7.0, 0.0)],
}


@pytest.mark.parametrize(
    ("ball", "goals"), [(ball, goals) for goals, balls in GOALS.items() for ball in balls]
)
def test_goals_at_both_ends(duel: Any, ball: tuple[float, float], goals: tuple[int, int]) -> None:
    state = with_ball(duel, initial(duel), ball)
    robots = moment(duel, state).robots
    np.testing.assert_array_equal(duel.leading(state, robots), np.array(goals, bool))
    assert bool(duel.ending(state, robots)) == any(goals)
    outcome = programs(duel)[0](state)
    assert (
        outcome.win.tolist()
        == outcome.success.tolist()
        == outcome.loss[::-1].tolist()
        == list(map(bool, goals))
    )
    assert outcome.draw.tolist() == [sum(goals) == 0] * 2


def test_match_rewards_add_up_as_worked_out_by_hand() -> None:
    """Before: the ball in the middle, 5 m from both goals. After: as each comment says."""
    env = made("go1football-2vs2")
    state = initial(env)
    before = with_ball(
        env, standing(env, state, [(4, -2, 0), (5, 0, 0), (10, 0, 0), (10, -4, 0)]), (7.0, 0.0)
    )
    goals, robots = env.distances(moment(env, before))
    np.testing.assert_allclose(goals, [5, 5], atol=1e-5)
    np.testing.assert_allclose(robots, [2, 3], atol=1e-5)
    # The ball at (8, 0): 4 m from team 0's goal (+1), 6 m from team 1's (-1): 1 - (-1) = 2. Team
    # 0's nearest robot, now at (6.5, 0), is 1.5 m away (+0.5), team 1's 2 m (+1): 0.5 - 1 = -0.5.
    after = with_ball(
        env, standing(env, state, [(4, -2, 0), (6.5, 0, 0), (10, 0, 0), (10, -4, 0)]), (8.0, 0.0)
    )
    reward = terms_of(env, before, after)[1]
    np.testing.assert_allclose(reward, np.array([1, 1, -1, -1]) * (0.3 * 2 - 0.1 * 0.5), atol=1e-4)
    # A goal of team 1: the ball at (1.9, 0), 10.1 m from the far goal (-6.1), 0.1 m from the near
    # one (+5.9). Nearest robots: team 0's (4, -2) at hypot(2.1, 2) = 2.9 m (-1.4), team 1's at 8.1
    # m (-6.1).
    reward = terms_of(env, after, with_ball(env, after, (1.9, 0.0)))[1]
    expected = -10 + 0.3 * (-6.1 - 5.9) + 0.1 * (-1.4 + 6.1)
    np.testing.assert_allclose(reward, np.array([1, 1, -1, -1]) * expected, atol=1e-4)
    assert abs(expected + 10) < 5  # the goal is most of it


def test_match_endings(duel: Any) -> None:
    places = [(4, 0, 0), (10, 0, np.pi)]
    state = standing(duel, initial(duel), places)
    play = stepped(duel, state)
    assert not play.terminated and not play.truncated
    late = stepped(duel, dataclasses.replace(state, step=jnp.int32(duel.max_steps - 1)))
    assert late.truncated and not late.terminated and late.outcome.draw.tolist() == [1, 1]
    fallen = stepped(duel, standing(duel, state, places, roll=1.0))
    assert fallen.terminated and fallen.outcome.win.tolist() == [0, 1]
    assert float(fallen.metrics["reward/fall"]) == -10
    np.testing.assert_allclose(fallen.reward[0], -fallen.reward[1], atol=1e-6)
    for x, speed, sign in ((11.98, 2.0, 1), (2.02, -2.0, -1)):
        goal = stepped(duel, with_ball(duel, state, (x, 0.5), (speed, 0, 0)))
        assert (
            goal.terminated
            and float(goal.outcome.win[0]) == (sign == 1)
            and ending(goal) == ["task"]
        )
        assert float(goal.metrics["reward/goal"]) == 10 * sign
        np.testing.assert_allclose(goal.reward[0], -goal.reward[1], atol=1e-6)


def test_attack_rewards_and_success(attack: Any) -> None:
    state = standing(attack, initial(attack), [(4, -2, 0), (4, 2, 0), (10, 0, np.pi)])
    for ball, expected in (((9.0, 0.0), 3 * np.exp(-1)), ((12.3, 0.4), 10 + 3 * np.exp(-0.5 / 3))):
        reward = terms_of(attack, state, with_ball(attack, state, ball))[1]
        np.testing.assert_allclose(reward, [expected] * 2, atol=1e-4)
    # The agents' own goal is none.
    own = with_ball(attack, state, (1.9, 0.0))
    assert terms_of(attack, state, own)[0]["goal"] == 0
    # A goal counts until the end of the episode, also when the ball comes out again.
    scored = stepped(attack, with_ball(attack, state, (11.98, 0.5), (2.0, 0, 0)))
    assert float(scored.outcome.success[0]) == 1 and not scored.terminated
    out = stepped(attack, with_ball(attack, scored, (11.0, 0.5)))
    assert float(out.outcome.success[0]) == 1 and float(out.metrics["reward/goal"]) == 0
    late = stepped(attack, dataclasses.replace(state, step=jnp.int32(attack.max_steps - 1)))
    assert late.truncated and not late.terminated and float(late.outcome.success[0]) == 0
    fallen = standing(attack, state, [(4, -2, 0), (4, 2, 0), (10, 0, np.pi)], roll=1.0)
    assert stepped(attack, fallen).terminated
    assert [int(terms_of(attack, state, after)[0]["fall"]) for after in (state, fallen)] == [0, 1]
    defender = placed(
        attack, [[4, -2, 0.31], [4, 2, 0.31], [10, 0, 0.31]], [[0, 0, 0], [0, 0, 0], [1.0, 0, 0]]
    )
    assert int(terms_of(attack, state, defender)[0]["fall"]) == 0
    assert attack.params.rewards.fall == 0


TOUCHES = {
    (): [0, 0, False],
    (0,): [0, 0, False],
    (0, 0): [0, 0, False],
    (0, 1): [1, 0, True],
    (1, 0, 0, 1): [2, 0, True],
    (0, 2, 1): [0, 0, True],
    (0, 2, 1, 0): [1, 0, True],
    (2, 3, 0): [0, 1, False],
    (0, 1, 2, 3, 2): [1, 2, True],
}
"""Passes of both teams, and whether both robots of team 0 touched the ball, by the robots that
touch it in turn."""


@pytest.mark.parametrize(
    ("task", "touching"),
    [
        (task, touching)
        for task in (FOOTBALL[0], FOOTBALL[2])
        for touching in TOUCHES
        if task == FOOTBALL[2] or 3 not in touching
    ],
)
def test_passes_and_goals_of_both(task: str, touching: tuple[int, ...]) -> None:
    env = made(task)
    state = initial(env)
    speed = 0.0
    corners = [(3, -4, 0), (3, 4, 0), (11, 4, 0), (11, -4, 0)][: len(env.kick_off)]
    for robot in (None, *(step for each in touching for step in (each, None)), "goal"):
        places = [(6.6, 0, 0) if i == robot else corner for i, corner in enumerate(corners)]
        speed += 0.2 * isinstance(robot, int)
        ball = (12.1, 0.0) if robot == "goal" else (7.0, 0.0)
        after = with_ball(env, standing(env, state, places), ball, (speed, 0.0, 0.0))
        state = dataclasses.replace(
            after, task=programs(env)[1](moment(env, state), moment(env, after))
        )
    first, second, both = TOUCHES[touching]
    outcome = programs(env)[0](state)
    assert float(outcome.further["both_touched"][0]) == both
    assert outcome.further["passes"].tolist() == (
        [first, second] if task == FOOTBALL[2] else [first]
    )


def test_an_idle_defender_gets_standing_commands(attack: Any) -> None:
    state = with_ball(attack, initial(attack), (8.0, -2.0))
    idle: Any = make("go1football-defender", impl="c", control="position", defender_idle=True)
    robots = attack.read(state.data)
    rest = idle.controller.default_commands
    np.testing.assert_allclose(idle.npc_commands(state, robots), rest[None])
    commands = np.asarray(attack.npc_commands(state, robots))[0]
    # 10 m along x, the law asks for 0.6 hypot(4, 2) - 2 = 0.68 m further out, and for 0.9 m to the
    # side.
    np.testing.assert_allclose(commands[:2], [0.5, 0.5], atol=1e-6)
    np.testing.assert_array_equal(commands[3:], rest[3:])
