"""Sizes of teams and flocks: where robots and sheep start, their looks and buffers, the rules of
larger teams; episodes in which some take no part, and policies of any size.
"""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax.core.settings import build
from mqe_jax.envs import Moment, VectorEnv, make
from mqe_jax.envs.sizes import ENTITIES
from mqe_jax.names import load_policy
from mqe_jax.npc import flock
from mqe_jax.physics.appearance import ROBOT_COLORS, UNNUMBERED
from mqe_jax.physics.collision import MAX_ROBOTS, robot_bits
from mqe_jax.physics.robots.index import trunk_bodies
from mqe_jax.policies.scripted import scripted_policy
from mqe_jax.policies.scripted.cooperative import _sides, plan_sheep_hard
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.policy import TrainedPolicy, save_policy
from mqe_jax.view.stage import Stage
from mqe_jax.viz import cameras, framing, geometry
from mqe_jax.viz.geometry import robot_color
from mqe_jax.viz.recording import Episode
from tests.inputs import refuses
from tests.states import initial, observation, placed, terms_of, with_object
from tests.training import untrained

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


plan = jax.jit(plan_sheep_hard)


def test_the_robots_of_a_large_team_drive_sheep_whatever_their_order() -> None:
    random = np.random.default_rng(0)
    robots = random.uniform([0, -2.5], [7, 2.5], (5, 2))
    sheep = random.uniform([2, -2.5], [9, 2.5], (11, 2))
    order = np.array([3, 0, 4, 1, 2])
    actions = plan(herding(robots.tolist(), sheep.tolist()))
    np.testing.assert_allclose(
        plan(herding(robots[order].tolist(), sheep.tolist())), actions[order], atol=1e-5
    )
    assert np.all(np.abs(actions) <= 1) and np.any(actions != 0)


def test_robots_brake_before_they_touch_what_they_drive() -> None:
    """The first wants to pass the second, the third the sheep before it, the fourth the gate's
    wall.
    """
    robots = [[2.0, 0.0], [2.7, 0.0], [5.0, 1.5], [8.1, 2.2]]
    forward = plan(herding(robots, [[5.4, 1.5], [8.2, 1.6], [7.0, -1.5]]))[:, 0]
    assert forward[0] <= 0 and forward[2] < 0 and forward[3] < 0
    assert plan(herding([[1.0, 0.0]], [[6.0, 0.0]]))[0, 0] > 0.4


# -- episodes in which some robots and sheep take no part


BALL = "go1football-1vs1"
SHEEP = "go1sheep-hard"
# m, so that robots stand at once; rad
LOW = {"spawn_height": 0.3, "randomization": {"motor_offset": 0.05}}
LARGE: dict[str, dict[str, Any]] = {
    BALL: {"num_agents": 6, "fewest_agents": 2, **LOW},
    SHEEP: {
        "num_agents": 4,
        "fewest_agents": 2,
        "num_sheep": 5,
        "fewest_sheep": 3,
        "restlessness": 0.0,
        **LOW,
    },
}
SMALL: dict[str, dict[str, Any]] = {
    BALL: {"num_agents": 4, **LOW},
    SHEEP: {"num_agents": 3, "num_sheep": 4, "restlessness": 0.0, **LOW},
}
PLACES = {BALL: [0, 1, 3, 4], SHEEP: [0, 1, 2]}  # of the small scene's robots in the large one
NETWORK = {
    "name": "blocks",
    "recurrent": False,
    "hidden_sizes": (8,),
    "entity_sizes": (6, 5),
    "critic_input": "own",
}


@functools.cache
def varied(task: str, large: bool) -> Any:
    return make(task, impl="c", control="position", num_envs=1, **(LARGE if large else SMALL)[task])


@functools.cache
def program(env: Any) -> Callable[..., Any]:
    """Compiled: the next state with the group of entities, and the scripted policy's actions in
    it.
    """

    def step(state: Any, action: jax.Array) -> tuple[Any, list[jax.Array]]:
        after = env.with_observations(env.advance(state, action), [ENTITIES])
        return after, [scripted_policy(env)(after.obs[np.array(team)]) for team in env.teams]

    return jax.jit(step)


