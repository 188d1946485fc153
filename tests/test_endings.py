"""Endings of every task: a fall, the time limit, and a collision in the tasks that end on one."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mqe_jax.envs import TASKS
from tests.states import made, placed, stepper, still


def ground_height(env: Any, x: float, y: float) -> float:
    """Height of the ground or object below (x, y), m."""
    model, data = env.compiled.model, mujoco.MjData(env.compiled.model)
    data.qpos[env.index.base_qpos[:, 2]] = 50.0
    mujoco.mj_kinematics(model, data)
    geom = np.zeros(1, np.int32)
    return 5.0 - mujoco.mj_ray(model, data, np.array([x, y, 5.0]), np.array([0, 0, -1.0]), None, 1, -1, geom)


@pytest.mark.parametrize("task", list(TASKS))
def test_endings(task: str) -> None:
    """From the spawn poses, at standing height."""
    env, step = made(task), stepper(task)
    pose = np.array(env.spawn_poses())
    height = [ground_height(env, x, y) + env.robot.stand_height + 0.01 for x, y, _ in pose]
    position, euler = np.c_[pose[:, :2], height], np.c_[np.zeros((len(pose), 2)), pose[:, 2]]

    after = step(placed(env, position, euler), still(env))
    assert not after.terminated and not after.truncated

    late = dataclasses.replace(placed(env, position, euler), step=jnp.int32(env.max_steps - 1))
    after = step(late, still(env))
    assert after.truncated and not after.terminated

    rolled, high = euler.copy(), position.copy()
    rolled[-1, 0], high[-1, 2] = env.params.max_roll + 0.1, high[-1, 2] + 0.5
    assert step(placed(env, high, rolled), still(env)).terminated
    rolled[-1, 0] = env.params.max_roll - 0.1
    assert not step(placed(env, high, rolled), still(env)).terminated

    # The first robot's trunk lies across the second's: they touch.
    if len(pose) > 1:
        touching, across = position.copy(), euler.copy()
        touching[0] = touching[1] + [0.0, 0.0, 0.09]
        across[0, 2] = pose[1, 2] + np.pi / 2
        bumped = step(placed(env, touching, across), still(env))
        assert bool(bumped.metrics["collision"])
        assert bool(bumped.terminated) == env.params.end_on_collision


@pytest.mark.parametrize(
    ("task", "time_limit", "end_on_collision"),
    [
        ("go1gate", 10, True),
        ("go1seesaw", 10, True),
        ("go1sheep-easy", 15, True),
        ("go1sheep-hard", 15, True),
        ("go1pushbox", 15, False),
        ("go1football-defender", 20, False),
        ("go1tug", 15, False),
        ("go1revolvingdoor", 5, False),
        ("go1wrestling", 15, False),
        ("go1bridge", 20, False),
        ("go1football-1vs1", 20, False),
        ("go1football-2vs2", 20, False),
    ],
)
def test_limits_are_those_of_the_paper(task: str, time_limit: float, end_on_collision: bool) -> None:
    params = made(task).params
    assert (params.episode_length, params.end_on_collision) == (time_limit, end_on_collision)
