"""The examples: a new task, a custom environment, a custom network and self-play, at a small size."""

from __future__ import annotations

import importlib
import importlib.util
import runpy
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax.envs import PLANNERS, TASKS, VectorEnv, make
from mqe_jax.planners import scripted_policy
from mqe_jax.train.evaluate import evaluate
from mqe_jax.train.networks import NETWORKS

EXAMPLES = Path(__file__).parent.parent / "examples"


@pytest.fixture(autouse=True)
def script_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    """Examples run as scripts, with their own folder on the import path."""
    monkeypatch.syspath_prepend(str(EXAMPLES))


@pytest.fixture
def example() -> Any:
    """The module of the guide to a new task; its registrations are removed afterwards."""
    spec = importlib.util.spec_from_file_location("new_task", EXAMPLES / "new_task.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["new_task"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["new_task"], TASKS["go1catch"], PLANNERS["go1catch"]


def test_the_example_can_be_solved_and_its_parts_behave_as_documented(example: Any) -> None:
    env = VectorEnv(make("go1catch", impl="c", num_envs=8), 8)
    plan = jax.vmap(scripted_policy(env.env))
    result = evaluate(env, lambda obs, memory, _: (plan(obs), memory), 8, jax.random.PRNGKey(0))
    assert result.success_rate >= 0.5
    idle = evaluate(env, lambda obs, memory, _: (jnp.zeros((8, 1, 3)), memory), 8, jax.random.PRNGKey(0))
    assert idle.success_rate == 0
    np.testing.assert_allclose(
        example.flee(jnp.array([3.0, 1.0]), jnp.array([3.0, 0.0]), speed=0.4), [0, 0.4], atol=1e-6
    )
    np.testing.assert_allclose(example.flee(jnp.array([3.0, 2.0]), jnp.array([3.0, 0.0]), speed=0.4), [0, 0])
    pillar = env.env.compiled.model.geom("wall/pillar1")
    np.testing.assert_allclose(pillar.pos[:2], [2.5, 0.0])


def test_an_environment_of_ones_own_is_trained() -> None:
    example: dict[str, Any] = runpy.run_path(str(EXAMPLES / "foreign_env.py"))
    history = example["main"](num_envs=32, updates=25)
    assert len(history) == 25 and history[-1] < 0.6 * history[0]


def test_a_network_of_ones_own_is_trained() -> None:
    runpy.run_path(str(EXAMPLES / "custom_network.py"))
    try:
        foreign_env = importlib.import_module("foreign_env")

        history = foreign_env.main(num_envs=32, updates=25, network={"name": "mean_field", "width": 32})
    finally:
        NETWORKS.pop("mean_field")
    assert history[-1] < 0.6 * history[0]


def test_self_play_trains_against_a_snapshot_and_a_scripted_opponent() -> None:
    example: dict[str, Any] = runpy.run_path(str(EXAMPLES / "self_play.py"))
    results = example["main"](num_envs=4, updates=3, snapshot_every=2, episodes=4)
    assert len(results) == 2
    assert all(sum(result.match.values()) == pytest.approx(1.0) for result in results)