@functools.cache
def resets(env: Any) -> Any:
    """Compiled resets of keys at levels of assistance."""
    return jax.jit(jax.vmap(env.reset))


@functools.cache
def begun(task: str) -> Any:
    """A state of the large scene in which the robots of the small one take part, and fewer sheep
    than there are.
    """
    env = varied(task, True)
    states = resets(env)(jax.random.split(jax.random.PRNGKey(0), 40), jnp.zeros(40))
    count = np.asarray(states.active).sum(axis=1)
    if task == SHEEP:
        sheep = np.asarray(jax.vmap(env.herd.there)(states.data)).sum(axis=1)
        count = np.where(sheep == SMALL[task]["num_sheep"], count, 0)
    row = int(np.flatnonzero(count == SMALL[task]["num_agents"])[0])
    return at(row, states)


def at(row: int, states: Any) -> Any:
    """One of 40 states; NumPy indexes, for which JAX would compile a program per shape."""
    return jax.tree.map(
        lambda x: jnp.asarray(np.asarray(x)[row]) if np.shape(x)[:1] == (40,) else x, states
    )


def forged(env: Any, state: Any) -> Any:
    """A state, or a batch of states, whose parked robots are elsewhere and move."""
    index = env.index
    random = np.random.default_rng(1)
    absent = ~np.asarray(state.active)
    kinds = {"qpos": "qpos", "qvel": "qvel", "qacc_warmstart": "qvel"}
    fields = {name: np.array(getattr(state.data, name)) for name in kinds}
    for values, kind in zip(fields.values(), kinds.values(), strict=True):
        rows = np.concatenate(
            [getattr(index, f"base_{kind}"), getattr(index, f"joint_{kind}")], axis=1
        )
        values[..., rows] += absent[..., None] * random.uniform(-9, 9, rows.shape)
    return dataclasses.replace(state, data=state.data.replace(**fields))


@pytest.mark.parametrize("task", [pytest.param(BALL, marks=pytest.mark.soak), SHEEP])
def test_nothing_that_a_parked_robot_is_or_does_changes_anything_for_the_others(task: str) -> None:
    env = varied(task, True)
    start = begun(task)
    random = np.random.default_rng(0)
    absent = np.flatnonzero(~np.asarray(start.active))
    assert np.asarray(start.data.qpos)[env.index.base_qpos[absent, 2]].min() > 100
    state = other = start
    actions = random.uniform(-1, 1, (3, env.num_agents, 12)).astype(np.float32)
    acts: Any = None
    for action in actions:
        bad = action.copy()
        bad[absent] = np.nan
        (state, acts) = program(env)(state, action)
        (other, others) = program(env)(forged(env, other), bad)
        jax.tree.map(np.testing.assert_array_equal, (state, acts), (other, others))
    assert not state.terminated and np.isfinite(np.concatenate(acts)).all()
    assert not state.obs[absent].any() and not state.groups[ENTITIES][absent].any()
    assert not np.asarray(state.reward)[absent].any() and np.asarray(state.reward).any()
    seen = env.privileged_layout.split(state.privileged_obs)
    assert [
        bool(seen[f"robot{robot}/quaternion"].any()) for robot in range(len(start.active))
    ] == start.active.tolist()
    np.testing.assert_array_equal(
        state.data.ctrl[env.index.actuator[absent]], env.controller.neutral[absent]
    )
    assert np.any(
        np.asarray(program(env)(state, actions[0])[0].obs != program(env)(state, actions[1])[0].obs)
    )


