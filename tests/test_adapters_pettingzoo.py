"""The PettingZoo adapter against PettingZoo's own tests."""

from __future__ import annotations

import functools
import importlib
import pickle
import sys
import types
import warnings
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pettingzoo", reason="needs the extra pettingzoo")

from pettingzoo.test import max_cycles_test, parallel_api_test, parallel_seed_test

from mqe_jax.adapters import pettingzoo as adapter
from mqe_jax.envs import tasks
from mqe_jax.errors import InputError

# The time limit of test_adapters_gymnasium.py: in one process the compiled functions are shared.
SHORT: dict[str, Any] = {"episode_length": 5 * 0.02, "impl": "c"}
TASKS = ["go1gate", *(pytest.param(task, marks=pytest.mark.soak) for task in tasks() if task != "go1gate")]


@pytest.mark.parametrize("task", TASKS)
def test_parallel_api(task: str) -> None:
    """PettingZoo's parallel_api_test passes without a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parallel_api_test(adapter.parallel_env(task, **SHORT), num_cycles=12)


@pytest.mark.parametrize("task", TASKS)
def test_parallel_seed(task: str) -> None:
    """PettingZoo's parallel_seed_test: the same seed gives the same episode, exactly."""
    parallel_seed_test(functools.partial(adapter.parallel_env, task, **SHORT), num_cycles=10)


@pytest.mark.parametrize("task", TASKS)
def test_max_cycles(task: str) -> None:
    """PettingZoo's max_cycles_test, on the module for the default task, else on its two functions for the task."""
    module = types.SimpleNamespace(
        parallel_env=functools.partial(adapter.parallel_env, task), env=functools.partial(adapter.env, task)
    )
    max_cycles_test(adapter if task == "go1gate" else module)


def test_steps_of_both_forms() -> None:
    """Agents are named robot_i with their own rewards and infos, end together, and an ended episode has no agents."""
    env = adapter.parallel_env("go1gate", **SHORT)
    obs, infos = env.reset(seed=3)
    assert env.agents == env.possible_agents == ["robot_0", "robot_1"] == list(obs)
    assert env.teams == (("robot_0", "robot_1"),) and infos == {"robot_0": {}, "robot_1": {}}
    assert env.state() in env.state_space
    zero = {agent: np.zeros(3, np.float32) for agent in env.agents}
    for _ in range(4):
        obs, reward, *_ = env.step(zero)
        assert set(obs) == set(reward) == set(env.possible_agents)
        assert all(obs[agent] in env.observation_space(agent) for agent in obs)
    *_, terminated, truncated, infos = env.step(zero)
    assert truncated == {"robot_0": True, "robot_1": True} and not any(terminated.values())
    assert infos["robot_0"]["success"] == 0.0 and infos["robot_0"] is not infos["robot_1"]
    assert env.agents == [] and env.step({}) == ({}, {}, {}, {}, {})
    env.close()


def test_teams_and_zero_sum_rewards_of_a_match() -> None:
    """A match has two teams, by name."""
    env = adapter.parallel_env("go1tug", impl="c")
    assert env.teams == (("robot_0",), ("robot_1",)) and env.metadata["name"] == "go1tug"


def test_pettingzoo_knows_the_tasks_by_name() -> None:
    """In both registries, once however often the module registers."""
    import pettingzoo

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        adapter.register()
        env = pettingzoo.make("parallel", "mqe/go1sheep-easy-v0", impl="c", control="position")
    assert env.metadata["name"] == "go1sheep-easy"
    assert {f"mqe/{task}-v0" for task in tasks()} <= set(pettingzoo.parallel_registry) & set(pettingzoo.aec_registry)


def test_a_copy_is_a_new_environment_with_the_same_settings() -> None:
    """Vectorisers copy environments by pickling them."""
    env = adapter.parallel_env("go1gate", **SHORT)
    copy = pickle.loads(pickle.dumps(env))
    assert copy.task is not env.task and copy.task.params == env.task.params
    np.testing.assert_array_equal(copy.reset(seed=1)[0]["robot_0"], env.reset(seed=1)[0]["robot_0"])


def test_render() -> None:
    """An image in the mode rgb_array, otherwise none."""
    env = adapter.parallel_env("go1gate", render_mode="rgb_array", render_size=(96, 64), **SHORT)
    env.reset(seed=0)
    image = env.render()
    assert image is not None and image.shape == (64, 96, 3) and image.std() > 5
    assert adapter.parallel_env("go1gate", **SHORT).render() is None


def test_bad_input_is_named() -> None:
    """Actions of the wrong agents, a state before the reset, an unknown mode, two time limits."""
    env = adapter.parallel_env("go1gate", **SHORT)
    with pytest.raises(InputError, match="reset the environment first"):
        env.state()
    env.reset(seed=0)
    with pytest.raises(InputError, match=r"actions: for \['robot_0'\]; expected one for each of robot_0, robot_1"):
        env.step({"robot_0": np.zeros(3, np.float32)})
    with pytest.raises(InputError, match="render_mode: 'human'"):
        adapter.parallel_env(render_mode="human")
    with pytest.raises(InputError, match=r"max_cycles: -1 is not allowed; .* greater than 0"):
        adapter.parallel_env("go1gate", max_cycles=-1, impl="c", control="position")
    with pytest.raises(InputError, match="episode_length: give either this or max_cycles"):
        adapter.parallel_env("go1gate", max_cycles=4, **SHORT)
    with pytest.raises(InputError, match="need the id of a task"):
        adapter.parallel_env(env.task, max_cycles=4)


def test_without_the_library_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Importing the adapter names the extra to install."""
    monkeypatch.setitem(sys.modules, "pettingzoo", None)
    monkeypatch.delitem(sys.modules, "mqe_jax.adapters.pettingzoo")
    with pytest.raises(InputError, match=r"pip install 'mqe-jax\[pettingzoo\]'"):
        importlib.import_module("mqe_jax.adapters.pettingzoo")
