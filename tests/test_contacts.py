"""How many contacts crowded scenes have, against the room that Warp's buffers are given."""

from __future__ import annotations

from typing import Any

import jax
import mujoco
import numpy as np
import pytest

from mqe_jax.envs import TASKS, make

# What a crowd stands around or upon, and how far from its middle, m.
REACH = {
    "box": 0.7,
    "ball": 0.3,
    "sheep4": 0.3,
    "sheep0": 0.3,
    "cylinder": 1.35,
    "door": 0.35,
    "seesaw": 0.3,
    "platform0": 0.3,
    "platform": 0.3,
}


@pytest.mark.parametrize("task", list(TASKS))
def test_a_crowd_fits_into_the_buffers(task: str) -> None:
    """All robots thrown together upon what there is to touch, under random joint targets, for two seconds."""
    env: Any = make(task, impl="c", control="position")
    model, index = env.compiled.model, env.index
    start = jax.tree.map(np.asarray, env.reset(jax.random.PRNGKey(0)))
    random = np.random.default_rng(0)
    data = mujoco.MjData(model)
    data.qpos[:] = start.data.qpos
    if model.nmocap:
        data.mocap_pos[:] = start.data.mocap_pos
    mujoco.mj_forward(model, data)
    robots = index.num_robots
    place = data.qpos[index.base_qpos[:, :3]].mean(0)
    name = next((name for name in REACH if name in env.objects), "")
    if name:
        place[:2] = data.xpos[env.objects[name].body][:2]
    if name == "platform0":  # onto the first platform's edge, where the bridge begins
        place[0] += 0.6
    if name == "seesaw":  # onto its near end
        place += [-1.6, 0.0, 0.15]
    angle = 2 * np.pi * np.arange(robots) / robots
    data.qpos[index.base_qpos[:, 0]] = place[0] + REACH.get(name, 0.15) * np.cos(angle)
    data.qpos[index.base_qpos[:, 1]] = place[1] + REACH.get(name, 0.15) * np.sin(angle)
    data.qpos[index.base_qpos[:, 2]] = place[2] + 0.35 * np.arange(robots)  # one falls upon the other
    contacts, rows, touched = [], [], 0
    for _ in range(100):
        data.ctrl[index.actuator] = env.robot.default_joints + 0.2 * random.standard_normal((robots, 12))
        mujoco.mj_step(model, data, 4)
        contacts.append(data.ncon)
        rows.append(data.nefc)
        touched += bool(name and np.any(data.contact.geom == env.objects[name].geom))
    assert max(contacts) >= 2 * robots, "nobody touches anything: the scene is not crowded"
    assert not name or touched >= 10, f"{name} was touched in {touched} of 100 steps: nobody is at it"
    assert max(contacts) <= env.params.contacts_per_robot * robots
    assert max(rows) <= env.params.constraints_per_robot * robots
    print(f"{task}: contacts {np.mean(contacts):.1f} on average, {max(contacts)} at most, rows {max(rows)}, {touched}")
