"""What ends an episode, in every task: a fall, the time limit, and a collision where the task says so."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax.envs import TASKS, make
from tests.states import placed, still

COLLISION_ENDS = {"go1gate", "go1seesaw", "go1sheep-easy", "go1sheep-hard"}
TIME_LIMIT = {  # s
    "go1plane": 10, "go1gate": 10, "go1seesaw": 10, "go1sheep-easy": 15, "go1sheep-hard": 15, "go1pushbox": 15,
    "go1football-defender": 20, "go1tug": 15, "go1revolvingdoor": 5, "go1wrestling": 15, "go1bridge": 20,
    "go1football-1vs1": 20, "go1football-2vs2": 20,
}  # fmt: skip


@pytest.mark.parametrize("task", list(TASKS))
def test_endings(task: str) -> None:
    """From the spawn poses, at standing height."""
    env: Any = make(task, impl="c", control="position", spawn_noise=0.0)
    pose = np.array(env.spawn(jax.random.PRNGKey(0)))
    position = pose[:, :3] - [0, 0, env.params.spawn_height - 0.31]
    if task in ("go1wrestling", "go1bridge"):
        position[:, 2] += {"go1wrestling": 0.4, "go1bridge": 1.02}[task]
    euler = np.zeros((len(pose), 3))
    euler[:, 2] = pose[:, 3]

    after = env.step(placed(env, position, euler), still(env))
    assert not after.terminated and not after.truncated

    late = dataclasses.replace(placed(env, position, euler), step=jnp.int32(50 * TIME_LIMIT[task] - 1))
    after = env.step(late, still(env))
    assert after.truncated and not after.terminated

    rolled, high = euler.copy(), position.copy()
    rolled[-1, 0], high[-1, 2] = (1.35 if task == "go1wrestling" else 0.9), high[-1, 2] + 0.5
    assert env.step(placed(env, high, rolled), still(env)).terminated
    rolled[-1, 0] = 0.7
    assert not env.step(placed(env, high, rolled), still(env)).terminated

    # The first robot's trunk lies across the second's: they touch.
    touching, across = position.copy(), euler.copy()
    touching[0] = touching[1] + [0.0, 0.0, 0.09]
    across[0, 2] = pose[1, 3] + np.pi / 2
    bumped = env.step(placed(env, touching, across), still(env))
    assert bool(bumped.metrics["collision"])
    assert bool(bumped.terminated) == (task in COLLISION_ENDS)
