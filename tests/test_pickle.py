"""Pickled environments, adapters and policies, as a spawned process gets them: the copy acts as the original."""

import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
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


def test_another_process_steps_environments_and_policies_alike(tmp_path: Path) -> None:
    """Gymnasium's copies keep their state."""
    env, file = make("go1plane", num_envs=2, **PLANE), tmp_path / "all"
    single = gymnasium.make("mqe/go1wrestling-v0", opponent="random", **PLANE)
    several = gymnasium.make_vec("mqe/go1plane-v0", num_envs=2, **PLANE)
    for each in (single, several):
        each.reset(seed=0)
    everything = env, load_policy("random", env), single, several
    code = """
import pathlib, pickle, sys
import jax, numpy as np
def step(env, policy, *adapters):
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    action, _ = policy.act(state.obs[None], (), jax.random.PRNGKey(0))
    after = [np.asarray(jax.jit(env.step)(state, action[0]).data.qpos)]
    return after + [each.step(np.full(each.action_space.shape, 0.1, np.float32))[0] for each in adapters]
if __name__ == "__main__":
    file = pathlib.Path(sys.argv[1])
    file.write_bytes(pickle.dumps(step(*pickle.loads(file.read_bytes()))))
"""
    file.write_bytes(pickle.dumps(everything))
    subprocess.run([sys.executable, "-c", code, str(file)], check=True)
    here: dict[str, Any] = {}
    exec(code, here)
    for one, other in zip(here["step"](*everything), pickle.loads(file.read_bytes()), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5)
