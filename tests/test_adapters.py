"""The Gymnasium adapter against Gymnasium's own checks and vector environment; matches against an
opponent.
"""

import dataclasses
import importlib
import os
import shutil
import subprocess
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.vector import AutoresetMode

import mqe_jax
from mqe_jax.adapters import task_env, team_reward
from mqe_jax.adapters.gymnasium import SingleEnv, VectorEnv, register
from mqe_jax.adapters.host import HostEnvs
from mqe_jax.adapters.opponent import TeamEnv
from mqe_jax.envs import tasks
from mqe_jax.envs.autoreset import autoreset
from mqe_jax.envs.gate import Go1Gate
from mqe_jax.envs.registry import TASKS as TASK_CLASSES
from mqe_jax.envs.registry import register_task
from mqe_jax.names import versus
from mqe_jax.policies.simple import SimplePolicy
from mqe_jax.skills.weights import ASSETS
from tests.inputs import refuses
from tests.test_opponents import new_policy

COUNT = 3
STEPS = 14
ENDS = 5
SEED = 7
# The time limit ends the episodes, at the same step under every version of the physics.
SHORT: dict[str, Any] = {"episode_length": ENDS * 0.02}
TASKS = [
    "go1gate",
    *(pytest.param(task, marks=pytest.mark.soak) for task in tasks() if task != "go1gate"),
]


def close(one: Any, other: Any) -> bool:
    """Whether two nested infos agree, with a tolerance for the order of floating-point sums in
    batches.
    """
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(close(one[k], other[k]) for k in one)
    if isinstance(one, np.ndarray) and one.dtype == object:
        return all(close(a, b) for a, b in zip(one, other, strict=True))
    if isinstance(one, np.ndarray):
        return (
            one.dtype == other.dtype
            and one.shape == other.shape
            and np.allclose(one, other, rtol=1e-3, atol=1e-3)
        )
    return data_equivalence(one, other)


def actions(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, shape).astype(np.float32)


@pytest.mark.parametrize("task", TASKS)
def test_environment_checker(task: str) -> None:
    env: Any = gymnasium.make(f"mqe/{task}-v0", impl="c", **SHORT)
    assert isinstance(env.unwrapped, SingleEnv)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env.unwrapped, skip_render_check=True)
    told = [str(w.message) for w in caught if "infinity" not in str(w.message)]
    assert told == []


@pytest.mark.parametrize("task", TASKS)
def test_single_environment_is_the_task(task: str) -> None:
    env: Any = gymnasium.make(f"mqe/{task}-v0", impl="c", **SHORT).unwrapped
    obs, info = env.reset(seed=SEED)
    state = jax.jit(env.env.reset)(jax.random.PRNGKey(SEED))
    np.testing.assert_allclose(obs, state.obs, atol=1e-5)
    assert info == {}
    action = actions(0, *env.action_space.shape)
    obs, reward, terminated, truncated, info = env.step(action)
    assert obs.shape == env.observation_space.shape and obs.flags.writeable
    assert (terminated, truncated) == (False, False)
    team = list(env.env.teams[0])
    assert reward == pytest.approx(info["agent_rewards"][team].mean())
    assert {"success", "average_step_reward"} <= set(info)


@pytest.mark.parametrize(
    "mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP], ids=["same", "next"]
)
@pytest.mark.parametrize("task", TASKS)
def test_vector_environment_follows_sync_vector_env(task: str, mode: AutoresetMode) -> None:
    name = f"mqe/{task}-v0"
    ours: Any = gymnasium.make_vec(name, COUNT, impl="c", autoreset_mode=mode, **SHORT)
    theirs = gymnasium.make_vec(
        name,
        COUNT,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": mode},
        impl="c",
        **SHORT,
    )
    assert isinstance(ours.unwrapped, VectorEnv)
    assert ours.metadata["autoreset_mode"] is theirs.metadata["autoreset_mode"] is mode
    for attribute in (
        "observation_space",
        "action_space",
        "single_observation_space",
        "single_action_space",
    ):
        assert getattr(ours, attribute) == getattr(theirs, attribute)
    resets = ended = 0
    first = ours.reset(seed=SEED)
    second = theirs.reset(seed=SEED)
    assert close(first[0], second[0]) and first[1] == second[1] == {}
    for step in range(STEPS):
        if step == 2:  # so that the environments' episodes end at different times
            mask = np.arange(COUNT) == 1
            first = ours.reset(options={"reset_mask": mask.copy()})
            second = theirs.reset(options={"reset_mask": mask.copy()})
            assert close(first[0], second[0])
        action = actions(step, *ours.action_space.shape)
        first = ours.step(action)
        second = theirs.step(action)
        for one, other in zip(first[:4], second[:4], strict=True):
            assert one.dtype == other.dtype
            assert close(one, other), step
        assert close(first[4], second[4]), (step, first[4], second[4])
        over = first[2] | first[3]
        ended += int(over.any() and not over.all())
        resets += int(over.sum())
    assert resets >= 2 * COUNT - 1 and ended >= 2


