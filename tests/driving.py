"""How fast joints in the air start from rest: `python -m tests.driving [--robot go1]` prints it."""

import json
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from mqe_jax.envs import make
from mqe_jax.physics.robots.motors import leg_response
from mqe_jax.physics.robots.robot import JOINTS


def start_in_air(robot: str = "go1") -> dict[str, dict[str, float]]:
    """Drives each joint of a leg in the air from rest with its torque limit, on the C engine.

    Returns:
        By joint: mean `torque` of the first physics step, N m; `speed_5` and `speed_10` after 5 and
        10 ms, rad/s. `line_*` are those of a free joint that follows its torque line exactly.
    """
    env: Any = make("go1plane", impl="c", robot=robot, num_agents=1, control="torque", num_envs=3)
    index = env.index
    own = env.robot
    timestep = env.compiled.model.opt.timestep
    data = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 3)).data
    qpos = np.array(data.qpos)
    qpos[:, index.base_qpos[0, 2]] = 2.0
    qpos[:, index.joint_qpos[0]] = own.default_joints
    data = data.replace(qpos=jnp.asarray(qpos), qvel=jnp.zeros_like(data.qvel))
    step = jax.jit(jax.vmap(lambda data, torque: env.physics.step(data, torque, num_substeps=1)[0]))
    rows = {}
    for j, (name, torque) in enumerate(zip(JOINTS, own.torque_limit, strict=False)):
        full = np.where(np.arange(12) == j, torque, np.zeros((3, 12))).astype(np.float32)
        first = step(data, full)
        second = step(first, full)
        speeds = [
            float(np.asarray(state.qvel)[0, index.joint_qvel[0, j]]) for state in (first, second)
        ]
        response = leg_response(own)[j, j]
        top = own.joint_speed_limit[j]
        stall = own.stall_torque[j]
        line = []
        speed = 0.0
        for i in range(2000):
            speed += timestep / 1000 * response * min(torque, stall * (1 - speed / top))
            line += [speed] * (i % 1000 == 999)
        rows[name] = {
            prefix + key: round(value, 2)
            for prefix, pair in (("", speeds), ("line_", line))
            for key, value in (
                ("torque", pair[0] / timestep / response),
                ("speed_5", pair[0]),
                ("speed_10", pair[1]),
            )
        }
    return rows


if __name__ == "__main__":
    print(json.dumps(tyro.cli(start_in_air)))
