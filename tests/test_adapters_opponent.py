"""Matches against an opponent through the adapters: the trainer sees team 0 alone."""

from __future__ import annotations

import importlib
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mqe_jax
from mqe_jax.adapters import task_env
from mqe_jax.adapters.host import HostEnvs, _compile
from mqe_jax.adapters.opponent import TeamEnv
from mqe_jax.envs.autoreset import autoreset
from mqe_jax.errors import InputError
from mqe_jax.policies import SimplePolicy

LIMIT = 3


def match(task: str = "go1wrestling", **settings: Any) -> Any:
    return mqe_jax.make(task, impl="c", control="position", episode_length=LIMIT * 0.02, **settings)


def counting(task: str, act: float = 0.5) -> SimplePolicy:
    """A policy that outputs one number everywhere."""
    return SimplePolicy(task, 1, lambda obs, key: jnp.full((len(obs), 1, 12), act))


def test_team_0_plays_the_same_match_and_sees_its_own_half() -> None:
    """States, observations, rewards and metrics are those of the match in which team 1 acts as the opponent does."""
    env = match()
    team = TeamEnv(env, counting("go1wrestling"))
    assert (team.num_agents, team.teams, team.name, team.max_steps) == (1, ((0,),), "go1wrestling", LIMIT)
    assert team.action_space.shape == (1, 12) and team.observation_space.shape == (1, env.observation_size)
    key = jax.random.PRNGKey(0)
    whole, half = jax.jit(env.reset)(key), jax.jit(team.reset)(key)
    action = jnp.linspace(-1.0, 1.0, 12)[None]
    step, play = jax.jit(team.step), jax.jit(env.step)
    for _ in range(LIMIT):
        whole, half = play(whole, jnp.concatenate([action, jnp.full((1, 12), 0.5)])), step(half, action)
        np.testing.assert_allclose(half.data.qpos, whole.data.qpos, atol=1e-5)
        np.testing.assert_allclose(half.obs, whole.obs[:1], atol=1e-5)
        np.testing.assert_allclose(half.rival_obs, whole.obs[1:], atol=1e-5)
        np.testing.assert_allclose(half.reward, whole.reward[:1], atol=1e-6)
    assert bool(half.truncated)
    assert set(half.metrics) == {name for name in whole.metrics if not name.startswith("team1/")}
    restarted: Any = jax.jit(lambda state: autoreset(team, state))(half)  # type: ignore[arg-type]
    assert int(restarted.step) == 0 and restarted.rival_obs.shape == half.rival_obs.shape
    assert np.abs(restarted.obs - half.obs).max() > 1e-4
    np.testing.assert_array_equal(restarted.final_obs, half.obs)


def test_a_shipped_opponent_adds_its_memory_to_the_state() -> None:
    """With a leading axis of one environment; a step keeps the structure of the state."""
    env = mqe_jax.make("go1wrestling", impl="c")
    team = TeamEnv(env, "go1wrestling")
    shapes: Any = jax.eval_shape(team.reset, jax.random.PRNGKey(0))
    assert [x.shape[0] for x in jax.tree.leaves(shapes.rival_memory)] == [1] * len(jax.tree.leaves(shapes.rival_memory))
    after: Any = jax.eval_shape(team.step, shapes, jnp.zeros((1, 3)))
    assert jax.tree.structure(after) == jax.tree.structure(shapes)


def test_environments_with_the_same_opponent_share_compiled_functions() -> None:
    env = mqe_jax.make("go1wrestling", impl="c", num_envs=1)
    first, second, other = (TeamEnv(env, source) for source in ("go1wrestling", "go1wrestling", "scripted"))
    assert first.identity == second.identity != other.identity
    before = _compile.cache_info()
    hosts = [HostEnvs(team, 1) for team in (first, second, other)]
    after = _compile.cache_info()
    assert (after.misses - before.misses, after.hits - before.hits) == (2, 1)
    assert hosts[0].env is first


def test_every_adapter_takes_an_opponent() -> None:
    """Sizes are those of one team."""
    settings: Any = {"opponent": "idle", "impl": "c", "control": "position"}
    vector: Any = gymnasium.make_vec("mqe_jax.adapters.gymnasium:mqe/go1wrestling-v0", num_envs=2, **settings)
    assert vector.single_action_space.shape == (1, 12)
    found = 0
    for library in ("pettingzoo", "brax", "jaxmarl"):
        try:
            adapter = importlib.import_module(f"mqe_jax.adapters.{library}")
        except InputError:
            continue
        found += 1
        if library == "pettingzoo":
            env = adapter.parallel_env("go1wrestling", **settings)
            assert env.possible_agents == ["robot_0"] and env.teams == (("robot_0",),)
        elif library == "brax":
            assert adapter.Env("go1wrestling", **settings).action_size == 12
        else:
            assert adapter.Env("go1wrestling", **settings).agents == ["robot_0"]
    if not found:
        pytest.skip("needs one of the extras pettingzoo, brax and jaxmarl")


def test_bad_opponents_are_named() -> None:
    env = match()
    with pytest.raises(InputError, match="opponent: go1gate is not a match; omit the opponent"):
        task_env("go1gate", opponent="idle", impl="c", control="position")
    with pytest.raises(InputError, match="opponent: unknown 'scriptd'"):
        task_env(env, opponent="scriptd")
    with pytest.raises(InputError, match="opponent: a policy of 1 agents on go1tug; go1wrestling needs one of 1"):
        task_env(env, opponent=counting("go1tug"))
    team = TeamEnv(env, "idle")
    with pytest.raises(InputError, match=r"action: shape \(2, 12\); expected \(1, 12\)"):
        jax.eval_shape(team.step, jax.eval_shape(team.reset, jax.random.PRNGKey(0)), jnp.zeros((2, 12)))
