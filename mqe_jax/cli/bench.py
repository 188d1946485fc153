"""Throughput in environment steps per second: with walk policy and resets, and for physics alone."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from statistics import median
from typing import Any

import jax
import jax.numpy as jnp

from mqe_jax.envs import QuadrupedEnv, VectorEnv

WARM_UP = 4  # calls after the compiling one that are not counted: episodes spread, clocks settle


def timed(run: Callable[[Any], Any], state: Any, repeats: int) -> tuple[float, list[float], Any]:
    """Returns the seconds of the first call, which compiles, those of `repeats` calls after `WARM_UP` ones, the state.

    `run(state) -> state`; each call continues from the previous state and is synchronised.
    """
    began = time.perf_counter()
    state = jax.block_until_ready(run(state))
    first = time.perf_counter() - began
    seconds = []
    for _ in range(WARM_UP + repeats):
        began = time.perf_counter()
        state = jax.block_until_ready(run(state))
        seconds.append(time.perf_counter() - began)
    return first, seconds[WARM_UP:], state


def programs(
    env: QuadrupedEnv, vector: VectorEnv, steps: int, seen: Callable[[Any], Any]
) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
    """Returns what is timed, neither jitted: whole environment steps, and physics alone.

    The first maps a state and a random key to `steps` later ones under random actions, and to what is `seen` of each
    state; the second maps a physics state to a later one under its constant control.
    """
    shape = (vector.num_envs, env.num_agents, env.action_size)

    def step(carry: Any, _: None) -> Any:
        state, key = carry
        key, action_key = jax.random.split(key)
        state = vector.step(state, jax.random.uniform(action_key, shape, minval=-1.0, maxval=1.0))
        return (state, key), seen(state)

    bare_step = jax.vmap(lambda data: env.physics.step(data, data.ctrl)[0])
    return (
        lambda carry: jax.lax.scan(step, carry, None, steps),
        lambda data: jax.lax.scan(lambda d, _: (bare_step(d), None), data, None, steps)[0],
    )


def bench(
    env: QuadrupedEnv, vector_env: VectorEnv, key: jax.Array, *, steps: int = 50, repeats: int = 10
) -> dict[str, str | int | float]:
    """Measures one task on one engine.

    An environment step is one step of one environment. `env_steps_per_s` includes everything: control, walk policy,
    physics steps, observations, rewards and automatic resets, under random actions sampled inside the same scan.
    `bare_env_steps_per_s` is the same scene and number of physics steps under constant control, without policy, reward
    and resets. Both are medians of `repeats` calls after `WARM_UP` ones; `slowest` and `fastest` are the range of the
    former. `compile_s` is the first call minus the median call. `overflow` counts the environment steps of one call
    in which the engine may have dropped contacts or constraints.
    """
    whole, bare = programs(env, vector_env, steps, lambda state: jnp.sum(state.metrics["overflow"]))
    count, state = vector_env.num_envs, jax.block_until_ready(jax.jit(vector_env.reset)(key))
    walk = jax.jit(lambda carry: whole(carry[0]))
    first, full_s, (_, overflow) = timed(walk, ((state, key), jnp.zeros(steps)), repeats)
    _, bare_s, _ = timed(jax.jit(bare), jax.tree.map(jnp.copy, state.data), repeats)
    full_rate, bare_rate = count * steps / median(full_s), count * steps / median(bare_s)
    return {
        "task": vector_env.name,
        "impl": env.physics.impl,
        "num_envs": count,
        "env_steps_per_s": round(full_rate, 1),
        "slowest": round(count * steps / max(full_s), 1),
        "fastest": round(count * steps / min(full_s), 1),
        "bare_env_steps_per_s": round(bare_rate, 1),
        "ratio": round(full_rate / bare_rate, 4),
        "compile_s": round(max(first - median(full_s), 0.0), 2),
        "overflow": round(float(jnp.sum(overflow))),
        "device": device_name(),
        "jax": jax.__version__,
    }


def device_name() -> str:
    """Returns the name of the GPU, or the number of CPU cores."""
    device = jax.devices()[0]
    if device.platform != "cpu":
        return device.device_kind
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{cores} CPU cores"
