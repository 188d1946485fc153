"""The worked example of the guide to a new task."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax.envs import PLANNERS, TASKS, VectorEnv, make, register_task
from mqe_jax.errors import InputError
from mqe_jax.planners import planner_of, scripted_policy
from mqe_jax.train.evaluate import evaluate

FILE = Path(__file__).parents[1] / "examples" / "new_task.py"


@pytest.fixture
def example() -> Any:
    """The example's module; its registrations are removed afterwards."""
    spec = importlib.util.spec_from_file_location("new_task", FILE)
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


def test_every_line_of_the_registry_names_a_scripted_policy_that_exists() -> None:
    """All tasks but the plane have one, of a module of their own package."""
    assert set(TASKS) - set(PLANNERS) == {"go1plane"}
    for task in PLANNERS:
        assert planner_of(task).__module__.startswith("mqe_jax.planners.")
    with pytest.raises(InputError, match=r"go1plane has no scripted policy; allowed for: go1gate, "):
        planner_of("go1plane")


def test_a_taken_or_missing_id_is_refused() -> None:
    with pytest.raises(ValueError, match="the id 'go1gate' is already registered by Go1Gate"):
        register_task(type("Other", (TASKS["go1plane"],), {"name": "go1gate"}))
    with pytest.raises(ValueError, match="its `name` is empty"):
        register_task(type("Nameless", (TASKS["go1plane"],), {"name": ""}))