@pytest.mark.parametrize("task", [BALL, SHEEP])
def test_mates_of_a_frozen_robot_observe_a_smaller_team(task: str) -> None:
    env = varied(task, True)
    start = begun(task)
    agent = PLACES[task][1]
    frozen = dataclasses.replace(
        start, frozen_steps=jnp.zeros_like(start.frozen_steps).at[agent].set(2)
    )
    absent = dataclasses.replace(start, active=start.active.at[agent].set(False))
    look = jax.jit(lambda state: env.with_observations(state, [ENTITIES]))
    hidden = look(frozen)
    without = look(absent)
    plain = look(start)
    mates = np.array(env.teams[0])
    np.testing.assert_array_equal(hidden.obs[mates], without.obs[mates])
    assert not hidden.obs[agent].any() and np.any(hidden.obs[mates[0]] != plain.obs[mates[0]])
    np.testing.assert_array_equal(hidden.groups[ENTITIES][mates], without.groups[ENTITIES][mates])
    np.testing.assert_array_equal(
        np.delete(hidden.obs, mates, axis=0), np.delete(plain.obs, mates, axis=0)
    )
    active = [place for place in PLACES[task] if place in env.teams[0] and place != agent]
    assert np.asarray(hidden.groups[ENTITIES])[active, 0].tolist() == (
        [-1.0, 1.0] if len(active) > 1 else [0.0]
    )
    later = look(dataclasses.replace(frozen, step=frozen.step + 2))
    np.testing.assert_array_equal(later.groups[ENTITIES], plain.groups[ENTITIES])
    states = resets(env)(jax.random.split(jax.random.PRNGKey(1), 40), jnp.ones(40))
    late = np.asarray(states.frozen_steps) > 0
    assert not late[~np.asarray(states.active)].any() and (late.sum(axis=1) == 1).mean() > 0.9


@pytest.mark.parametrize(
    ("task", "params"),
    [
        (BALL, {"fewest_agents": 2}),
        (SHEEP, {"num_agents": 1, "fewest_sheep": 3}),
        ("go1plane", {"num_agents": 3, "fewest_agents": 1}),
    ],
)
def test_teams_of_one_observe_entities_in_scenes_that_vary(
    task: str, params: dict[str, Any]
) -> None:
    env = make(task, impl="c", num_envs=1, **params)
    state = jax.eval_shape(
        lambda key: env.with_observations(env.begin(key), [ENTITIES]), jax.random.PRNGKey(0)
    )
    assert state.groups[ENTITIES].shape == (env.num_agents, env.group_sizes[ENTITIES])


@pytest.mark.parametrize("task", ["go1gate", "go1pushbox", "go1wrestling"])
def test_a_policy_of_entities_acts_in_another_size(task: str, tmp_path: Path) -> None:
    envs = [
        make(task, impl="c", control="position", num_envs=1, num_agents=number) for number in (4, 2)
    ]
    save_policy(tmp_path, policy(task, envs[0]))
    team = len(envs[1].teams[0])
    loaded: Any = load_policy(tmp_path, envs[1])
    acted = loaded.act(
        jnp.ones((team, envs[1].group_sizes[ENTITIES])), loaded.initial_memory(None), None
    )[0]
    assert acted.shape == (team, envs[1].action_size)


@pytest.mark.parametrize("task", [BALL, SHEEP])
def test_pictures_show_those_who_take_part(task: str) -> None:
    env = varied(task, True)
    data = begun(task).data
    poses = (np.stack([np.asarray(x)] * 2) for x in (data.qpos, data.mocap_pos, data.mocap_quat))
    episode = Episode(*poses, dt=env.dt)
    model = geometry.rendering_model(env.mj_model, episode)
    shown = [model.body(body).name for body in framing.targets(model, episode)]
    others = ["object/ball"] if task == BALL else [f"object/sheep{number}" for number in range(4)]
    assert shown == [*(f"robot{place}/trunk" for place in PLACES[task]), *others]
    assert (
        max(
            camera.position[2]
            for view in cameras.VIEWS
            for camera in cameras.cameras(model, episode, view)
        )
        < 20
    )
    stage = Stage(MagicMock(), env.mj_model, episode.cut(slice(1)))
    bodies = [*framing.targets(env.mj_model, episode)]
    stage.draw(episode.cut(slice(1)), (0, bodies))
    assert stage.span < 20


