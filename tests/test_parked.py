"""Episodes in which some robots and sheep take no part, and policies of any size."""

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
from mqe_jax.envs import Moment, make
from mqe_jax.envs.sizes import ENTITIES
from mqe_jax.names import load_policy
from mqe_jax.npc import flock
from mqe_jax.policies.scripted import scripted_policy
from mqe_jax.policies.scripted.cooperative import _sides
from mqe_jax.presets import resolve
from mqe_jax.runs.cast import make_learner
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.policy import TrainedPolicy, save_policy
from mqe_jax.view.stage import Stage
from mqe_jax.viz import cameras, framing, geometry
from mqe_jax.viz.recording import Episode
from tests.inputs import refuses
from tests.training import untrained

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
def sized(task: str, large: bool) -> Any:
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
    env = sized(task, True)
    states = resets(env)(jax.random.split(jax.random.PRNGKey(0), 40), jnp.zeros(40))
    count = np.asarray(states.active).sum(axis=1)
    if task == SHEEP:
        sheep = np.asarray(jax.vmap(env.herd.there)(states.data)).sum(axis=1)
        count = np.where(sheep == SMALL[task]["num_sheep"], count, 0)
    row = int(np.flatnonzero(count == SMALL[task]["num_agents"])[0])
    return jax.tree.map(lambda x: x[row] if np.shape(x)[:1] == (40,) else x, states)


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


@pytest.mark.parametrize("task", [BALL, SHEEP])
def test_nothing_that_a_parked_robot_is_or_does_changes_anything_for_the_others(task: str) -> None:
    env = sized(task, True)
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
    env = sized(task, True)
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
    env = sized(task, True)
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


@pytest.mark.soak
def test_an_update_is_the_same_whatever_parked_robots_are() -> None:
    settings = {
        "num_envs": 4,
        "rollout_steps": 4,
        "ppo.minibatches": 1,
        "ppo.epochs": 2,
        "time_limit_ends": False,
    }
    settings |= {
        "group": ENTITIES,
        "network": {**NETWORK, "critic_input": "privileged"},
        "imitation.teacher": None,
    }
    init, update = make_learner(
        SHEEP, settings, env={**LARGE[SHEEP], "control": "position"}, impl="c"
    )
    state = jax.jit(init)(jax.random.PRNGKey(0))
    update = jax.jit(update)
    assert not np.all(state.rollout.env_state.active)
    other = forged(sized(SHEEP, True), state.rollout.env_state)
    other = dataclasses.replace(state, rollout=state.rollout._replace(env_state=other))
    assert np.any(
        np.asarray(other.rollout.env_state.data.qpos != state.rollout.env_state.data.qpos)
    )
    jax.tree.map(np.testing.assert_array_equal, update(other), update(state))


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


@pytest.mark.parametrize("task", [BALL, SHEEP])
def test_fewer_robots_do_what_they_do_in_a_scene_of_their_number(task: str, tmp_path: Path) -> None:
    """So do the sheep, the scripted policy, and a policy of any size, whose file was written at the
    other size.
    """
    large = sized(task, True)
    small = sized(task, False)
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
    env = sized(BALL, True)
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
    env = sized(task, True)
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
    own = sized(task, False)
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
    small = sized(BALL, False)
    large = sized(BALL, True)
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


@pytest.mark.parametrize("task", [BALL, SHEEP])
def test_shipped_settings_train_a_range_of_sizes(task: str) -> None:
    config: Any = resolve(task, "sizes")
    usual: Any = resolve(task)
    assert (config.group, config.network.name) == (ENTITIES, "blocks")
    assert (
        config.training_env["fewest_agents"] < config.env["num_agents"]
        and "fewest_agents" not in config.env
    )
    assert config.ppo == usual.ppo and config.network.hidden_sizes == usual.network.hidden_sizes
    assert config.train_env.items() >= usual.train_env.items()
