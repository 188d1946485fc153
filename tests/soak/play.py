"""Play of all tasks: steps whose physics diverged, that left the track, or in which the engine dropped contacts."""

from __future__ import annotations

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax import robots
from mqe_jax.envs import PLANNERS, TASKS, make
from mqe_jax.envs.autoreset import autoreset
from mqe_jax.planners import scripted_policy
from tests.driving import next_action
from tests.soak.report import Report

BLOCK = 100
"""Environment steps of one compiled call."""
BEHIND, BELOW = 0.1, -0.2  # m; a trunk further behind a wall of the track, or lower, is outside
MODES = ("random-command", "saturated-command", "scripted-command", "saturated-torque")
"""Kinds of play: actions of `tests.driving`, or the scripted policy, and the control mode."""
RATES = {"c": 10_000, "jax": 20_000, "warp": 700_000}
"""Environment steps per second by engine: two CPU cores, the GPU of an H100."""
COMPILING = 60.0  # s


def play(report: Report) -> None:
    """Plays every task with every robot in every mode; the rows of the first robot and mode come first."""
    options = report.options
    rows = {
        f"{task} {robot} {mode}": (task, robot, *mode.split("-"))
        for robot in options.robots or robots.ROBOTS
        for mode in options.modes or MODES
        for task in options.tasks or TASKS
        if mode != "scripted-command" or task in PLANNERS
    }
    count = len(list(report.pending("play", list(rows))))
    seconds = count * (options.steps / RATES[options.engine] + COMPILING)
    print(f"play: {count} rows of {options.steps} steps, about {seconds / 60:.0f} min", flush=True)
    for name in report.pending("play", list(rows)):
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
    row = {"steps": steps, **totals, "seconds": round(time.perf_counter() - began)}
    return row if steps >= options.steps else {**row, "partial": True}


def outside(env: Any, data: Any) -> jax.Array:
    """Returns whether a trunk is behind a wall of the track, below the ground, or not a finite place, () bool."""
    place = env.read(data).position_w
    out = jnp.any(~(place[:, 2] > BELOW))
    for barrier in env.compiled.layout.barriers:
        ahead = (place[:, :2] - jnp.array(barrier.point)) @ jnp.array(barrier.normal)
        out |= jnp.any(~(ahead > -BEHIND))
    return out
