"""Play of all tasks: steps whose physics diverged, that left the track, or in which the engine dropped contacts.

Robots driven hard on flat ground: joint speeds and angles against their limits, in every physics step;
`python -m tests.soak.play [--robot go1] [--mode saturated] [--control torque] [--steps 1000000]` prints the figures;
`--mode walk` those of the walk policy under commands, `--mode air` how fast each joint starts from rest.
"""

from __future__ import annotations

import argparse
import json
import time
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax import robots
from mqe_jax.cli.bench import device_name
from mqe_jax.envs import PLANNERS, TASKS, VectorEnv, make
from mqe_jax.envs.autoreset import autoreset
from mqe_jax.planners import scripted_policy
from mqe_jax.robots.motors import leg_response
from mqe_jax.robots.robot import JOINTS

if TYPE_CHECKING:
    from tests.soak.__main__ import Report

BLOCK = 100
"""Environment steps of one compiled call."""
BEHIND, BELOW = 0.1, -0.2  # m; a trunk further behind a wall of the track, or lower, is outside
PLAYS = ("random-command", "saturated-command", "scripted-command", "saturated-torque")
"""Kinds of play: actions of `next_action`, or the scripted policy, and the control mode."""
RATES = {"c": 10_000, "jax": 20_000, "warp": 700_000}
"""Environment steps per second by engine: two CPU cores, the GPU of an H100."""
COMPILING = 60.0  # s


def play(report: Report) -> None:
    """Plays every task with every robot in every mode; the rows of the first robot and mode come first."""
    options = report.options
    rows = {
        f"{task} {robot} {mode}": (task, robot, *mode.split("-"))
        for robot in options.robots or robots.ROBOTS
        for mode in options.modes or PLAYS
        for task in options.tasks or TASKS
        if mode != "scripted-command" or task in PLANNERS
    }
    count = len(list(report.pending("play", list(rows), options.steps)))
    seconds = count * (options.steps / RATES[options.engine] + COMPILING)
    print(f"play: {count} rows of {options.steps} steps, about {seconds / 60:.0f} min", flush=True)
    for name in report.pending("play", list(rows), options.steps):
        task, robot, mode, control = rows[name]
        row = played(task, robot, mode, control, report)
        counted = ("diverged", "outside", "overflow", "not_finite")
        report.add("play", name, row, [f"{kind} in {row[kind]} steps" for kind in counted if row[kind]])


def played(task: str, robot: str, mode: str, control: str, report: Report) -> dict[str, Any]:
    """Returns counts over environment steps of one task, fewer than wanted where the time is over."""
    options = report.options
    env: Any = make(task, impl=options.engine, robot=robot, control=control, num_envs=options.num_envs)
    plan = jax.vmap(scripted_policy(env)) if mode == "scripted" else None
    shape = (options.num_envs, env.num_agents, env.action_size)

    def advance(carry: Any, key: jax.Array) -> Any:
        state, action = carry
        action = plan(state.obs) if plan is not None else next_action(mode, action, key)
        state = jax.vmap(env.step)(state, action)
        out = jax.vmap(lambda data: outside(env, data))(state.data)  # before the reset
        state = jax.vmap(lambda ended: autoreset(env, ended))(state)
        shown = (state.obs, state.final_obs, state.reward, state.data.qpos, state.data.qvel)
        bad = ~jnp.all(jnp.array([jnp.all(jnp.isfinite(leaf)) for leaf in shown]))
        counts = {"diverged": state.metrics["diverged"], "outside": out, "overflow": state.metrics["overflow"]}
        totals = {name: jnp.sum(value > 0) for name, value in counts.items()}
        return (state, action), totals | {"not_finite": bad, "episodes": jnp.sum(state.terminated | state.truncated)}

    run = jax.jit(lambda carry, keys: jax.lax.scan(advance, carry, keys))
    keys = jax.random.split(jax.random.PRNGKey(options.seed), 2)
    carry = jax.jit(jax.vmap(env.reset))(jax.random.split(keys[0], options.num_envs)), jnp.zeros(shape)
    totals: dict[str, int] = {}
    began, steps = time.perf_counter(), 0
    while steps < options.steps and (steps == 0 or report.seconds_left() > 0.0):
        carry, counts = run(carry, jax.random.split(jax.random.fold_in(keys[1], steps), BLOCK))
        for name, value in counts.items():
            totals[name] = totals.get(name, 0) + int(np.sum(np.asarray(value)))
        steps += BLOCK * options.num_envs
    row = {"steps": steps, **totals, "seconds": round(time.perf_counter() - began), "device": device_name()}
    return row if steps >= options.steps else {**row, "partial": True}


def outside(env: Any, data: Any) -> jax.Array:
    """Returns whether a trunk is behind a wall of the track, below the ground, or not a finite place, () bool."""
    place = env.read(data).position_w
    out = jnp.any(~(place[:, 2] > BELOW))
    for barrier in env.compiled.layout.barriers:
        ahead = (place[:, :2] - jnp.array(barrier.point)) @ jnp.array(barrier.normal)
        out |= jnp.any(~(ahead > -BEHIND))
    return out


# -- robots driven hard ------------------------------------------------------------------------------------------------

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