def policy(task: str, env: Any, **settings: Any) -> TrainedPolicy:
    """A policy with random weights that sees entities."""
    settings = {
        "task": task,
        "env": {"control": "position"},
        "group": ENTITIES,
        "network": NETWORK,
        **settings,
    }
    return untrained(env, build(TrainConfig, settings))


@pytest.mark.parametrize("task", [pytest.param(BALL, marks=pytest.mark.soak), SHEEP])
def test_fewer_robots_do_what_they_do_in_a_scene_of_their_number(task: str, tmp_path: Path) -> None:
    """So do the sheep, the scripted policy, and a policy of any size, whose file was written at the
    other size.
    """
    large = varied(task, True)
    small = varied(task, False)
    places = PLACES[task]
    save_policy(tmp_path, policy(task, small))
    one = load_policy(tmp_path, small)
    many = load_policy(tmp_path, large)
    assert (one.agents, many.agents) == (len(small.teams[0]), len(large.teams[0]))
    few = jax.tree.map(lambda x: x[0], resets(small)(jax.random.PRNGKey(2)[None], jnp.zeros(1)))
    full = begun(task)
    fields = {name: np.array(getattr(full.data, name)) for name in ("qpos", "qvel")}
    for name, field in fields.items():
        own = np.asarray(getattr(few.data, name))
        for kind in (f"base_{name}", f"joint_{name}"):
            field[getattr(large.index, kind)[places]] = own[getattr(small.index, kind)]
        for thing, found in small.objects.items():
            field[getattr(large.objects[thing], name)] = own[getattr(found, name)]
    data = full.data.replace(**fields, mocap_pos=few.data.mocap_pos)
    full = dataclasses.replace(full, data=data, anchors=few.anchors)
    few = dataclasses.replace(
        few,
        frozen_steps=few.frozen_steps * 0,
        randomized=dataclasses.replace(
            few.randomized, motor_offset=few.randomized.motor_offset * 0
        ),
    )
    full = dataclasses.replace(
        full,
        frozen_steps=full.frozen_steps * 0,
        randomized=dataclasses.replace(
            full.randomized, motor_offset=full.randomized.motor_offset * 0
        ),
    )
    few_acts: Any = None
    full_acts: Any = None
    for action in (
        np.random.default_rng(0).uniform(-1, 1, (3, small.num_agents, 12)).astype(np.float32)
    ):
        every = np.zeros((large.num_agents, 12), np.float32)
        every[places] = action
        (few, few_acts) = program(small)(few, action)
        (full, full_acts) = program(large)(full, every)
    close = functools.partial(np.testing.assert_allclose, atol=2e-4)
    close(full.data.qpos[large.index.base_qpos[places]], few.data.qpos[small.index.base_qpos])
    for thing, found in small.objects.items():
        close(full.data.qpos[large.objects[thing].qpos], few.data.qpos[found.qpos])
    close(full.reward[np.array(places)], few.reward)
    close(np.concatenate(full_acts)[places], np.concatenate(few_acts))
    mine = np.array(small.teams[0])
    theirs = np.array(large.teams[0])
    acted = many.act(full.groups[ENTITIES][theirs], many.initial_memory(None), None)[0]
    close(
        acted[: len(mine)], one.act(few.groups[ENTITIES][mine], one.initial_memory(None), None)[0]
    )


