"""Robots driven hard on flat ground: joint speeds and angles against their limits, in every physics step.

`python -m tests.driving [--robot go1] [--mode saturated] [--control torque] [--steps 1000000]` prints the figures;
`--mode walk` those of the walk policy under commands, `--mode air` how fast each joint starts from rest.
"""

from __future__ import annotations

import argparse
import json
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.envs import VectorEnv, make
from mqe_jax.physics.robots.motors import leg_response
from mqe_jax.physics.robots.robot import JOINTS

MODES = ("saturated", "random")
WALK = "walk"
BINS = 4000  # of the histograms: shares of the speed limit up to 4, angles past the limit up to 1 rad


def next_action(mode: str, action: jax.Array, key: jax.Array) -> jax.Array:
    """Returns the actions (N, A, D) that follow `action`, at first zero; the modes are those of `drive`."""
    value_key, flip_key = jax.random.split(key)
    uniform = jax.random.uniform(value_key, action.shape, minval=-1.0)
    if mode == WALK:
        return jnp.where(jax.random.bernoulli(flip_key, 0.005, (len(action), 1, 1)), uniform, action)
    flips = jax.random.bernoulli(flip_key, 0.08, action.shape) | (action == 0.0)
    return uniform if mode == "random" else jnp.where(flips, jnp.sign(uniform), action)


def drive(robot: str, mode: str, steps: int, control: str = "torque", num_envs: int = 250) -> dict[str, Any]:
    """Drives robots on the C engine for `steps` environment steps in all.

    Args:
        robot: its name.
        mode: actions at their bounds, held for 0.25 s on average (`saturated`), uniform in every step (`random`), or
            uniform and held for 4 s on average, as walk commands whatever `control` is (`walk`).
        steps: environment steps, all environments together.
        control: `torque` or `position`.
        num_envs: environments.

    Returns:
        `speed_999`, `speed_max`: 99.9% and the greatest of |speed| / limit, averages over a physics step;
        `excess_999`, `excess_max`: likewise of the angle past a joint limit, rad; `diverged`: environment steps with
        numbers that are not finite; `steps`.
    """
    control = "command" if mode == WALK else control
    env: Any = make("go1plane", impl="c", robot=robot, num_agents=1, control=control, num_envs=num_envs)
    vector = VectorEnv(env, num_envs)
    joints, timestep = env.index.joint_qpos[0], env.compiled.model.opt.timestep
    limits = env.robot.joint_lower, env.robot.joint_upper
    shape = (num_envs, 1, env.action_size)

    def substeps(state: Any, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Shares of the speed limits and angles past the joint limits (4, N, 12) of one step's physics steps."""
        now = jax.vmap(env.read)(state.data)
        target, _ = jax.vmap(env.controller.targets)(state.control, action, now.proprioception)

        def one(data: Any, _: None) -> Any:
            old = data.qpos[:, joints]
            data = jax.vmap(lambda d, t: env.physics.step(d, t.ravel(), num_substeps=1)[0])(data, target)
            return data, (jnp.abs(data.qpos[:, joints] - old) / timestep, data.qpos[:, joints])

        speed, angle = jax.lax.scan(one, state.data, None, env.physics.num_substeps)[1]
        excess = jnp.maximum(jnp.maximum(limits[0] - angle, angle - limits[1]), 0.0)
        return speed / env.robot.joint_speed_limit, excess

    def advance(carry: Any, key: jax.Array) -> Any:
        state, action = carry
        action = next_action(mode, action, key)
        speed, excess = substeps(state, action)
        state = vector.step(state, action)
        bins = [jnp.clip(x * BINS / top, 0, BINS - 1).astype(jnp.int32) for x, top in ((speed, 4.0), (excess, 1.0))]
        counts = [jnp.bincount(rows.ravel(), length=BINS) for rows in bins]
        return (state, action), (*counts, speed.max(), excess.max(), state.metrics["diverged"].sum())

    @jax.jit
    def run(state: Any, action: jax.Array, keys: jax.Array) -> Any:
        return jax.lax.scan(advance, (state, action), keys)

    keys = jax.random.split(jax.random.PRNGKey(0), max(1, steps // num_envs))
    _, (speeds, excesses, fastest, furthest, diverged) = run(
        jax.jit(vector.reset)(jax.random.PRNGKey(1)), jnp.zeros(shape), keys
    )
    return {
        "speed_999": _quantile(np.asarray(speeds).sum(0), 4.0),
        "speed_max": float(np.max(fastest)),
        "excess_999": _quantile(np.asarray(excesses).sum(0), 1.0),
        "excess_max": float(np.max(furthest)),
        "diverged": float(np.sum(diverged)),
        "steps": len(keys) * num_envs,
    }


def start_in_air(robot: str) -> dict[str, dict[str, float]]:
    """Drives each joint of a leg in the air from rest with its torque limit, on the C engine.

    Returns:
        by joint, simulated and, as `line_*`, of a free joint that follows its torque line exactly: mean `torque` of the
        first physics step, N m; `speed_5` and `speed_10` after 5 and 10 ms, rad/s.
    """
    env: Any = make("go1plane", impl="c", robot=robot, num_agents=1, control="torque", num_envs=3)
    index, own, timestep = env.index, env.robot, env.compiled.model.opt.timestep
    data = jax.vmap(env.reset)(jax.random.split(jax.random.PRNGKey(0), 3)).data
    qpos = data.qpos.at[:, index.base_qpos[0, 2]].set(2.0).at[:, index.joint_qpos[0]].set(own.default_joints)
    data = data.replace(qpos=qpos, qvel=jnp.zeros_like(data.qvel))
    step = jax.jit(jax.vmap(lambda data, torque: env.physics.step(data, torque, num_substeps=1)[0]))
    rows = {}
    for j, (name, torque) in enumerate(zip(JOINTS, own.torque_limit, strict=False)):
        first = step(data, jnp.zeros((3, 12)).at[:, j].set(torque))
        second = step(first, jnp.zeros((3, 12)).at[:, j].set(torque))
        speeds = [float(state.qvel[0, index.joint_qvel[0, j]]) for state in (first, second)]
        response, top, stall = leg_response(own)[j, j], own.joint_speed_limit[j], own.stall_torque[j]
        line, speed = [], 0.0
        for i in range(2000):
            speed += timestep / 1000 * response * min(torque, stall * (1 - speed / top))
            line += [speed] * (i % 1000 == 999)
        rows[name] = {
            prefix + key: round(value, 2)
            for prefix, pair in (("", speeds), ("line_", line))
            for key, value in (("torque", pair[0] / timestep / response), ("speed_5", pair[0]), ("speed_10", pair[1]))
        }
    return rows


def _quantile(counts: np.ndarray, top: float) -> float:
    """Returns the 99.9% quantile of a histogram over [0, top], at the upper edge of its bin; 0 in the first bin."""
    place = int(np.searchsorted(np.cumsum(counts), 0.999 * counts.sum()))
    return 0.0 if place == 0 else (place + 1) * top / len(counts)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", default="go1")
    parser.add_argument("--mode", default="saturated", choices=(*MODES, WALK, "air"))
    parser.add_argument("--control", default="torque", choices=("torque", "position"))
    parser.add_argument("--steps", type=int, default=1_000_000)
    arguments = parser.parse_args()
    driven = start_in_air(arguments.robot) if arguments.mode == "air" else drive(**vars(arguments))
    print(json.dumps(vars(arguments) | driven))
