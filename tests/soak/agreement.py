"""Agreement of an engine with the C engine, by `tests.engines`, and one step of every robot, task, control mode."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax import robots
from mqe_jax.control import MODES
from mqe_jax.engines import STATE_FIELDS
from mqe_jax.envs import TASKS, State, make
from tests.engines import disagreement, record
from tests.soak.report import Report

ONE_STEP = 1e-3
"""Largest difference of a position, m, quaternion or angle, rad, after one environment step."""
ENVS = 2


def agreement(report: Report) -> None:
    """Compares trajectories of all tasks with the C engine's; on the C engine, with positions shifted by 1e-6."""
    options = report.options
    for task in report.pending("agreement", options.tasks or list(TASKS)):
        with jax.default_device(jax.devices("cpu")[0]):  # of the C engine
            reference = record(task, seed=options.seed)
        figures = disagreement(task, options.engine, reference)
        first = {name: value for name, value in figures.items() if name.endswith("_1")}
        wrong = [f"{name}: {value:.2g}" for name, value in first.items() if not value <= ONE_STEP]
        report.add("agreement", task, {name: float(f"{value:.3g}") for name, value in figures.items()}, wrong)


def combinations() -> Iterator[tuple[str, str, str]]:
    """Yields every task, robot and control mode."""
    yield from itertools.product(TASKS, robots.ROBOTS, MODES)


def covering() -> list[tuple[str, str, str]]:
    """Returns one combination for every task, which has every pair of robot and control mode several times."""
    pairs = list(itertools.product(robots.ROBOTS, MODES))
    return [(task, *pairs[number % len(pairs)]) for number, task in enumerate(TASKS)]


def pairs(report: Report) -> None:
    """Steps every combination once, on the C engine from standing robots, and on the other engine from there."""
    rows = {" ".join(combination): combination for combination in combinations()}
    for name in report.pending("pairs", list(rows)):
        report.add("pairs", name, *one_step(*rows[name], report.options.engine))


def one_step(task: str, robot: str, control: str, engine: str) -> tuple[dict[str, float], list[str]]:
    """Returns the difference after one step and how far robots moved, and what is wrong."""
    with jax.default_device(jax.devices("cpu")[0]):
        env, *arrays = stepped(task, robot, control)
    states, action, after = jax.device_get(arrays)
    moved = after.data.qvel[:, env.index.joint_qvel]
    shown = (after.obs, after.privileged_obs, after.reward, *after.metrics.values(), after.data.qpos, after.data.qvel)
    wrong = [] if all(np.all(np.isfinite(leaf)) for leaf in shown) else ["not finite"]
    wrong += [] if after.obs.shape == (ENVS, env.num_agents, env.observation_size) else [f"obs {after.obs.shape}"]
    wrong += [] if np.ptp(moved, axis=0).max() > 1e-3 else ["two actions have the same effect"]
    row = {"joint_speed": float(f"{np.abs(moved).max():.3g}")}
    if engine != "c":
        other: Any = make(task, impl=engine, robot=robot, control=control, num_envs=ENVS)
        fresh = jax.jit(jax.vmap(other.reset))(jax.random.split(jax.random.PRNGKey(0), ENVS))
        data = fresh.data.replace(**{name: getattr(states.data, name) for name in STATE_FIELDS})
        there = jax.jit(jax.vmap(other.step))(dataclasses.replace(states, data=data), action)
        row["apart"] = float(f"{np.abs(np.asarray(there.data.qpos - after.data.qpos)).max():.3g}")
        wrong += [] if row["apart"] <= ONE_STEP else [f"engines differ by {row['apart']}"]
    return row, wrong


def stepped(task: str, robot: str, control: str, settle: int = 1) -> tuple[Any, State, jax.Array, State]:
    """Returns an environment on the C engine, states after `settle` steps without action, an action, the states after.

    The actions of the two environments differ.
    """
    env: Any = make(task, impl="c", robot=robot, control=control, num_envs=ENVS)
    states = jax.jit(jax.vmap(env.reset))(jnp.tile(jax.random.PRNGKey(0), (ENVS, 1)))
    step = jax.jit(jax.vmap(env.step))
    for _ in range(settle):
        states = step(states, jnp.zeros((ENVS, env.num_agents, env.action_size)))
    action = jax.random.uniform(jax.random.PRNGKey(1), (ENVS, env.num_agents, env.action_size), minval=-1.0)
    return env, states, action, step(states, action)