def test_disabled_autoreset_and_time_limit() -> None:
    vector: Any = gymnasium.make_vec(
        "mqe/go1gate-v0", COUNT, impl="c", autoreset_mode="Disabled", max_episode_steps=ENDS
    )
    vector.reset(seed=SEED)
    zero = np.zeros(vector.action_space.shape, np.float32)
    for step in range(ENDS):
        truncated = vector.step(zero)[3]
        assert truncated.all() == (step == ENDS - 1)
    refuses(r"reset environments \[0 1 2\]", vector.step, zero)
    vector.reset()
    assert not vector.step(zero)[3].any()


def test_render_returns_images() -> None:
    settings: dict[str, Any] = {"impl": "c", "render_size": (96, 64), **SHORT}
    single = SingleEnv("go1gate", render_mode="rgb_array", **settings)
    single.reset(seed=SEED)
    image = single.render()
    assert (
        image is not None
        and image.shape == (64, 96, 3)
        and image.dtype == np.uint8
        and image.std() > 5
    )
    vector: Any = VectorEnv("go1gate", COUNT, render_mode="rgb_array", **settings)
    vector.reset(seed=SEED)
    images = vector.render()
    assert images is not None and [i.shape for i in images] == [(64, 96, 3)] * COUNT
    assert SingleEnv("go1gate", **settings).render() is None


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        (
            {"autoreset_mode": "later"},
            "autoreset_mode: 'later' is not allowed; it must be one of NextStep, SameStep",
        ),
        ({"render_mode": "human"}, "render_mode: 'human' is not allowed; it must be 'rgb_array'"),
        ({"num_envs": 0}, "num_envs: 0 is not allowed; .* greater than 0"),
        ({"num_envs": 1.5}, r"num_envs: 1\.5 is not allowed; .* a valid integer"),
        ({"max_episode_steps": 0}, "max_episode_steps: 0 is not allowed; .* greater than 0"),
        ({"gate": 1}, "gate"),
    ],
)
def test_bad_settings_are_named(settings: dict[str, Any], told: str) -> None:
    refuses(told, VectorEnv, "go1gate", **{"num_envs": 2, "impl": "c", **settings})


def test_bad_calls_are_named() -> None:
    vector: Any = VectorEnv("go1gate", COUNT, impl="c", **SHORT)
    action = np.zeros(vector.action_space.shape, np.float32)
    refuses("reset the environment first", vector.step, action)
    vector.reset(seed=SEED)
    refuses(r"action: shape \(2, 2, 3\); expected \(3, 2, 3\)", vector.step, action[:2])
    refuses("NaN or infinity", vector.step, action * np.nan)
    single = SingleEnv("go1gate", impl="c", **SHORT)
    said = r"action: shape \(3,\); expected \(2, 3\) \(agents, action size\)"
    refuses(said, single.step, action[0, 0])
    for seed in ([1, 2], 1.5, "abc"):
        refuses(r"seed: .*3 integers", vector.reset, seed=seed)
    refuses(r"seed: 4294967296 is not allowed", vector.reset, seed=2**32)
    refuses("reset_mask", vector.reset, options={"reset_mask": np.zeros(COUNT, bool)})


