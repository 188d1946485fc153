"""Help in training alone: shaping terms and head starts, which are off by default, and demonstrated
first states.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax.acting.seats import Seats
from mqe_jax.core.settings import build
from mqe_jax.envs import Moment, State, make
from mqe_jax.selfplay.demonstrations import Demonstrated
from mqe_jax.train.config import TrainConfig
from tests.inputs import refuses
from tests.states import initial, made, terms_of

BOX = "go1pushbox"
BALL = "go1football-defender"
DUEL = "go1football-1vs1"
SUMO = "go1wrestling"
GOAL = np.array([12.0, 0.0])


@functools.cache
def compiled(task: str, **params: Any) -> tuple[Any, Any]:
    """A task with position control on the C engine, and its compiled reset of many environments."""
    env: Any = make(task, impl="c", control="position", **params)
    return env, jax.jit(jax.vmap(env.reset, (0, None)))


def resets(task: str, assistance: float, **params: Any) -> tuple[Any, State]:
    env, reset = compiled(task, **params)
    return env, reset(jax.random.split(jax.random.PRNGKey(3), 64), assistance)


def moved(
    task: str, name: str, assistance: float, head_start: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How far assistance moves robots (64, R, 2) and an object (64, 2) at the reset, m, and where
    it is without.
    """
    env, plain = resets(task, 0.0, head_start=head_start)
    before = np.asarray(plain.data.qpos)
    after = np.asarray(resets(task, assistance, head_start=head_start)[1].data.qpos)
    item = env.objects[name].qpos[:2]
    return (
        (after - before)[:, env.index.base_qpos[:, :2]],
        (after - before)[:, item],
        before[:, item],
    )


@pytest.mark.parametrize(("task", "name"), [(BOX, "box"), (BALL, "ball")])
def test_assistance_moves_nothing_without_a_head_start(task: str, name: str) -> None:
    robots, item, _ = moved(task, name, 1.0, 0.0)
    assert not robots.any() and not item.any()


def test_box_and_robots_start_further_by_the_same_distance() -> None:
    robots, box, _ = moved(BOX, "box", 0.5, 0.9)
    np.testing.assert_allclose(robots, np.stack([box, box], axis=1), atol=1e-6)
    assert not box[:, 1].any() and box[:, 0].min() >= 0 and 0.4 < box[:, 0].max() <= 0.45


def test_head_starts_have_room() -> None:
    refuses(r"head_start: 1.0 .* at most 0.95", make, BOX, impl="c", head_start=1.0)
    # where there is no room for any
    assert make(BOX, impl="c", num_envs=1, box_x=4.5).params.head_start == 0
    refuses(r"head_start: 0.7 .* at most 0.60", make, SUMO, impl="c", head_start=0.7)


def test_ball_and_robots_start_nearer_to_the_goal() -> None:
    robots, ball, before = moved(BALL, "ball", 1.0, 0.9)
    share = ball[:, :1] / (GOAL - before)[:, :1]
    np.testing.assert_allclose(ball, share * (GOAL - before), atol=1e-5)
    assert share.min() >= 0 and 0.8 < share.max() <= 0.9
    np.testing.assert_allclose(robots[:, :2, 0], np.tile(ball[:, :1], 2), atol=1e-5)
    assert not robots[:, 2].any()  # the defender


def test_ball_and_attackers_start_nearer_to_either_goal() -> None:
    robots, ball, _ = moved(DUEL, "ball", 1.0, 0.8)
    way = ball[:, :1]
    assert way.min() < -3.0 and way.max() > 3.0 and abs(way).max() <= 4.0
    np.testing.assert_allclose(
        robots[..., 0], np.where(way > 0, [1.0, 0.0], [0.0, 1.0]) * way, atol=1e-6
    )


def test_wrestlers_start_nearer_to_the_edge() -> None:
    side = moved(SUMO, "platform", 1.0, 0.5)[0][..., 1]
    np.testing.assert_allclose(side[:, 0], side[:, 1], atol=1e-6)
    assert -0.5 <= side.min() < -0.4 and 0.4 < side.max() <= 0.5


def terms_after(env: Any, state: State, columns: Any, values: Any) -> dict[str, float]:
    data = state.data.replace(
        qpos=state.data.qpos.at[jnp.asarray(columns)].set(jnp.asarray(values))
    )
    return {
        name: float(x)
        for name, x in terms_of(env, state, dataclasses.replace(state, data=data))[0].items()
    }