def test_sheep_that_take_no_part_do_not_belong_to_the_flock(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(jax.random, "normal", lambda key, shape: jnp.zeros(shape))
    random = np.random.default_rng(0)
    there = jnp.arange(6) < 4
    position = jnp.asarray(random.normal(size=(6, 2)), jnp.float32)
    velocity = jnp.asarray(random.normal(size=(6, 2)), jnp.float32)
    robots = jnp.asarray(random.normal(size=(2, 2)), jnp.float32)
    step = functools.partial(flock, jax.random.PRNGKey(0), restlessness=0.3, step=0.02)
    some = step(position, velocity, robots, there=there)
    four = step(position[:4], velocity[:4], robots)
    np.testing.assert_allclose(some, np.concatenate([four, np.zeros((2, 2))]), atol=1e-6)
    four_robots = {"base": jnp.zeros((4, 6))}
    three_robots = {"base": jnp.zeros((3, 6))}
    np.testing.assert_allclose(
        _sides({**four_robots, "active": jnp.arange(4) < 3})[:3], _sides(three_robots)
    )


def test_a_parked_robot_does_not_touch_the_ball_below_it() -> None:
    env = varied(BALL, True)
    start = begun(BALL)
    beside = np.array(start.data.qpos)
    # further than the parked ones
    beside[env.index.base_qpos[1, :2]] = env.ball_spot[0] + 0.55, env.ball_spot[1]
    moved = np.array(start.data.qvel)
    moved[env.objects["ball"].qvel[0]] = 1.0
    states = [start, dataclasses.replace(start, data=start.data.replace(qpos=beside, qvel=moved))]
    before, after = (Moment(state, env.read(state.data, state.active)) for state in states)
    assert env.touches(before, after).tolist() == [False, True, False, False, False, False]


@pytest.mark.parametrize("task", [BALL, SHEEP])
def test_sizes_are_drawn_evenly_and_start_where_teams_of_that_size_do(task: str) -> None:
    env = varied(task, True)
    states = resets(env)(jax.random.split(jax.random.PRNGKey(0), 40), jnp.zeros(40))
    active = np.asarray(states.active)
    teams = len(env.teams)
    counts = active.sum(axis=1)
    assert {*counts.tolist()} == {*range(LARGE[task]["fewest_agents"], env.num_agents + 1, teams)}
    for team in env.teams:  # the first ones, equally many of each
        np.testing.assert_array_equal(
            active[:, team], np.arange(len(team)) < counts[:, None] / teams
        )
    places = np.asarray(states.data.qpos)[:, env.index.base_qpos[:, :2]]
    own = varied(task, False)
    few = counts == own.num_agents
    off = places[few][:, PLACES[task]] - np.array(own.spawn_poses())[:, :2]
    assert 0.02 < np.abs(off).max() <= env.params.spawn_noise + 1e-5
    if task == SHEEP:
        sheep = np.asarray(jax.vmap(env.herd.there)(states.data))
        assert {*sheep.sum(axis=1).tolist()} == {3, 4, 5}
        np.testing.assert_array_equal(sheep, np.arange(5) < sheep.sum(axis=1, keepdims=True))
        start, noise = own.params.flock_grid()
        found = np.asarray(jax.vmap(env.sheep)(states.data))[sheep.sum(axis=1) == 4, :4] - start
        assert 0.1 < np.abs(found).max() <= noise + 1e-5


def test_with_assistance_teams_are_small_if_they_grow() -> None:
    env: Any = make(SHEEP, impl="c", control="position", num_envs=1, **LARGE[SHEEP], growing=True)
    levels = jnp.repeat(jnp.array([0.0, 0.5, 1.0]), 30)
    states = resets(env)(jax.random.split(jax.random.PRNGKey(0), 90), levels)
    robots = np.asarray(states.active).sum(axis=1).reshape(3, 30)
    sheep = np.asarray(jax.vmap(env.herd.there)(states.data)).sum(axis=1).reshape(3, 30)
    assert [{*row.tolist()} for row in robots] == [{2, 3, 4}, {2, 3}, {2}]
    assert [{*row.tolist()} for row in sheep] == [{3, 4, 5}, {3, 4}, {3}]


def test_a_policy_with_a_size_is_refused_at_another_one(tmp_path: Path) -> None:
    small = varied(BALL, False)
    large = varied(BALL, True)
    for number, settings in enumerate(
        [{"group": "policy"}, {"network": {**NETWORK, "share_policy": False}}]
    ):
        save_policy(tmp_path / str(number), policy(BALL, small, **settings))
        refuses(
            "policy: .* needs agents 2; the environment has 3",
            load_policy,
            tmp_path / str(number),
            large,
        )
