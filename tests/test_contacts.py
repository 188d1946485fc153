"""How many contacts crowded scenes have, against the room that Warp's buffers are given."""

from __future__ import annotations

from typing import Any

import jax
import mujoco
import numpy as np
import pytest

from mqe_jax import robot as go1
from mqe_jax.envs import TASKS, make


@pytest.mark.parametrize("task", list(TASKS))
def test_a_crowd_fits_into_the_buffers(task: str) -> None:
    """All robots thrown together upon what there is to touch, under random joint targets, for two seconds."""
    env: Any = make(task, impl="c", control="position")
    model, index = env.compiled.model, env.robot
    start = jax.tree.map(np.asarray, env.reset(jax.random.PRNGKey(0)))
    random = np.random.default_rng(0)
    data = mujoco.MjData(model)
    data.qpos[:] = start.data.qpos
    if model.nmocap:
        data.mocap_pos[:] = start.data.mocap_pos
    robots = index.num_robots
    middle = data.qpos[index.base_qpos[:, :2]].mean(0)
    for name in ("box", "ball", "sheep4", "sheep0", "cylinder", "door"):
        if name in env.objects:
            middle = (
                data.xpos[env.objects[name].body][:2] if name in ("cylinder", "door") else start_of(env, data, name)
            )
            break
    angle = 2 * np.pi * np.arange(robots) / robots
    reach = {"cylinder": 1.45, "door": 0.35, "box": 0.85}.get(name, 0.3) if name in env.objects else 0.3
    data.qpos[index.base_qpos[:, 0]] = middle[0] + reach * np.cos(angle)
    data.qpos[index.base_qpos[:, 1]] = middle[1] + reach * np.sin(angle)
    mujoco.mj_forward(model, data)
    contacts, rows = [], []
    for _ in range(100):
        data.ctrl[index.actuator] = go1.DEFAULT_JOINTS + 0.4 * random.standard_normal((robots, 12))
        mujoco.mj_step(model, data, 4)
        contacts.append(data.ncon)
        rows.append(data.nefc)
    assert max(contacts) >= 4 * robots - 2, "nobody touches anything: the scene is not crowded"
    assert np.mean(contacts) <= env.params.contacts_per_env
    assert max(rows) <= env.params.rows_per_env
    print(f"{task}: contacts {np.mean(contacts):.1f} on average, {max(contacts)} at most, rows {max(rows)}")


def start_of(env: Any, data: mujoco.MjData, name: str) -> np.ndarray:
    """Where a free object is (2,), m."""
    return data.qpos[env.objects[name].qpos[:2]]
