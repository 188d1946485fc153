"""Measures the overhead of the Gymnasium adapter relative to `mqe_jax.VectorEnv`, in interleaved pairs.

`python tools/bench_adapters.py --task go1gate --num-envs 64 --pairs 5 --csv FILE` compiles both in one process, then
times them in interleaved pairs of blocks of environment steps with random actions, and prints the medians and their
ratio. Both get numpy actions and return numpy observations, rewards and flags; the adapter also returns the infos.
"""

from __future__ import annotations

import argparse
import csv
import json
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import jax
import numpy as np

import mqe_jax
from mqe_jax.adapters.gymnasium import VectorEnv


def direct(env: Any, num_envs: int) -> Callable[[np.ndarray], Any]:
    """Returns a function that steps `mqe_jax.VectorEnv` once."""
    vector = mqe_jax.VectorEnv(env, num_envs)
    step = jax.jit(vector.step)
    state = [jax.jit(vector.reset)(jax.random.PRNGKey(0))]

    def advance(action: np.ndarray) -> Any:
        state[0] = after = step(state[0], action)
        return [np.asarray(x) for x in (after.obs, after.reward, after.terminated, after.truncated)]

    return advance


def adapted(env: Any, num_envs: int, mode: str) -> Callable[[np.ndarray], Any]:
    """Returns a function that steps the Gymnasium adapter once."""
    vector = VectorEnv(env, num_envs, autoreset_mode=mode)
    vector.reset(seed=0)
    return vector.step


def main() -> int:
    """Runs the pairs and prints one JSON object."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--task", default="go1gate")
    parser.add_argument("--impl", default="c")
    parser.add_argument("--num-envs", type=int, default=64)
    parser.add_argument("--steps", type=int, default=100, help="environment steps in a block")
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--csv", type=Path)
    arguments = parser.parse_args()
    count = arguments.num_envs
    env = mqe_jax.make(arguments.task, impl=arguments.impl, num_envs=count)
    actions = np.random.default_rng(0).uniform(-1, 1, (arguments.steps, count, env.num_agents, env.action_size))
    actions = actions.astype(np.float32)
    ways = {
        "direct": direct(env, count),
        "gymnasium/SameStep": adapted(env, count, "SameStep"),
        "gymnasium/NextStep": adapted(env, count, "NextStep"),
    }
    for advance in ways.values():
        for action in actions[:10]:
            advance(action)
    rows: list[dict[str, Any]] = []
    for pair in range(arguments.pairs):
        for name, advance in ways.items():
            began = time.perf_counter()
            for action in actions:
                advance(action)
            milliseconds = 1e3 * (time.perf_counter() - began) / len(actions)
            rows.append({"way": name, "pair": pair, "ms_per_step": round(milliseconds, 4)})
    if arguments.csv is not None:
        arguments.csv.parent.mkdir(parents=True, exist_ok=True)
        with arguments.csv.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    times = {name: [row["ms_per_step"] for row in rows if row["way"] == name] for name in ways}
    result = {"task": arguments.task, "impl": env.impl, "num_envs": count, "ms_per_step": {}, "ratio": {}}
    for name, found in times.items():
        result["ms_per_step"][name] = median(found)
        pairs = zip(found, times["direct"], strict=True)
        result["ratio"][name] = round(median(a / b for a, b in pairs), 4)
    print(json.dumps(result))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
