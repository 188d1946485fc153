"""Robots driven hard on flat ground: joint speeds and angles against their limits, in every physics step.

`python -m tests.driving [--robot go1] [--mode saturated] [--control torque] [--steps 1000000]` prints the figures;
`--mode walk` those of the walk policy under commands, with the histogram of torques against speeds.
"""

from __future__ import annotations

import argparse
import json
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax import make
from mqe_jax.envs import VectorEnv

MODES = ("saturated", "random")
WALK = "walk"
SETTLING = 100  # first environment steps that the histogram leaves out: the robots drop and gather speed
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
        numbers that are not finite; `steps`. In the mode `walk` also `torque_speed`, the shares of joints and physics
        steps (11, 11) by |torque| (rows) and |speed| (columns) in tenths of their limits, the last one beyond.
    """
    control = "command" if mode == WALK else control
    env: Any = make("go1plane", impl="c", robot=robot, num_agents=1, control=control, num_envs=num_envs)
    vector = VectorEnv(env, num_envs)
    joints, timestep = env.index.joint_qpos[0], env.compiled.model.opt.timestep
    limits = env.robot.joint_lower, env.robot.joint_upper
    torque_limits = np.asarray(env.robot.torque_limit)
    shape = (num_envs, 1, env.action_size)

    def torque_speed(data: Any, target: jax.Array) -> jax.Array:
        """Counts joints (11, 11) by the PD controller's |torque| and |speed|, in tenths of their limits."""
        speed = data.qvel[:, env.index.joint_qvel[0]]
        torque = env.robot.kp * (target[:, 0] - data.qpos[:, joints]) - env.robot.kd * speed
        shares = jnp.abs(torque) / torque_limits, jnp.abs(speed) / env.robot.joint_speed_limit
        rows, columns = (jnp.clip(10 * x, 0, 10).astype(jnp.int32) for x in shares)
        return jnp.bincount((11 * rows + columns).ravel(), length=121).reshape(11, 11)

    def substeps(state: Any, action: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Shares of the speed limits, angles past the joint limits (4, N, 12) and `torque_speed` of one step's
        physics steps."""
        now = jax.vmap(env.read)(state.data)
        target, _ = jax.vmap(env.controller.targets)(state.control, action, now.proprioception)

        def one(data: Any, _: None) -> Any:
            old, counts = data.qpos[:, joints], torque_speed(data, target) if mode == WALK else 0
            data = jax.vmap(lambda d, t: env.physics.step(d, t.ravel(), num_substeps=1)[0])(data, target)
            return data, (jnp.abs(data.qpos[:, joints] - old) / timestep, data.qpos[:, joints], counts)

        speed, angle, histogram = jax.lax.scan(one, state.data, None, env.physics.num_substeps)[1]
        excess = jnp.maximum(jnp.maximum(limits[0] - angle, angle - limits[1]), 0.0)
        return speed / env.robot.joint_speed_limit, excess, jnp.sum(histogram, axis=0)

    def advance(carry: Any, key: jax.Array) -> Any:
        state, action = carry
        action = next_action(mode, action, key)
        speed, excess, histogram = substeps(state, action)
        state = vector.step(state, action)
        bins = [jnp.clip(x * BINS / top, 0, BINS - 1).astype(jnp.int32) for x, top in ((speed, 4.0), (excess, 1.0))]
        counts = [jnp.bincount(rows.ravel(), length=BINS) for rows in bins]
        return (state, action), (*counts, speed.max(), excess.max(), state.metrics["diverged"].sum(), histogram)

    @jax.jit
    def run(state: Any, action: jax.Array, keys: jax.Array) -> Any:
        return jax.lax.scan(advance, (state, action), keys)

    keys = jax.random.split(jax.random.PRNGKey(0), max(1, steps // num_envs))
    _, (speeds, excesses, fastest, furthest, diverged, histograms) = run(
        jax.jit(vector.reset)(jax.random.PRNGKey(1)), jnp.zeros(shape), keys
    )
    figures: dict[str, Any] = {
        "speed_999": _quantile(np.asarray(speeds).sum(0), 4.0),
        "speed_max": float(np.max(fastest)),
        "excess_999": _quantile(np.asarray(excesses).sum(0), 1.0),
        "excess_max": float(np.max(furthest)),
        "diverged": float(np.sum(diverged)),
        "steps": len(keys) * num_envs,
    }
    if mode == WALK:
        counts = np.asarray(histograms)[SETTLING:].sum(0)
        figures["torque_speed"] = (counts / counts.sum()).round(9).tolist()
    return figures


def _quantile(counts: np.ndarray, top: float) -> float:
    """Returns the 99.9% quantile of a histogram over [0, top], at the upper edge of its bin; 0 in the first bin."""
    place = int(np.searchsorted(np.cumsum(counts), 0.999 * counts.sum()))
    return 0.0 if place == 0 else (place + 1) * top / len(counts)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", default="go1")
    parser.add_argument("--mode", default="saturated", choices=(*MODES, WALK))
    parser.add_argument("--control", default="torque", choices=("torque", "position"))
    parser.add_argument("--steps", type=int, default=1_000_000)
    arguments = parser.parse_args()
    print(json.dumps(vars(arguments) | drive(**vars(arguments))))
