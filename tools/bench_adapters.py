"""Measures the overhead of adapters relative to `mqe_jax.VectorEnv`, in interleaved pairs.

`python tools/bench_adapters.py --task go1gate --num-envs 64 --pairs 5 --csv FILE` compiles all ways in one process,
then times them in interleaved blocks of environment steps with random actions, and prints the medians and the ratios
within pairs. With `--rollout` the ways are compiled rollouts (`jax.lax.scan`) directly, through Brax's and through
JaxMARL's interface, each returning observations, rewards and ends of all steps; without, they are stepped from the host
with numpy arrays, directly and through the Gymnasium adapter, which also returns the infos.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import mqe_jax

Block = Callable[[], Any]
"""Advances all environments by the steps of a block."""


def direct(env: Any, actions: np.ndarray) -> Block:
    """Returns a block of `mqe_jax.VectorEnv` stepped from the host."""
    vector = mqe_jax.VectorEnv(env, actions.shape[1])
    step = jax.jit(vector.step)
    state = [jax.jit(vector.reset)(jax.random.PRNGKey(0))]

    def advance(action: np.ndarray) -> Any:
        state[0] = after = step(state[0], action)
        return [np.asarray(x) for x in (after.obs, after.reward, after.terminated, after.truncated)]

    return lambda: [advance(action) for action in actions][-1]


def gymnasium(env: Any, actions: np.ndarray, mode: str) -> Block:
    """Returns a block of the Gymnasium adapter stepped from the host."""
    from mqe_jax.adapters.gymnasium import VectorEnv

    vector = VectorEnv(env, actions.shape[1], autoreset_mode=mode)
    vector.reset(seed=0)
    return lambda: [vector.step(action) for action in actions][-1]


def rollout(step: Callable[[Any, jax.Array], tuple[Any, Any]], start: Any, actions: np.ndarray) -> Block:
    """Returns a block that is one compiled scan of `step` over actions (T, N, A, D)."""
    scan = jax.jit(lambda carry: jax.lax.scan(step, carry, jnp.asarray(actions)))
    carry = [start]

    def run() -> Any:
        carry[0], outputs = scan(carry[0])
        return jax.block_until_ready(outputs)

    return run


def direct_rollout(env: Any, actions: np.ndarray) -> Block:
    """Returns a rollout of `mqe_jax.VectorEnv`."""
    vector = mqe_jax.VectorEnv(env, actions.shape[1])

    def step(state: Any, action: jax.Array) -> tuple[Any, Any]:
        state = vector.step(state, action)
        return state, (state.obs, state.reward, state.terminated | state.truncated)

    return rollout(step, jax.jit(vector.reset)(jax.random.PRNGKey(0)), actions)


def brax_rollout(env: Any, actions: np.ndarray) -> Block:
    """Returns a rollout of the Brax adapter under its training wrapper."""
    from mqe_jax.adapters.brax import Env, wrap

    batch = wrap(Env(env), episode_length=env.max_steps)
    count = actions.shape[1]

    def step(state: Any, action: jax.Array) -> tuple[Any, Any]:
        state = batch.step(state, action)
        return state, (state.obs, state.reward, state.done)

    start = jax.jit(batch.reset)(jax.random.split(jax.random.PRNGKey(0), count))
    return rollout(step, start, actions.reshape(len(actions), count, -1))


def jaxmarl_rollout(env: Any, actions: np.ndarray) -> Block:
    """Returns a rollout of the JaxMARL adapter, with a key for every step and environment as its baselines have."""
    from mqe_jax.adapters.jaxmarl import Env

    adapted, count = Env(env), actions.shape[1]

    def step(carry: Any, action: jax.Array) -> tuple[Any, Any]:
        state, key = carry
        key, own = jax.random.split(key)
        by_name = {agent: action[:, i] for i, agent in enumerate(adapted.agents)}
        obs, state, reward, done, _ = jax.vmap(adapted.step)(jax.random.split(own, count), state, by_name)
        return (state, key), (obs, reward, done)

    key = jax.random.PRNGKey(0)
    _, state = jax.jit(jax.vmap(adapted.reset))(jax.random.split(key, count))
    return rollout(step, (state, key), actions)


def measure(ways: dict[str, Block], pairs: int, steps: int) -> list[dict[str, Any]]:
    """Times every way in turn, after a first block that compiles it; returns rows of `way`, `pair` and two times.

    `ms_per_step` is wall time, `cpu_ms_per_step` this process's time on all cores, which other programs disturb less.
    """
    for block in ways.values():
        block()
    rows: list[dict[str, Any]] = []
    for pair in range(pairs):
        for name, block in ways.items():
            began, cpu_began = time.perf_counter(), time.process_time()
            block()
            wall, cpu = time.perf_counter() - began, time.process_time() - cpu_began
            row = {"ms_per_step": round(1e3 * wall / steps, 4), "cpu_ms_per_step": round(1e3 * cpu / steps, 4)}
            rows.append({"way": name, "pair": pair, **row})
    return rows


def summary(rows: list[dict[str, Any]], kind: str) -> dict[str, dict[str, Any]]:
    """Returns each way's median time and its ratio to `direct` within pairs: median, lowest and highest."""
    times: dict[str, list[float]] = {}
    for row in rows:
        times.setdefault(row["way"], []).append(row[kind])
    found = {}
    for name, values in times.items():
        ratios = [value / base for value, base in zip(values, times["direct"], strict=True)]
        spread = [round(min(ratios), 4), round(max(ratios), 4)]
        found[name] = {"median": median(values), "ratio": round(median(ratios), 4), "ratio_range": spread}
    return found


def main() -> int:
    """Runs the pairs and prints one JSON object."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--task", default="go1gate")
    parser.add_argument("--impl", default="c")
    parser.add_argument("--control", default="command")
    parser.add_argument("--num-envs", type=int, default=64)
    parser.add_argument("--steps", type=int, default=100, help="environment steps in a block")
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--rollout", action="store_true", help="compiled rollouts instead of steps from the host")
    parser.add_argument("--csv", type=Path, help="write all timings")
    parser.add_argument("--json", type=Path, help="write the printed object")
    arguments = parser.parse_args()
    count = arguments.num_envs
    env = mqe_jax.make(arguments.task, impl=arguments.impl, control=arguments.control, num_envs=count)
    actions = np.random.default_rng(0).uniform(-1, 1, (arguments.steps, count, env.num_agents, env.action_size))
    actions = actions.astype(np.float32)
    if arguments.rollout:
        ways = {
            "direct": direct_rollout(env, actions),
            "brax": brax_rollout(env, actions),
            "jaxmarl": jaxmarl_rollout(env, actions),
        }
    else:
        ways = {"direct": direct(env, actions)} | {
            f"gymnasium/{mode}": gymnasium(env, actions, mode) for mode in ("SameStep", "NextStep")
        }
    rows = measure(ways, arguments.pairs, arguments.steps)
    if arguments.csv is not None:
        arguments.csv.parent.mkdir(parents=True, exist_ok=True)
        with arguments.csv.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    result = {
        "task": arguments.task,
        "impl": env.impl,
        "control": arguments.control,
        "num_envs": count,
        "steps": arguments.steps,
        "pairs": arguments.pairs,
        "rollout": arguments.rollout,
        "load_average": round(os.getloadavg()[0], 2),
        **{kind: summary(rows, kind) for kind in ("ms_per_step", "cpu_ms_per_step")},
    }
    text = json.dumps(result)
    print(text)
    if arguments.json is not None:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(text + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
