"""Sizes of teams and flocks: where robots and sheep start, their looks and buffers, the rules of
larger teams.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax.envs import Moment, VectorEnv, make
from mqe_jax.physics.appearance import ROBOT_COLORS, UNNUMBERED
from mqe_jax.physics.collision import MAX_ROBOTS, robot_bits
from mqe_jax.physics.robots.index import trunk_bodies
from mqe_jax.policies.scripted import scripted_policy
from mqe_jax.policies.scripted.cooperative import plan_sheep_hard
from mqe_jax.viz.geometry import robot_color
from tests.states import initial, observation, placed, terms_of, with_object

GATE, EASY, HARD, BOX, FOOTBALL, SUMO = (
    f"go1{name}"
    for name in ("gate", "sheep-easy", "sheep-hard", "pushbox", "football-1vs1", "wrestling")
)


def ring(radius: float) -> dict[str, Any]:
    """Settings of a larger ring, on a platform that is larger by as much as the default one."""
    side = 2 * radius + 0.97
    return {"ring_radius": radius, "platform": {"size": (side, side, 0.5)}}


SIZES: dict[int, list[tuple[str, dict[str, Any]]]] = {
    2: [(task, {}) for task in (GATE, EASY, HARD, BOX, FOOTBALL, SUMO)],
    4: [
        (GATE, {}),
        (EASY, {"num_sheep": 5}),
        (HARD, {"num_sheep": 30}),
        (BOX, {}),
        (FOOTBALL, {}),
        (SUMO, {}),
    ],
    8: [(GATE, {}), (EASY, {}), (HARD, {"num_sheep": 1}), (BOX, {}), (FOOTBALL, {}), (SUMO, {})],
    16: [
        (GATE, {}),
        (EASY, {}),
        (HARD, {"num_sheep": 100}),
        (BOX, {}),
        (FOOTBALL, {}),
        (SUMO, ring(2.5)),
    ],
    32: [(GATE, {}), (EASY, {}), (HARD, {}), (BOX, {}), (FOOTBALL, {}), (SUMO, ring(4.8))],
}
ROWS = [
    pytest.param(task, size, settings, id=f"{task}-{size}")
    for size in SIZES
    for task, settings in SIZES[size]
]


@functools.cache
def sized(task: str, size: int, **settings: Any) -> Any:
    return make(task, impl="c", control="position", num_envs=2, num_agents=size, **settings)


def apart(places: Any) -> float:
    """The smallest distance between two places (N, 2), m."""
    every = np.asarray(places, float)[:, :2]
    return float((np.linalg.norm(every[:, None] - every, axis=-1) + 1e3 * np.eye(len(every))).min())


@pytest.mark.parametrize(("task", "size", "settings"), ROWS)
def test_a_scene_of_any_size_has_room_and_buffers(
    task: str, size: int, settings: dict[str, Any]
) -> None:
    env: Any = make(task, impl="c", control="position", num_envs=1, num_agents=size, **settings)
    scene = env.compiled.scene
    poses = np.array(env.spawn_poses())
    assert len(poses) == env.num_agents == env.index.num_robots == sum(map(len, env.teams)) == size
    assert apart(poses) > 0.69
    low = scene.track.start
    high = scene.track.start + scene.track.length
    if scene.track.walled:
        assert np.all(np.abs(poses[:, 1]) <= scene.track.width / 2 - 0.35)
        assert np.all((poses[:, 0] >= low + 0.9) & (poses[:, 0] <= high - 0.9))
    else:
        assert np.all(
            np.linalg.norm(poses[:, :2] - env.center, axis=1) <= env.params.ring_radius - 0.39
        )
    if "sheep0" in env.objects:
        start, noise = env.params.flock_grid()
        assert len(start) == env.num_sheep and apart(start) - 2 * noise >= 0.39
        assert start[:, 0].min() - poses[:, 0].max() >= 0.99
        assert np.all(np.abs(start[:, 1]) <= scene.track.width / 2 - 0.49)
    elif len(env.teams) == 2:
        mirrored = 2 * np.array(env.center) - poses[: size // 2, :2]
        np.testing.assert_allclose(poses[size // 2 :, :2], mirrored, atol=1e-9)
        np.testing.assert_allclose(
            np.exp(1j * poses[size // 2 :, 2]), -np.exp(1j * poses[: size // 2, 2]), atol=1e-9
        )
    assert scene.max_contacts >= env.params.contacts_per_robot * size + 2 * (len(env.objects) - 9)
    team = len(env.teams[0])
    obs = jax.ShapeDtypeStruct((team, env.observation_size), jnp.float32)
    assert jax.eval_shape(scripted_policy(env), obs).shape == (team, 3)


@pytest.mark.parametrize(("task", "size"), [(GATE, 4), (GATE, 8), (FOOTBALL, 4), (FOOTBALL, 10)])
def test_robots_are_told_apart_by_colours_and_numbers(task: str, size: int) -> None:
    model = sized(task, size).mj_model
    colors = [robot_color(model, trunk) for trunk in trunk_bodies(model)]
    teams = size if size <= UNNUMBERED or task == GATE else 2
    assert (
        len(set(colors)) == teams
        and [colors.count(color) for color in colors] == [size // teams] * size
    )
    parts = [model.body_geomnum[trunk] for trunk in trunk_bodies(model)]
    assert (len(set(parts)) > 1) == (size > UNNUMBERED)  # digits have different numbers of segments
    assert len(set(ROBOT_COLORS)) == len(ROBOT_COLORS) == MAX_ROBOTS


def test_robots_collide_with_all_but_themselves() -> None:
    kind, affinity = np.array([robot_bits(number) for number in range(MAX_ROBOTS)]).T
    touch = (kind[:, None] & affinity) | (kind & affinity[:, None])
    np.testing.assert_array_equal(touch == 0, np.eye(MAX_ROBOTS, dtype=bool))


def test_the_mass_of_the_box_grows_with_the_robots() -> None:
    masses = [sized(BOX, size).compiled.model.body("object/box").mass[0] for size in (1, 2, 8)]
    assert masses == [3.0, 6.0, 24.0]


def played(env: Any, steps: int) -> Any:
    """The state of two environments after random steps, in which nothing diverges or overflows."""
    batch = VectorEnv(env, 2)
    state = jax.jit(batch.reset)(jax.random.PRNGKey(0))
    step = jax.jit(batch.step)
    random = np.random.default_rng(0)
    for _ in range(steps):
        action = random.uniform(-1, 1, (2, env.num_agents, env.action_size)).astype(np.float32)
        state = step(state, action)
        assert np.isfinite(state.obs).all() and np.isfinite(state.reward).all()
        assert not np.any(state.metrics["diverged"]) and not np.any(state.metrics["overflow"])
        if len(env.teams) > 1:
            own, other = np.split(np.asarray(state.reward), 2, axis=1)
            np.testing.assert_array_equal(own, -other)
    return state


@pytest.mark.soak
@pytest.mark.parametrize(("task", "size", "settings"), ROWS)
def test_any_size_steps(task: str, size: int, settings: dict[str, Any]) -> None:
    played(make(task, impl="c", num_envs=2, num_agents=size, **settings), 200)


def test_a_step_of_three_against_three_is_symmetric() -> None:
    check_symmetry(sized(FOOTBALL, 6))


@pytest.mark.soak
@pytest.mark.parametrize(
    ("task", "size", "settings"), [row for row in ROWS if row.values[0] in (FOOTBALL, SUMO)]
)
def test_a_step_of_any_match_is_symmetric(task: str, size: int, settings: dict[str, Any]) -> None:
    check_symmetry(
        make(task, impl="c", control="position", num_envs=1, num_agents=size, **settings)
    )


def check_symmetry(env: Any) -> None:
    """Compares a step of a match with that of its image, in which the teams have changed sides;
    feet on the ground.
    """
    size = env.num_agents
    random = np.random.default_rng(1)
    start = np.array(env.spawn_poses()) + random.uniform(-0.1, 0.1, (size, 3))
    action = random.uniform(-1, 1, (size, env.action_size)).astype(np.float32)
    ball = np.array([6.4, 0.3])
    speed = np.array([1.0, 0.5])
    swap = np.roll(np.arange(size), size // 2)
    states = []
    for turned in (False, True):
        sign, order = (-1, swap) if turned else (1, np.arange(size))
        place = 2 * np.array(env.center) * turned + sign * start[:, :2]
        spot = 2 * np.array(env.center) * turned + sign * ball
        position = np.c_[place, np.full(size, env.params.spawn_height - 0.13)][order]
        state = placed(
            env, position, np.c_[np.zeros((size, 2)), start[:, 2] + np.pi * turned][order]
        )
        if "ball" in env.objects:
            state = with_object(env, state, "ball", [*spot, 0.1], sign * speed)
        states.append(stepped(env)(state, action[order]))
    first, second = states
    np.testing.assert_allclose(first.obs, np.asarray(second.obs)[swap], atol=1e-5)
    np.testing.assert_allclose(first.reward, np.asarray(second.reward)[swap], atol=1e-5)
    own, other = np.split(np.asarray(first.reward), 2)
    np.testing.assert_array_equal(own, -other)
    assert "ball" not in env.objects or np.abs(np.asarray(first.reward)).max() > 1e-4


@functools.cache
def stepped(env: Any) -> Callable[..., Any]:
    return jax.jit(env.step)


def test_sumo_ends_when_the_last_robot_of_a_team_is_out() -> None:
    env = sized(SUMO, 4)
    x, y = env.center
    inside = np.array(
        [
            [x - 0.5, y - 0.6, 0.7],
            [x + 0.5, y - 0.6, 0.7],
            [x - 0.5, y + 0.6, 0.7],
            [x + 0.5, y + 0.6, 0.7],
        ]
    )
    out = inside + np.array([[-1.5, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0]])

    def judged(position: Any, before: Any) -> Any:
        return judge(env)(before, placed(env, position, state=before))

    one = judged(out, initial(env))
    assert one.task.tolist() == [True, False, False, False] and not one.terminated
    back = judged(inside, one)
    assert back.task.tolist() == one.task.tolist()  # it remains out
    seen = env.observation_layout.split(observation(env, back))
    assert (
        seen["teammate"][1, -1] == 0
        and not seen["teammate"][1].any()
        and seen["teammate"][2, -1] == 1
    )
    np.testing.assert_array_equal(seen["opponents"].reshape(4, 2, 7)[2:, :, 6], [[0, 1]] * 2)
    second = out + np.array([[0, 0, 0], [1.5, 0, 0], [0, 0, 0], [0, 0, 0]])
    lost = judged(second, back)
    assert lost.terminated and lost.outcome.win.tolist() == [0, 1] and lost.outcome.ending["task"]
    np.testing.assert_allclose(lost.reward, [-10, -10, 10, 10])
    both = judged(inside + np.array([[0, -1.5, 0]] * 2 + [[0, 1.5, 0]] * 2), initial(env))
    assert both.terminated and both.outcome.draw.tolist() == [1, 1]
    terms = terms_of(
        env, one, placed(env, inside + np.array([[9, 0, 0]] + [[0.1, 0, 0]] * 3), state=one)
    )[0]
    nearer = np.linalg.norm([0.6, 0.6]) - np.linalg.norm(
        [0.5, 0.6]
    )  # of robot 1, the only one of team 0, from the centre
    np.testing.assert_allclose(terms["push"][2:], [nearer] * 2, rtol=1e-4)


@functools.cache
def judge(env: Any) -> Callable[..., Any]:
    def judged(before: Any, after: Any) -> Any:
        moments = (Moment(state, env.read(state.data, state.active)) for state in (before, after))
        return env.judge(*moments)

    return jax.jit(judged)


def herding(robots: list[list[float]], sheep: list[list[float]]) -> dict[str, jax.Array]:
    """Observations of robots at x, y that face the gate at x 8.5 m, y 0."""
    base = np.zeros((len(robots), 6), np.float32)
    base[:, :2] = robots
    gate = np.array([8.5, 0.0], np.float32)
    flock = np.ravel(np.array(sheep, np.float32))
    return {"base": jnp.asarray(base)} | {
        name: jnp.tile(jnp.asarray(value), (len(robots), 1))
        for name, value in (("gate", gate), ("sheep", flock))
    }


def test_the_robots_of_a_large_team_drive_sheep_whatever_their_order() -> None:
    random = np.random.default_rng(0)
    robots = random.uniform([0, -2.5], [7, 2.5], (5, 2))
    sheep = random.uniform([2, -2.5], [9, 2.5], (11, 2))
    order = np.array([3, 0, 4, 1, 2])
    actions = plan_sheep_hard(herding(robots.tolist(), sheep.tolist()))
    np.testing.assert_allclose(
        plan_sheep_hard(herding(robots[order].tolist(), sheep.tolist())), actions[order], atol=1e-5
    )
    assert np.all(np.abs(actions) <= 1) and np.any(actions != 0)


def test_robots_brake_before_they_touch_what_they_drive() -> None:
    """The first wants to pass the second, the third the sheep before it, the fourth the gate's
    wall.
    """
    robots = [[2.0, 0.0], [2.7, 0.0], [5.0, 1.5], [8.1, 2.2]]
    forward = plan_sheep_hard(herding(robots, [[5.4, 1.5], [8.2, 1.6], [7.0, -1.5]]))[:, 0]
    assert forward[0] <= 0 and forward[2] < 0 and forward[3] < 0
    assert plan_sheep_hard(herding([[1.0, 0.0]], [[6.0, 0.0]]))[0, 0] > 0.4
