"""Throughput in environment steps per second.

It is that of whole steps with skill and resets, and that of physics only.
"""

import time
from collections.abc import Callable
from statistics import median
from typing import Any

import jax
import jax.numpy as jnp

from mqe_jax import names
from mqe_jax.core.devices import cores
from mqe_jax.core.limits import Environments, Horizon, Seed
from mqe_jax.core.settings import Parameters, checked
from mqe_jax.envs import QuadrupedEnv, VectorEnv
from mqe_jax.sensors.suite import ONBOARD

WARM_UP = 4  # calls after the compiling one that are not counted: episodes spread, clocks settle


def time_calls(
    run: Callable[[Any], Any], state: Any, repeats: int
) -> tuple[float, list[float], Any]:
    """Returns the seconds of the first call, those of `repeats` calls, and the last state.

    The call is `run(state) -> state`. The first one compiles. `WARM_UP` more calls precede the
    `repeats`. Each call continues from the previous state and is synchronised.
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
    """Returns what is timed, neither jitted: whole environment steps, and physics only.

    The first maps a state and a random key to those `steps` later under random actions, and returns
    `seen` of each state. The second maps a physics state to a later one under its constant control.
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


@checked
def bench(
    task: str | QuadrupedEnv,
    *,
    env: Parameters | None = None,
    impl: str = "auto",
    num_envs: Environments = 256,
    steps: Horizon = 50,
    repeats: Horizon = 10,
    seed: Seed = 0,
) -> dict[str, str | int | float]:
    """Measures throughput in environment steps per second, as `mqe bench`.

    An environment step is one step of one environment. `env_steps_per_s` includes everything:
    control, skill, physics steps, observations, sensors, rewards and automatic resets, under random
    actions sampled inside the same scan. `bare_env_steps_per_s` is the same scene and number of
    physics steps under constant control, without skill, reward and resets. Both are medians;
    `slowest` and `fastest` are the range of the first. `compile_s` is the first call minus the
    median call. `overflow` counts the environment steps of one call in which the engine may have
    dropped contacts or constraints.

    Example:
        ```python
        mqe_jax.bench("go1gate", num_envs=16, steps=20)["env_steps_per_s"]
        ```

    Args:
        task: id, or environment.
        env: task parameters.
        impl: physics engine: 'auto', 'jax', 'warp' or 'c'.
        num_envs: environments in parallel.
        steps: environment steps of each timed call.
        repeats: timed calls, after `WARM_UP` more.
        seed: random seed.

    Raises:
        InputError: for a task or parameters that are not allowed.
    """
    made = names.environment(task, env or {}, impl=impl, num_envs=num_envs)
    batch = VectorEnv(made, num_envs, final=())
    if made.params.senses:
        batch = batch.with_groups([ONBOARD])
    whole, bare = programs(made, batch, steps, lambda state: jnp.sum(state.metrics["overflow"]))
    key = jax.random.PRNGKey(seed)
    state = jax.block_until_ready(jax.jit(batch.reset)(key))
    walk = jax.jit(lambda carry: whole(carry[0]))
    first, full_s, (_, overflow) = time_calls(walk, ((state, key), jnp.zeros(steps)), repeats)
    _, bare_s, _ = time_calls(jax.jit(bare), jax.tree.map(jnp.copy, state.data), repeats)
    full_rate = num_envs * steps / median(full_s)
    bare_rate = num_envs * steps / median(bare_s)
    return {
        "task": batch.name,
        "impl": made.physics.impl,
        "num_envs": num_envs,
        "env_steps_per_s": round(full_rate, 1),
        "slowest": round(num_envs * steps / max(full_s), 1),
        "fastest": round(num_envs * steps / min(full_s), 1),
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
    return f"{cores()} CPU cores"