def test_every_task_is_registered() -> None:
    register()
    assert {f"mqe/{task}-v0" for task in tasks()} <= set(gymnasium.registry)
    code = (
        "import gymnasium; print(gymnasium.make('mqe_jax.adapters.gymnasium:mqe/go1gate-v0', "
        "impl='c'))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "SingleEnv<mqe/go1gate-v0>" in out.stdout


def test_a_task_of_ones_own_is_registered() -> None:
    name = "own-gate"
    register_task(type("OwnGate", (Go1Gate,), {"name": name}))
    env: Any = gymnasium.make(f"mqe/{name}-v0", impl="c")
    assert env.unwrapped.env.name == name
    del TASK_CLASSES[name]
    del gymnasium.registry[f"mqe/{name}-v0"]


def test_a_forked_process_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without it, `make_vec(vectorization_mode="async")` waits for ever."""
    task_env("go1gate", impl="c")
    child = os.getpid() + 1
    monkeypatch.setattr(os, "getpid", lambda: child)
    refuses("JAX would hang in a forked process; .*'context': 'spawn'", SingleEnv, "go1gate")


def match(task: str = "go1wrestling", **settings: Any) -> Any:
    return mqe_jax.make(task, impl="c", control="position", episode_length=ENDS * 0.02, **settings)


def counting(task: str, act: float = 0.5) -> SimplePolicy:
    return SimplePolicy(task, 1, lambda obs, key: jnp.full((len(obs), 1, 12), act))


def test_team_0_plays_the_same_match_and_sees_its_own_half() -> None:
    """States, observations, rewards and metrics are those of the match in which team 1 acts as the
    opponent does.
    """
    env = match()
    team = TeamEnv(env, counting("go1wrestling"))
    assert (team.num_agents, team.teams, team.name, team.max_steps) == (
        1,
        ((0,),),
        "go1wrestling",
        ENDS,
    )
    assert team.action_space.shape == (1, 12) and team.observation_space.shape == (
        1,
        env.observation_size,
    )
    key = jax.random.PRNGKey(0)
    whole = jax.jit(env.reset)(key)
    half = jax.jit(team.reset)(key)
    action = jnp.linspace(-1.0, 1.0, 12)[None]
    step = jax.jit(team.step)
    play = jax.jit(env.step)
    for _ in range(ENDS):
        whole = play(whole, jnp.concatenate([action, jnp.full((1, 12), 0.5)]))
        half = step(half, action)
        np.testing.assert_allclose(half.data.qpos, whole.data.qpos, atol=1e-5)
        np.testing.assert_allclose(half.obs, whole.obs[:1], atol=1e-5)
        np.testing.assert_allclose(half.rival_groups["policy"], whole.obs, atol=1e-5)
        np.testing.assert_allclose(half.reward, whole.reward[:1], atol=1e-6)
    assert bool(half.truncated)
    assert set(half.metrics) == {name for name in whole.metrics if not name.startswith("team1/")}
    assert half.outcome.win.shape == (1,)
    restarted: Any = jax.jit(lambda state: autoreset(team, state))(half)  # type: ignore[arg-type]
    assert int(restarted.step) == 0
    assert restarted.rival_groups["policy"].shape == half.rival_groups["policy"].shape
    assert np.abs(restarted.obs - half.obs).max() > 1e-4
    np.testing.assert_array_equal(restarted.final_obs, half.obs)


def test_an_opponent_may_see_another_group() -> None:
    """It acts by the gravity in its own frame; the match gets that action."""

    class Falling:
        task = "go1wrestling"
        agents = 1
        groups = ("proprioception",)

        def initial_memory(self, num_envs: int) -> Any:
            return ()

        def act(self, obs: Any, memory: Any, key: Any) -> Any:
            gravity = obs.group("proprioception")[..., 2:3]
            return jnp.broadcast_to(0.5 * gravity, (*gravity.shape[:2], 12)), memory

    env = match()
    team: Any = TeamEnv(env, Falling())
    key = jax.random.PRNGKey(0)
    state = jax.jit(team.reset)(key)
    assert {*state.groups} == {"policy", "proprioception"}
    rival = 0.5 * state.rival_groups["proprioception"][1, 2]
    own = jnp.zeros((1, 12))
    whole = jnp.concatenate([own, jnp.full((1, 12), rival)])
    expected = jax.jit(env.step)(jax.jit(env.reset)(key), whole)
    found = jax.jit(team.step)(state, own)
    np.testing.assert_allclose(found.data.qpos, expected.data.qpos, atol=1e-5)


def test_an_opponent_knows_which_robots_take_part() -> None:
    """Its actions say what it knows; the match gets them."""

    class Counting:
        task = "go1wrestling"
        agents = 2
        groups = ("policy",)

        def initial_memory(self, num_envs: int) -> Any:
            return ()

        def act(self, obs: Any, memory: Any, key: Any) -> Any:
            present = jnp.sum(obs.active, axis=1)[:, None, None]
            return jnp.broadcast_to(0.3 * present, (*obs.active.shape, 12)), memory

    env = match(num_agents=4, fewest_agents=2)
    team: Any = TeamEnv(env, Counting())
    states = jax.jit(jax.vmap(team.reset))(jax.random.split(jax.random.PRNGKey(0), 6))
    present = np.asarray(states.active).sum(axis=1)
    assert {*present.tolist()} == {1, 2} and states.active.shape == (6, 2)
    own = jnp.zeros((6, 2, 12))
    rivals = jnp.broadcast_to(0.3 * present[:, None, None], own.shape)
    wholes = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 6))
    step = jax.jit(jax.vmap(env.step))
    expected = step(wholes, jnp.concatenate([own, rivals], axis=1))
    found = jax.jit(jax.vmap(team.step))(states, own)
    np.testing.assert_allclose(found.data.qpos, expected.data.qpos, atol=1e-5)
    np.testing.assert_allclose(found.obs, expected.obs[:, :2], atol=1e-5)
    np.testing.assert_array_equal(found.active, states.active)


def test_a_team_is_rewarded_for_those_who_take_part() -> None:
    env: Any = SimpleNamespace(teams=((0, 1), (2, 3)))
    reward = np.array([[1.0, 3.0, 9.0, 9.0], [1.0, 0.0, 9.0, 9.0]])
    active = np.array([[True] * 4, [True, False, True, False]])
    np.testing.assert_array_equal(team_reward(env, reward, active), [2.0, 1.0])
    np.testing.assert_array_equal(team_reward(env, jnp.asarray(reward), active), [2.0, 1.0])


def test_opponents_of_one_form_share_a_program(monkeypatch: pytest.MonkeyPatch) -> None:
    """As do opponents of one name."""
    traced = []
    step = TeamEnv.advance

    def counted(env: TeamEnv, state: Any, action: Any) -> Any:
        traced.append(env)
        return step(env, state, action)

    monkeypatch.setattr(TeamEnv, "advance", counted)
    env = match("go1tug")
    policies = [new_policy(versus(mqe_jax.VectorEnv(env, 2), ["idle"]), seed) for seed in (0, 1)]
    ended = []
    for opponent in (*policies, "forward", "forward"):
        host: Any = HostEnvs(TeamEnv(env, opponent), 2)
        host.reset([0, 1], np.random.default_rng(0))
        host.step(np.zeros((2, 1, 12)))
        ended.append(np.asarray(host.state.rival_groups["policy"]))
    assert len(traced) == 2
    assert np.any(ended[0] != ended[1])
    np.testing.assert_array_equal(ended[2], ended[3])


def test_environments_share_a_program_only_if_they_act_alike(tmp_path: Path) -> None:
    """Those of an id do unless a weights file has changed; a passed one has its own."""
    file = tmp_path / "walk.safetensors"
    shutil.copy(ASSETS / "walk_go1.safetensors", file)
    named: dict[str, Any] = {"impl": "c", "num_envs": 1, "skill_weights": str(file)}

    def program(task: Any, **settings: Any) -> Any:
        begin, _ = SingleEnv(task, **settings)._host._programs
        return begin.func  # pyright: ignore[reportFunctionMemberAccess]

    first = program("go1tug", **named)
    assert program("go1tug", **named) is first
    assert program("go1tug", **{**named, "impl": "jax"}) is not first
    env = mqe_jax.make("go1tug", **named)
    assert program(env) is program(env) is not first
    assert program(mqe_jax.make("go1tug", **named)) is not program(env)
    file.write_bytes((ASSETS / "walk_go2.safetensors").read_bytes())
    assert program("go1tug", **named) is not first
    changed: Any = SingleEnv("go1tug", impl="c", num_envs=1)
    changed.env.weights = dataclasses.replace(changed.env.weights, push=9.0)
    assert changed._host._programs[0].func is not program("go1tug", impl="c", num_envs=1)


def test_a_shipped_opponent_adds_its_memory_to_the_state() -> None:
    team: Any = task_env("go1wrestling", opponent="go1wrestling", impl="c")
    assert team.match.params.skill == "agile"
    shapes: Any = jax.eval_shape(team.reset, jax.random.PRNGKey(0))
    assert [x.shape[0] for x in jax.tree.leaves(shapes.rival_memory)] == [1] * len(
        jax.tree.leaves(shapes.rival_memory)
    )
    after: Any = jax.eval_shape(team.step, shapes, jnp.zeros((1, 3)))
    assert jax.tree.structure(after) == jax.tree.structure(shapes)


OPPOSED = {
    "gymnasium": lambda its, **of: (
        gymnasium.make_vec("mqe/go1wrestling-v0", 2, **of).single_action_space.shape == (1, 12)
    ),
    "pettingzoo": lambda its, **of: (
        its.parallel_env("go1wrestling", **of).possible_agents == ["robot_0"]
    ),
    "brax": lambda its, **of: its.Env("go1wrestling", **of).action_size == 12,
    "jaxmarl": lambda its, **of: its.Env("go1wrestling", **of).agents == ["robot_0"],
}


@pytest.mark.parametrize("library", OPPOSED)
def test_every_adapter_takes_an_opponent(library: str) -> None:
    pytest.importorskip(library, reason=f"needs the extra {library}")
    adapter = importlib.import_module(f"mqe_jax.adapters.{library}")
    assert OPPOSED[library](adapter, opponent="idle", impl="c", control="position")


def test_bad_opponents_are_named() -> None:
    env = match()
    refuses(
        "opponent: go1gate is not a match; omit the opponent",
        task_env,
        "go1gate",
        opponent="idle",
        impl="c",
        control="position",
    )
    refuses("opponent: unknown 'scriptd'", task_env, env, opponent="scriptd")
    team = TeamEnv(env, "idle")
    refuses(
        r"action: shape \(2, 12\); expected \(1, 12\)",
        jax.eval_shape,
        team.step,
        jax.eval_shape(team.reset, jax.random.PRNGKey(0)),
        jnp.zeros((2, 12)),
    )