def test_shaping_terms_of_push_box() -> None:
    env = made(BOX)
    state = initial(made(BOX))
    box = env.objects["box"].qpos
    gate = float(state.anchors[0, 1])
    here = float(state.data.qpos[box[1]])
    nearer = terms_after(env, state, box[1:2], [here + 0.25 * (gate - here)])
    assert nearer["aim"] == pytest.approx(0.25 * abs(gate - here), abs=1e-5)
    position = np.asarray(state.data.qpos)[box[:2]]
    first = env.index.base_qpos[0, :2]
    place = position + np.array([-0.8, -0.25])
    start = np.asarray(state.data.qpos)[first]
    assert terms_after(env, state, first, place)["approach"] == pytest.approx(
        np.linalg.norm(start - place), abs=1e-5
    )
    assert env.params.rewards.approach == env.params.rewards.aim == 0


def test_shaping_terms_of_football() -> None:
    env = made(BALL)
    state = initial(made(BALL))
    ball = env.objects["ball"].qpos[:2]
    here = np.asarray(state.data.qpos)[ball]
    moved = here + 0.1 * (GOAL - here)
    terms = terms_after(env, state, ball, moved)
    assert terms["progress"] == pytest.approx(0.1 * np.linalg.norm(GOAL - here), abs=1e-4)
    robots = np.asarray(state.data.qpos)[env.index.base_qpos[:2, :2]]

    def near(point):
        return np.linalg.norm(robots - point, axis=1).min()

    assert terms["approach"] == pytest.approx(near(here) - near(moved), abs=1e-4)
    assert env.params.rewards.progress == env.params.rewards.approach == 0


def test_one_sided_shaping_of_a_football_match() -> None:
    env = made(DUEL)
    state = initial(made(DUEL))
    ball = jnp.asarray(env.objects["ball"].qpos[:1])

    def moved(state: State, x: float) -> tuple[State, np.ndarray]:
        after = dataclasses.replace(
            state, data=state.data.replace(qpos=state.data.qpos.at[ball].set(x))
        )
        now = Moment(after, env.read(after.data))
        after = dataclasses.replace(after, task=env.step_task(Moment(state, now.robots), now))
        return after, np.asarray(terms_of(env, state, after)[0]["advance"])

    there, first = moved(state, 8.0)
    back, second = moved(there, 6.5)
    _, third = moved(back, 8.25)
    np.testing.assert_allclose(
        [first, second, third], [[1.0, 0.0], [0.0, 0.5], [0.25, 0.0]], atol=1e-4
    )
    robot = jnp.asarray(env.index.base_qpos[:, 0])
    qpos = state.data.qpos.at[robot].add(jnp.array([0.5, 0.0]))
    near = dataclasses.replace(state, data=state.data.replace(qpos=qpos))
    np.testing.assert_allclose(terms_of(env, state, near)[0]["chase"], [0.5, 0.0], atol=1e-2)


def test_a_goal_of_both_needs_touches_of_both() -> None:
    """A robot beside the ball touches it where its velocity changes."""
    env = made(BALL)
    state = initial(made(BALL))
    ball = env.objects["ball"].qpos[:2]
    speed = env.objects["ball"].qvel[0]

    def kicked(
        state: State,
        robot: int,
        change: float,
        apart: float = 0.4,
        x: float = 6.0,
        other: float = 3.0,
    ) -> State:
        qpos = state.data.qpos.at[jnp.asarray(ball)].set(jnp.array([x, 0.0]))
        places = (
            jnp.array([[x, other], [x, -other], [10.0, 0.0]])
            .at[robot]
            .set(jnp.array([x - apart, 0.0]))
        )
        qpos = qpos.at[jnp.asarray(env.index.base_qpos[:, :2])].set(places)
        qvel = state.data.qvel.at[speed].add(change)
        after = dataclasses.replace(state, data=state.data.replace(qpos=qpos, qvel=qvel))
        moments = [Moment(each, env.read(each.data)) for each in (state, after)]
        return dataclasses.replace(after, task=env.step_task(*moments))

    first = kicked(state, 0, 0.5)
    assert first.task.play.touched.tolist() == [True, False, False]
    # the nearest alone
    assert kicked(state, 1, 0.5, other=0.5).task.play.touched.tolist() == [False, True, False]
    for nothing in (
        kicked(state, 0, 0.05),
        kicked(state, 0, 0.5, apart=0.8),
        kicked(state, 2, 0.5),
    ):
        assert not nothing.task.play.touched[:2].any()
    alone = kicked(first, 0, 0.5, x=12.1)
    both = kicked(kicked(first, 1, 0.5), 2, 0.0, x=12.1)
    late = kicked(alone, 1, 0.5, x=12.1)  # after the goal
    for end, together in ((alone, False), (both, True), (late, False)):
        outcome = env.outcome(end, env.read(end.data), jnp.array(False))
        assert bool(outcome["success"]) and bool(outcome["both_touched"]) == together
    for before, end, goal in ((first, alone, 1.0), (alone, late, 0.0), (both, both, 0.0)):
        assert float(terms_of(env, before, end)[0]["first_goal"]) == goal


