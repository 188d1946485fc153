"""Throughput: environment steps per second with walk policy and resets, and of the bare physics."""

from __future__ import annotations

import csv
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from statistics import median
from typing import Any

import jax
import jax.numpy as jnp

from mqe_jax.errors import InputError


def timed(run: Callable[[Any], Any], state: Any, repeats: int) -> tuple[float, float]:
    """Returns (seconds of the first call, which compiles; median seconds of `repeats` further calls).

    `run(state) -> state`; every call goes on from the last one's state and is waited for.
    """
    began = time.perf_counter()
    state = jax.block_until_ready(run(state))
    first = time.perf_counter() - began
    seconds = []
    for _ in range(repeats):
        began = time.perf_counter()
        state = jax.block_until_ready(run(state))
        seconds.append(time.perf_counter() - began)
    return first, median(seconds)


def bench(
    env: Any, vector_env: Any, key: jax.Array, *, steps: int = 50, repeats: int = 5
) -> dict[str, str | int | float]:
    """Measures one task on one engine.

    An environment step is one step of one world. `env_steps_per_s` has everything in it: control, walk
    policy, 4 physics steps, observations, rewards, resets of the worlds that end, under random actions drawn
    inside the same scan. `bare_env_steps_per_s` is the same scene and number of physics steps under a
    constant control, without policy, reward and resets. `compile_s` is what the first full call took beyond
    a usual one.
    """
    for name, value in (("steps", steps), ("repeats", repeats)):
        if value < 1:
            raise InputError(f"{name}: {value} is not allowed; it must be at least 1")
    count, agents, width = vector_env.num_envs, env.num_agents, env.action_size

    @jax.jit
    def full(carry: tuple[Any, jax.Array]) -> tuple[Any, jax.Array]:
        def one(carry: tuple[Any, jax.Array], _: None) -> tuple[tuple[Any, jax.Array], None]:
            state, key = carry
            key, action_key = jax.random.split(key)
            action = jax.random.uniform(action_key, (count, agents, width), minval=-1.0, maxval=1.0)
            return (vector_env.step(state, action), key), None

        return jax.lax.scan(one, carry, None, steps)[0]

    state = jax.block_until_ready(jax.jit(vector_env.reset)(key))
    first, full_s = timed(full, (state, key), repeats)

    @jax.jit
    def bare(data: Any) -> Any:
        step = jax.vmap(lambda d: env.physics.step(d, d.ctrl))
        return jax.lax.scan(lambda d, _: (step(d), None), data, None, steps)[0]

    # A fresh reset: the robots stand or fall under the control that the reset wrote.
    _, bare_s = timed(bare, jax.tree.map(jnp.copy, state.data), repeats)
    full_rate, bare_rate = count * steps / full_s, count * steps / bare_s
    return {
        "task": vector_env.name,
        "impl": env.physics.impl,
        "num_envs": count,
        "env_steps_per_s": round(full_rate, 1),
        "bare_env_steps_per_s": round(bare_rate, 1),
        "ratio": round(full_rate / bare_rate, 4),
        "compile_s": round(max(first - full_s, 0.0), 2),
        "device": device_name(),
        "jax": jax.__version__,
    }


def device_name() -> str:
    """The hardware that JAX runs on, in words: the GPU's name, or the number of CPU cores."""
    device = jax.devices()[0]
    if device.platform != "cpu":
        return device.device_kind
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{cores} CPU cores"


def append_csv(path: Path, row: Mapping[str, Any]) -> None:
    """Appends a row to a CSV file, written whole; InputError where the file has other columns."""
    rows: list[dict[str, Any]] = []
    if path.exists():
        with path.open(encoding="utf-8", newline="") as file:
            reader = csv.DictReader(file)
            if list(reader.fieldnames or []) != list(row):
                raise InputError(f"csv: {path} has other columns; it must have {', '.join(row)}")
            rows = list(reader)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with temporary.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, list(row), lineterminator="\n")
            writer.writeheader()
            writer.writerows([*rows, row])
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
