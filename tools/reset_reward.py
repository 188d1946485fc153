"""Measures the average step reward of an untrained team from scratch in rollouts as long as the paper's.

`python tools/reset_reward.py --json results/paper/reset_reward.json` runs teams with joints held still and with random
joint targets in the two tasks in which training from scratch stays below the paper's values. The caption of the paper's
figure says that rewards of the tasks with sheep and boxes vary with the reset of these objects. So in Push Box the
reward is measured twice: as this suite computes it, and with the box's displacement by a reset counted, as a reward
does that takes differences of successive positions without regard to resets.
"""

from __future__ import annotations

import argparse
import datetime
import json
from functools import partial
from pathlib import Path
from statistics import mean, stdev
from typing import Any

import jax
import jax.numpy as jnp

import mqe_jax
from mqe_jax.envs import VectorEnv
from mqe_jax.envs.state import State
from mqe_jax.files import write_atomically
from mqe_jax.study.records import number

TASKS = ("go1sheep-hard", "go1pushbox")
TEAMS = {"held": 0.0, "random": 0.5}  # standard deviation of the actions; the paper's initial policies have 0.5
STEPS = 200  # of a rollout
SHOWN = 5  # significant digits


def measure(
    task: str, team: str, num_envs: int, rollouts: int, impl: str, steps: int = STEPS, **params: Any
) -> list[dict[str, float]]:
    """Returns the average step reward of each rollout, for Push Box also with resets counted."""
    env = VectorEnv(mqe_jax.make(task, impl=impl, control="position", **params), num_envs)
    weight = env.env.params.rewards.progress  # of the object's displacement, 0 in Sheep Dog (Hard)

    def step(state: State, key: jax.Array) -> tuple[State, tuple[jax.Array, jax.Array]]:
        action = TEAMS[team] * jax.random.normal(key, (num_envs, env.num_agents, env.action_size))
        after = env.step(state, jnp.clip(action, -1.0, 1.0))
        reward = after.reward[:, 0]
        # After an automatic reset `task.x` is the new episode's initial position.
        jump = jnp.where(after.terminated | after.truncated, after.task.x - state.task.x, 0.0) if weight else 0.0
        return after, (jnp.mean(reward), jnp.mean(reward + weight * jump))

    @partial(jax.jit, donate_argnums=0)
    def rollout(state: State, key: jax.Array) -> tuple[State, tuple[jax.Array, jax.Array]]:
        return jax.lax.scan(step, state, jax.random.split(key, steps))

    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    rows = []
    for seed in range(1, rollouts + 1):
        state, (plain, counted) = rollout(state, jax.random.PRNGKey(seed))
        row = {"reward": float(jnp.mean(plain))}
        rows.append(row | ({"with_resets": float(jnp.mean(counted))} if weight else {}))
    return rows


def summary(rows: list[dict[str, float]]) -> dict[str, Any]:
    """Returns mean, standard deviation and values over the rollouts."""

    def short(value: float) -> float:
        return float(number(value, SHOWN))

    columns = {name: [row[name] for row in rows] for name in rows[0]}
    return {
        name: {"mean": short(mean(values)), "deviation": short(stdev(values)), "rollouts": [short(v) for v in values]}
        for name, values in columns.items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", type=int, default=500)
    parser.add_argument("--rollouts", type=int, default=15)
    parser.add_argument("--impl", default="c")
    parser.add_argument("--hardware", default="2 CPU cores")
    parser.add_argument("--json", type=Path, required=True)
    args = parser.parse_args()
    tasks = {
        task: {team: summary(measure(task, team, args.envs, args.rollouts, args.impl)) for team in TEAMS}
        for task in TASKS
    }
    content = {
        "about": "Average step reward of teams that do not know the task, from scratch, per rollout of 200 steps.",
        "command": f"python tools/reset_reward.py --json {args.json}",
        "environments": args.envs,
        "hardware": args.hardware,
        "date": datetime.date.today().isoformat(),
        "tasks": tasks,
    }
    write_atomically(args.json, (json.dumps(content, indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