N = 32


class Bending:
    """A demonstrator that bends all joints further in every step of an episode, by its recurrent
    state.
    """

    task = "go1plane"
    agents = 2

    def initial_memory(self, num_envs: int) -> jax.Array:
        return jnp.ones(num_envs)

    def act(self, obs: jax.Array, memory: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jnp.broadcast_to(0.01 * memory[:, None, None], (*obs.shape[:2], 12)), memory + 1.0


def test_a_demonstrator_needs_assistance_and_episodes_of_sixteen_steps() -> None:
    refuses(
        r"curriculum\.assistance.*above 0",
        build,
        TrainConfig,
        {"task": "go1gate", "curriculum": {"demonstrator": "scripted"}},
    )
    task = make("go1plane", impl="c", num_envs=N, control="position", episode_length=0.2)
    refuses(
        r"episode_length: 0\.2 .*at least 16 steps with a demonstrator",
        Demonstrated,
        task,
        N,
        Seats.of(task, Bending()),
    )


def test_thousands_of_environments_have_a_demonstrator() -> None:
    """More than 4096, whose memory is checked before they are made."""
    task = make("go1plane", impl="c", control="position")
    assert Demonstrated(task, 4097, Seats.of(task, Bending())).num_envs == 4097


@pytest.fixture(scope="module")
def rollout() -> tuple[Any, dict[str, Any]]:
    """A batch of short episodes, and its states over two time limits for assistance 0 to 1, leading
    axis time.
    """
    task = make(
        "go1plane", impl="c", num_envs=N, control="position", episode_length=0.64, min_height=0.3
    )
    env = Demonstrated(task, N, Seats.of(task, Bending()))

    @jax.jit
    def run(assistance: jax.Array) -> Any:
        state = env.reset(jax.random.PRNGKey(1))
        state = dataclasses.replace(state, assistance=jnp.full(N, assistance))
        action = jnp.zeros((N, env.num_agents, env.action_size))

        def advance(state: Any, _: None) -> Any:
            state = env.step(state, action)
            return state, (state.step, state.data.qpos, state.truncated | state.terminated)

        last, seen = jax.lax.scan(advance, state, None, length=2 * env.max_episode_steps)
        return last.demonstrations, seen

    return env, {
        name: run(jnp.asarray(level)) for name, level in (("none", 0.0), ("few", 0.3), ("all", 1.0))
    }


def test_episodes_start_in_demonstrated_states(rollout: Any) -> None:
    """With assistance 1 every new episode starts in a recorded state, with the time that was left
    to it.
    """
    env, runs = rollout
    demonstrations, (step, qpos, done) = runs["all"]
    recorded = demonstrations["step"], demonstrations["data"]["qpos"]
    moments = {(int(s), *np.asarray(q)) for s, q in zip(*recorded, strict=True)}
    starts = {(int(step[t, i]), *np.asarray(qpos[t, i])) for t, i in np.argwhere(np.asarray(done))}
    assert len(starts) > N and starts <= moments
    assert len({start[0] for start in starts}) > 5
    assert np.all(np.asarray(step) <= env.max_episode_steps)


def test_the_assistance_is_the_share_of_demonstrated_starts(rollout: Any) -> None:
    _, (step, _, done) = rollout[1]["none"]
    assert np.asarray(done).any() and not np.asarray(step)[np.asarray(done)].any()
    demonstrations, (_, qpos, done) = rollout[1]["few"]
    moments = {tuple(np.asarray(q)) for q in demonstrations["data"]["qpos"]}
    starts = [tuple(np.asarray(qpos[t, i])) in moments for t, i in np.argwhere(np.asarray(done))]
    assert len(starts) >= 4 * N and 0.2 < np.mean(starts) < 0.4


def test_a_demonstrators_memory_starts_anew_with_its_episodes(rollout: Any) -> None:
    env, runs = rollout
    demonstrations = runs["all"][0]
    step = np.asarray(demonstrations["step"])
    ctrl = np.asarray(demonstrations["data"]["ctrl"])
    assert len(step) == 128 * 16 and len(set(step.tolist())) > 8
    bent = (ctrl - env.env.controller.neutral.ravel()) / np.tile(
        env.env.robots[0].action_scale, env.num_agents
    )
    np.testing.assert_allclose(bent, 0.01 * np.tile(step[:, None], bent.shape[1]), atol=1e-5)
