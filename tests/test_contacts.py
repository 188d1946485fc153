"""Numbers of contacts in crowded scenes against the sizes of Warp's buffers."""

from __future__ import annotations

from typing import Any

import jax
import mujoco
import numpy as np
import pytest

from mqe_jax.collision import GROUND_BIT
from mqe_jax.envs import TASKS
from tests.states import initial, made

MARGIN = 0.2  # m; from a trunk's centre to what stands beside it
STACK = 0.35  # m; each robot starts that much above the one before


def crowds(env: Any, data: mujoco.MjData) -> dict[str, tuple[np.ndarray, list[np.ndarray]]]:
    """For each object of the task, its geoms and the places (R, 2) at which a crowd starts.

    The robots stand on the object, close around it if it is solid, and at both ends of a supporting surface. Of objects
    with equal geoms only the first is used; without objects the crowd is at the spawn poses.
    """
    model, robots = env.compiled.model, env.index.num_robots
    start = data.qpos[env.index.base_qpos[:, :2]]
    turn = 2 * np.pi * np.arange(robots) / robots
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    found, shapes = {}, set()
    for name, item in env.objects.items():
        geoms = np.flatnonzero((model.geom_bodyid == item.body) & (model.geom_contype > 0))
        shape = (*model.geom_type[geoms], *model.geom_size[geoms].ravel())
        if not len(geoms) or shape in shapes:
            continue
        shapes.add(shape)
        half = np.max(model.geom_pos[geoms] + model.geom_aabb[geoms, 3:], axis=0)[:2]
        middle = data.xpos[item.body][:2]
        places = [middle + 0.2 * ring]
        if np.any(model.geom_contype[geoms] & GROUND_BIT):
            end = np.array([half[0] - 0.45, 0.0])
            places += [middle - end + 0.2 * ring, middle + end + 0.2 * ring]
        else:
            for quarter in (0.0, np.pi / 2):  # from the first robot's start, and at right angles
                angle = turn + quarter + np.arctan2(*(start[0] - middle)[::-1])
                around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
                side = np.min(half / np.maximum(np.abs(around), 1e-6), axis=1)
                place = middle + (side + MARGIN)[:, None] * around
                places.append(np.maximum(place, [0.25, -np.inf]))  # clear of the back wall at x = 0
        found[name] = geoms, places
    return found or {"": (np.array([], int), [start.mean(0) + 0.15 * ring])}


@pytest.mark.parametrize("task", list(TASKS))
def test_a_crowd_fits_into_the_buffers(task: str) -> None:
    """All robots spawned at each object, stacked, under random joint targets for two seconds."""
    env = made(task)
    model, index = env.compiled.model, env.index
    start = jax.tree.map(np.asarray, initial(env))
    random, robots = np.random.default_rng(0), index.num_robots
    data = mujoco.MjData(model)
    data.qpos[:] = start.data.qpos
    if model.nmocap:
        data.mocap_pos[:] = start.data.mocap_pos
    mujoco.mj_forward(model, data)
    qpos = data.qpos.copy()
    for name, (geoms, places) in crowds(env, data).items():
        touched, contacts, rows = [], [], []
        for place in places:
            data.qpos[:], data.qvel[:] = qpos, 0.0
            data.qpos[index.base_qpos[:, 2]] = 100.0  # out of the way of the rays that find the ground
            mujoco.mj_forward(model, data)
            hit, down = np.zeros(1, np.int32), np.array([0.0, 0.0, -1.0])
            depth = np.array([mujoco.mj_ray(model, data, [*at, 3.0], down, None, 1, -1, hit) for at in place])
            data.qpos[index.base_qpos[:, :2]] = place
            data.qpos[index.base_qpos[:, 2]] = 3.0 - depth + env.robot.stand_height + STACK * np.arange(robots)
            touched.append(0)
            for _ in range(100):
                data.ctrl[index.actuator] = env.robot.default_joints + 0.2 * random.standard_normal((robots, 12))
                mujoco.mj_step(model, data, 4)
                contacts.append(data.ncon)
                rows.append(data.nefc)
                touched[-1] += bool(np.isin(data.contact.geom, geoms).any())
        print(f"{task} {name}: {max(contacts)} contacts, {max(rows)} rows at most; touched in {touched} of 100 steps")
        assert max(contacts) >= 2 * robots, f"{name}: too few contacts: the scene is not crowded"
        assert not len(geoms) or max(touched) >= 10, f"{name}: touched in {touched} of 100 steps: no robot is near"
        assert max(contacts) <= env.params.contacts_per_robot * robots
        assert max(rows) <= env.params.constraints_per_robot * robots
