"""Training episodes that start in states of a demonstrator's episodes."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax.demonstrations import Demonstrated
from mqe_jax.envs import make
from mqe_jax.errors import InputError
from mqe_jax.policies import load_policy
from mqe_jax.settings import build
from mqe_jax.train.config import TrainConfig

N = 32


@pytest.fixture(scope="module")
def rollout() -> tuple[Any, dict[str, Any]]:
    """A batch of short episodes, and its states over two time limits for assistance 0 and 1, leading axis time."""
    task = make("go1plane", impl="c", num_envs=N, control="position", episode_length=0.64)
    env = Demonstrated(task, N, load_policy("random", task))

    @jax.jit
    def run(assistance: jax.Array) -> Any:
        state = env.reset(jax.random.PRNGKey(1))
        state = dataclasses.replace(state, assistance=jnp.full(N, assistance))
        action = jnp.zeros((N, env.num_agents, env.action_size))

        def advance(state: Any, _: None) -> Any:
            state = env.step(state, action)
            return state, (state.step, state.data.qpos, state.truncated | state.terminated)

        last, seen = jax.lax.scan(advance, state, None, length=2 * env.max_episode_steps)
        return last.demonstrations, seen

    return env, {name: run(jnp.asarray(level)) for name, level in (("none", 0.0), ("all", 1.0))}


def test_episodes_start_in_demonstrated_states(rollout: Any) -> None:
    """With assistance 1 every new episode starts in a recorded state, with the time that was left to it."""
    env, runs = rollout
    demonstrations, (step, qpos, done) = runs["all"]
    recorded = demonstrations["step"], demonstrations["data"]["qpos"]
    moments = {(int(s), *np.asarray(q)) for s, q in zip(*recorded, strict=True)}
    starts = {(int(step[t, i]), *np.asarray(qpos[t, i])) for t, i in np.argwhere(np.asarray(done))}
    assert len(starts) > N and starts <= moments
    assert len({start[0] for start in starts}) > 5
    assert np.all(np.asarray(step) <= env.max_episode_steps)


def test_without_assistance_episodes_start_as_the_task_does(rollout: Any) -> None:
    """With assistance 0 no episode starts in a recorded state."""
    _, (step, _, done) = rollout[1]["none"]
    assert np.asarray(done).any() and not np.asarray(step)[np.asarray(done)].any()


def test_demonstrations_do_not_depend_on_the_key(rollout: Any) -> None:
    """Two runs of a task have the same demonstrations."""
    env, runs = rollout
    other = jax.jit(lambda key: env.reset(key).demonstrations)(jax.random.PRNGKey(2))
    jax.tree.map(np.testing.assert_array_equal, other, runs["all"][0])


def test_a_demonstrator_needs_assistance() -> None:
    """A demonstrator that would never be used is refused."""
    with pytest.raises(InputError, match=r"curriculum\.assistance.*above 0"):
        build(TrainConfig, {"task": "go1gate", "curriculum": {"demonstrator": "scripted"}})
