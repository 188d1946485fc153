"""Pairs of features: every registered network with every way to use it; every task with robots, controls, engines.

The soak has all combinations of robot, task, control and engine (`python -m tests.soak pairs`).
"""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import Probe, assert_same

from mqe_jax.export import translate
from mqe_jax.export.check import errors
from mqe_jax.export.policy import input_shapes, policy_step
from mqe_jax.robots.go1 import GO1
from mqe_jax.settings import build, override
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.evaluate import evaluate
from mqe_jax.train.networks import NETWORKS
from mqe_jax.train.policy import TrainedPolicy, read_policy
from mqe_jax.train.runner import train_seeds
from mqe_jax.view.session import Session
from mqe_jax.walk import network as walk_network  # registers it
from mqe_jax.walk_policy import OBSERVATION_SIZE
from tests.soak import agreement

VARIANTS: dict[str, list[dict[str, Any]]] = {
    "actor_critic": [
        {"recurrent": True, "gru_size": 4, "hidden_sizes": (4,), "openrl_layers": True, "share_policy": False},
        {"recurrent": False, "hidden_sizes": (4, 4), "action_mean": "tanh", "activation": "elu"},
    ],
    "mat": [{"width": 8, "heads": 2, "blocks": 1}],
    "walk": [{"chunk_length": 2}],
}
"""Settings of every registered network."""
LONG = pytest.mark.soak
CASES = [
    pytest.param(
        {"name": name, **settings},
        id=f"{name}{number}",
        marks=pytest.mark.soak if number or name != "actor_critic" else (),
    )
    for name in VARIANTS
    for number, settings in enumerate(VARIANTS[name])
]
"""The first settings of the feed-forward network; the others, MAT and the walk policy, in the soak."""


def pay_each(hidden: jax.Array, action: jax.Array) -> jax.Array:
    """Reward of each agent, maximal if its actions are half the sign."""
    return -jnp.mean(jnp.square(action - 0.5 * hidden[:, None, None]), axis=-1)


def show_widely(width: int, hidden: jax.Array, step: jax.Array) -> jax.Array:
    """Shows the sign and the step, repeated to a width."""
    shown = jnp.stack([hidden, step.astype(jnp.float32)], axis=-1)
    return jnp.tile(shown, (1, -(-width // 2)))[:, :width]


def probe(network: str) -> Any:
    """Environments of the sizes that a network needs, with the attributes that the viewer and the export read."""
    agents = 1 if network == "walk" else 2
    width = OBSERVATION_SIZE - agents if network == "walk" else 5
    show = functools.partial(show_widely, width)
    teams = (tuple(range(agents)),)
    env = Probe(show, pay_each, 4, agents, action_size=12, features=width, max_episode_steps=3, teams=teams)
    for name, value in {"dt": 0.02, "control": "torque", "robot": GO1}.items():
        object.__setattr__(env, name, value)
    return env


def settings_of(network: dict[str, Any]) -> TrainConfig:
    values = {"num_envs": 4, "total_steps": 3 * 16, "rollout_steps": 4, "ppo": {"epochs": 1, "minibatches": 2}}
    values |= {"network": network, "normalization": {"observations": True}, "checkpoint": {"every": 1}}
    return build(TrainConfig, {**values, "evaluation": {"every": 2, "episodes": 4}, "loggers": ()})


_written: set[Path] | None = None


def _audit(event: str, arguments: Any) -> None:
    """Notes every file that Python opens for writing."""
    if event == "open" and _written is not None and isinstance(arguments[0], str | bytes):
        if isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR):
            _written.add(Path(os.fsdecode(arguments[0])).resolve())


@contextlib.contextmanager
def written_files() -> Iterator[set[Path]]:
    """The files opened for writing; an audit hook stays until the process ends."""
    global _written
    sys.addaudithook(_audit)
    _written = set()
    try:
        yield _written
    finally:
        _written = None


def test_every_registered_network_is_here() -> None:
    assert walk_network.WalkNetwork is NETWORKS["walk"]
    assert set(VARIANTS) == {name for name, kind in NETWORKS.items() if kind.__module__.startswith("mqe_jax")}


@pytest.mark.parametrize("network", CASES)
def test_a_network_is_evaluated_resumed_trained_with_seeds_viewed_and_exported(
    network: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    env, config = probe(network["name"]), settings_of(network)
    configs = [config, override(config, {"seed": 1})]
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    folders = [[parent / name for name in ("seed0", "seed1")] for parent in (whole, stopped)]

    def copy(state: Any, row: dict[str, float]) -> None:
        if row["updates"] == 2 and not stopped.exists():  # with the checkpoints of update 1
            shutil.copytree(whole, stopped)

    with written_files() as written:
        expected = train_seeds(env, configs, folders[0], on_update=copy, eval_env=env)
    names = {path.name for path in written if path.is_relative_to(whole) and not path.is_dir()}
    assert {name for name in names if not name.startswith(".")} == {"metrics.csv"}, "not under temporary names"
    assert any(name.startswith(".step_") for name in names)
    assert_same(train_seeds(env, configs, folders[1], resume=True, eval_env=env), expected)
    one, other = (jax.tree.leaves(state.params) for state in expected)
    assert all(np.all(np.isfinite(leaf)) for leaf in one)
    assert any(not np.array_equal(a, b) for a, b in zip(one, other, strict=True))

    policy = read_policy(whole / "seed1")
    memory = policy.initial_memory(4)
    result = evaluate(env, policy.act, 8, jax.random.PRNGKey(0), memory=memory, block=3)
    assert result.episode_length == 3.0 and -4.0 < result.average_step_reward < 0.0
    monkeypatch.setattr(Session, "moment", lambda self: None)  # the probe has no bodies
    session = Session(env, env, policy)
    for _ in range(4):
        session.advance()
    assert session.episodes.tolist() == [1] * 4 and np.all(np.isfinite(session.rewards))
    assert export_error(policy, env) < 2e-5


def export_error(policy: TrainedPolicy, env: Any) -> float:
    """The largest error of the exported graph for random inputs of five environments."""
    described = SimpleNamespace(name="probe", control=env.control, robot=env.robot, observation_size=policy.dims[1])
    random, shapes = np.random.default_rng(0), input_shapes(policy, described)
    inputs = {name: random.normal(size=(5, *shape)).astype(np.float32) for name, shape in shapes.items()}
    step = functools.partial(policy_step, policy, described)
    expected = jax.device_get(jax.jit(jax.vmap(step))(inputs))
    return max(errors(translate.translate(step, shapes, "probe"), inputs, expected).values())


@pytest.mark.parametrize(("task", "robot", "control"), agreement.covering(), ids=str)
def test_a_robot_takes_a_step_in_a_task_under_a_control_mode(task: str, robot: str, control: str) -> None:
    """Every pair of robot and control mode, each in two tasks, on the C engine."""
    assert agreement.one_step(task, robot, control, "c")[1] == []
