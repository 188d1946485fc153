"""Pickled environments, adapters and policies, as a spawned process gets them: the copy acts as the original."""

import pickle
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import pytest

import mqe_jax.adapters.gymnasium  # noqa: F401  (registers the tasks)
from mqe_jax.core.settings import build
from mqe_jax.envs import QuadrupedEnv, VectorEnv, make
from mqe_jax.envs.wrappers import Deadline
from mqe_jax.policies import all_agents, load_policy
from mqe_jax.selfplay.demonstrations import Demonstrated
from mqe_jax.selfplay.league.league import League
from mqe_jax.selfplay.league.sides import BothSides
from mqe_jax.selfplay.opponents import Mirror, versus
from mqe_jax.train.config import TrainConfig
from tests.states import made
from tests.training import assert_same

KEY = jax.random.PRNGKey(0)
PLANE: dict[str, Any] = {"impl": "c", "control": "position"}


def copied(value: Any) -> Any:
    return pickle.loads(pickle.dumps(value))


def walking(task: str) -> QuadrupedEnv:
    return make(task, impl="c", num_envs=2)


def matches() -> VectorEnv:
    return VectorEnv(walking("go1wrestling"), 2)


def league() -> Any:
    values = {"num_envs": 2, "rollout_steps": 2, "total_steps": 8, "opponents": ["newest", "older"]}
    return copied(League(matches(), ["newest", "older"], build(TrainConfig, values))).env


BATCHES: dict[str, Callable[[], Any]] = {
    "vector": lambda: VectorEnv(made("go1plane"), 2),
    "deadline": lambda: Deadline(VectorEnv(made("go1plane"), 2)),
    "demonstrated": lambda: Demonstrated(walking("go1gate"), 2, load_policy("scripted", walking("go1gate"))),
    "versus": lambda: versus(matches(), ["go1wrestling", "scripted"]),
    "mirror": lambda: Mirror(matches()),
    "both sides": lambda: BothSides(matches()),
    "league": league,
}


@pytest.mark.parametrize("name", BATCHES)
def test_batches(name: str) -> None:
    """Programs are compared as text: most take long to compile."""
    batch = BATCHES[name]()
    action = jnp.zeros((batch.num_envs, batch.num_agents, batch.action_size))
    programs = []
    for each in (batch, copied(batch)):
        state = jax.eval_shape(each.reset, KEY)
        programs.append(f"{jax.make_jaxpr(each.reset)(KEY)} {jax.make_jaxpr(each.step)(state, action)}")
    assert programs[0] == programs[1]


@pytest.mark.parametrize("name", ["scripted", "random", "idle", "forward", "go1wrestling", "both"])
def test_policies(name: str) -> None:
    env = walking("go1wrestling")
    policy = load_policy("scripted" if name == "both" else name, env)
    policy = all_agents(env, policy, load_policy("go1wrestling", env)) if name == "both" else policy
    obs = jax.random.normal(KEY, (2, policy.agents, env.observation_size))
    one, other = (each.act(obs, each.initial_memory(2), KEY) for each in (policy, copied(policy)))
    assert_same(one, other)
