"""Calls of the package's functions with one argument that is not allowed; each must raise an InputError."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import strategies as st

from mqe_jax import load_policy, make, versus
from mqe_jax.adapters import gymnasium
from mqe_jax.envs import VectorEnv, replay
from mqe_jax.robots import get
from mqe_jax.settings import build, load_yaml, override
from mqe_jax.train.config import TrainConfig, load_config
from mqe_jax.train.evaluate import evaluate
from mqe_jax.train.policy import read_policy
from mqe_jax.viz.recording import Episode, record
from mqe_jax.viz.render import render_episode
from mqe_jax.walk.torchscript import read_torchscript
from tests import fake_env, inputs

Strategy = st.SearchStrategy[Any]
NAN, INF = float("nan"), float("inf")
_NO_COUNTS = [NAN, INF, -INF, 1.5, 0, -1, True, None, "many", [], [1], {}, 10**12, b"1", 1j, np.float32(2.5)]
_NO_NAMES = [3, 1.5, True, "", " ", "nope", "\x00", "a" * 5000, b"go1", [], {}, ["go1gate"], object(), NAN]
_NO_TIMES = [NAN, INF, -1.0, 1e300, "long", [], {}, True, 1j]
_NO_PATHS = ["", "/", ".", "/dev/zero", "/dev/full", "/proc/self/mem", "\x00", "nope", "a" * 5000, 3, 1.5, b"a", [], {}]
_NO_SIZES = [(0, 0), (1, 1), (-3, 100), (10**6, 10**6), (100.5, 100), (NAN, 100), (64,), "64x64", (64, 64, 3), 64]
_NO_ACTIONS = [np.zeros((2, 3)), np.zeros((1, 2, 12)), np.full((2, 12), NAN), np.zeros((2, 12), int), None, "go", 3, []]


def but(values: list[Any], *allowed: Any) -> Strategy:
    """Values without those that the argument allows."""
    return st.sampled_from([value for value in values if not any(value is x or value == x for x in allowed)])


COUNTS, NAMES, TIMES, PATHS, SIZES = map(but, (_NO_COUNTS, _NO_NAMES, _NO_TIMES, _NO_PATHS, _NO_SIZES))


def _plane(**named: Any) -> Any:
    return make("go1plane", impl="c", control="position", **named)


def _act(obs: Any, memory: Any, key: Any) -> Any:
    return jnp.zeros((len(obs), 2, 3)), memory


def _evaluate(**named: Any) -> Any:
    env = fake_env.FakeVectorEnv(fake_env.FakeEnv(), 2)
    return evaluate(env, _act, **{"episodes": 2, "key": jax.random.PRNGKey(0), **named})  # type: ignore[arg-type]


def _record(**named: Any) -> Any:
    return record(fake_env.FakeEnv(), _act, (), jax.random.PRNGKey(0), **named)


def _render(path: Any = Path("a.png"), **named: Any) -> Any:
    env = fake_env.FakeEnv()
    rows = (np.tile(env.mj_model.qpos0, (3, 1)), np.zeros((3, 2, 3)), np.tile([1.0, 0, 0, 0], (3, 2, 1)))
    return render_episode(env, Episode(*rows, dt=0.02), path, backend=None, **named)


def _step(action: Any) -> Any:
    env = _plane()
    return env.step(jax.jit(env.reset)(jax.random.PRNGKey(0)), action)


def _versus(opponents: Any) -> Any:
    return versus(VectorEnv(make("go1tug", impl="c", num_envs=4), 4), opponents)


CALLS: dict[str, tuple[Callable[[Any], Any], Strategy]] = {
    "make(task)": (make, NAMES),
    "make(impl)": (lambda x: make("go1plane", impl=x), NAMES),
    "make(control)": (lambda x: make("go1plane", impl="c", control=x), NAMES),
    "make(robot)": (lambda x: _plane(robot=x), NAMES),
    "make(num_envs)": (lambda x: _plane(num_envs=x), COUNTS),
    "make(skill)": (lambda x: make("go1plane", impl="c", skill=x), NAMES),
    "make(skill_weights)": (lambda x: make("go1plane", impl="c", skill_weights=x), PATHS),
    "make(commands)": (lambda x: make("go1plane", impl="c", commands=x), but(_NO_NAMES, [])),
    "make(rewards)": (lambda x: _plane(rewards=x), but(_NO_NAMES, {})),
    "make(randomization)": (lambda x: _plane(randomization=x), but(_NO_NAMES, {})),
    "make(spawn_joint_scale)": (
        lambda x: _plane(spawn_joint_scale=x),
        but(_NO_SIZES, (0, 0), (1, 1), (-3, 100), (10**6, 10**6)),
    ),
    "VectorEnv(num_envs)": (lambda x: VectorEnv(_plane(num_envs=1), x), COUNTS),
    "step(action)": (_step, st.sampled_from(_NO_ACTIONS)),
    "gymnasium.VectorEnv(num_envs)": (lambda x: gymnasium.VectorEnv("go1plane", x, impl="c"), COUNTS),
    "evaluate(episodes)": (lambda x: _evaluate(episodes=x), COUNTS),
    "evaluate(block)": (lambda x: _evaluate(block=x), COUNTS),
    "evaluate(max_steps)": (lambda x: _evaluate(max_steps=x), but(_NO_COUNTS, 10**12)),
    "record(episodes)": (lambda x: _record(episodes=x), COUNTS),
    "record(seconds)": (lambda x: _record(seconds=x), TIMES),
    "render_episode(path)": (_render, st.sampled_from(["a.avi", "", "a", "/", "/proc/none/a.png"]).map(Path)),
    "render_episode(size)": (lambda x: _render(size=x), SIZES),
    "render_episode(fps)": (lambda x: _render(Path("a.gif"), fps=x), TIMES),
    "render_episode(speed)": (lambda x: _render(Path("a.gif"), speed=x), TIMES),
    "render_episode(at)": (lambda x: _render(at=x), but(_NO_TIMES, 1e300)),
    "load_policy(source)": (load_policy, NAMES | PATHS),
    "load_policy(name without a task)": (load_policy, st.sampled_from(["scripted", "random", "idle", "forward"])),
    "versus(opponents)": (
        lambda x: versus(VectorEnv(make("go1tug", impl="c", num_envs=4), 4), x),
        NAMES | st.just(["nope"]),
    ),
    "read_policy": (read_policy, PATHS),
    "read_torchscript": (read_torchscript, PATHS),
    "load_recording": (replay.load_recording, PATHS),
    "load_config": (load_config, PATHS),
    "load_yaml": (load_yaml, PATHS),
    "robots.get": (get, NAMES),
    "build(names)": (lambda x: build(TrainConfig, {x: 1}), NAMES.filter(lambda x: isinstance(x, str | int | bytes))),
    "build(values)": (lambda x: build(TrainConfig, x), but(_NO_NAMES, [], {})),
    "override(changes)": (lambda x: override(TrainConfig(), {"ppo": x}), but(_NO_NAMES, {})),
}
"""By name: the call with one argument, and values of it that are not allowed."""


def wrong_parameter(case: tuple[str, str, Any]) -> Any:
    """Makes a record, and a task with its parameters, with a number that is outside its bounds."""
    name, field, value = case
    if name in inputs.TASKS:
        return make(name, impl="c", control="position", **{field: value})
    return build(inputs.records()[name], {field: value} | ({"tasks": ("go1gate",)} if name == "sweep" else {}))


def calls() -> dict[str, tuple[Callable[[Any], Any], Strategy]]:
    """Returns all calls; those of parameters stand for hundreds."""
    return CALLS | {f"a parameter {i}": (wrong_parameter, inputs.wrong_settings()) for i in range(12)}
