"""`mqe bench --profile`: what an environment step and a training update consist of, by number of environments.

The operations of a compiled program are attributed by the named scopes in which they were traced: `physics`
(`Engine.step`), `control` (the walk policy), `task` (the rest of a task's step: observation, reward, ending) and
`reset`. On a GPU, kernels that are no operations of the program are Warp's, which are physics.
"""

from __future__ import annotations

import re
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.experimental.compilation_cache.compilation_cache import reset_cache

from mqe_jax import build
from mqe_jax.cli.bench import device_name, programs
from mqe_jax.cli.options import print_table
from mqe_jax.envs import QuadrupedEnv, VectorEnv
from mqe_jax.files import check_output, replacing
from mqe_jax.settings import fail, override
from mqe_jax.train.learner import make_ppo

SUFFIXES = (".png", ".pdf", ".svg")
SCOPES = ("physics", "control", "task", "reset")
_INSTRUCTION = re.compile(r"^\s*(?:ROOT )?%(\S+) = .*?\s([a-z][a-z\-]*)\(", re.MULTILINE)
_SAMPLE = 8  # environments in which contacts are counted in every step


class Operation(NamedTuple):
    """One execution of an operation."""

    part: str
    """One of `SCOPES`, or another name for what belongs to none."""
    copy: bool
    """Whether it only copies."""
    start: float
    """Start, s."""
    end: float
    """End, s."""


_LEAST = "jax_persistent_cache_min_compile_time_secs"


def scopes(text: str, rest: str) -> dict[str, tuple[str, str]]:
    """Returns the scope (`rest` outside of all) and the kind of each instruction of a compiled program's text."""
    found = {}
    for line in text.splitlines():
        if match := _INSTRUCTION.match(line):
            path = re.search(r'op_name="([^"]*)"', line)
            words = re.findall(r"\w+", path[1] if path else "")
            found[match[1]] = next((word for word in reversed(words) if word in SCOPES), rest), match[2]
    return found


def traced(run: Callable[[], Any], text: str, rest: str) -> list[Operation]:
    """Returns the operations that run during a call of a compiled program with this text."""
    known = scopes(text, rest)
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            jax.block_until_ready(run())
        file = next(Path(folder).rglob("*.xplane.pb"))
        planes = list(jax.profiler.ProfileData.from_file(str(file)).planes)
    devices = [plane for plane in planes if plane.name.startswith("/device:") and any(plane.lines)]
    found = []
    for plane in devices or planes:
        for line in plane.lines:
            if devices and not line.name.startswith("Stream"):
                continue  # sums of the streams
            for event in line.events:
                name = str(dict(event.stats).get("hlo_op", event.name)) if devices else event.name
                if name not in known and not devices:
                    continue
                part, kind = known.get(name, ("physics", ""))
                if kind not in ("while", "call", "conditional"):  # their operations are events too
                    copies = kind == "copy" or event.name.lower().startswith(("memcpy", "copy"))
                    found.append(Operation(part, copies, event.start_ns * 1e-9, event.end_ns * 1e-9))
    return found


def shares(operations: Sequence[Operation]) -> dict[str, float]:
    """Returns the share of time of each part and of `idle`, from the first to the last operation; the sum is 1.

    Each instant is divided equally among the operations that run.
    """
    parts = sorted({operation.part for operation in operations})
    times = np.array([(operation.start, operation.end) for operation in operations])
    edges, place = np.unique(times, return_inverse=True)
    running = np.zeros((len(edges), len(parts)))
    column = np.array([parts.index(operation.part) for operation in operations])
    for side, sign in ((0, 1.0), (1, -1.0)):
        np.add.at(running, (place.reshape(times.shape)[:, side], column), sign)
    running = np.round(np.cumsum(running, axis=0))[:-1]
    count = running.sum(axis=1, keepdims=True)
    length = np.diff(edges)[:, None] / (edges[-1] - edges[0])
    found = (running / np.maximum(count, 1.0) * length).sum(axis=0)
    idle = float(length[count == 0.0].sum())
    return {**dict(zip(parts, map(float, found), strict=True)), "idle": idle}


def compiled(function: Callable[..., Any], *arguments: Any) -> tuple[Any, dict[str, float]]:
    """Returns the compiled program of a function, and its seconds: traced, compiled, and read from JAX's cache."""
    seconds, program = {}, None
    before = jax.config.values["jax_compilation_cache_dir"], jax.config.values[_LEAST]
    with tempfile.TemporaryDirectory() as folder:
        _cache(folder, 0.0)
        try:
            for name in ("compile_s", "cached_s"):
                began = time.perf_counter()
                lowered = jax.jit(lambda *arguments: function(*arguments)).lower(*arguments)
                seconds["trace_s"] = time.perf_counter() - began
                program = lowered.compile()
                seconds[name] = time.perf_counter() - began - seconds["trace_s"]
            return program, seconds
        finally:
            _cache(*before)


def _cache(folder: str | None, least: float) -> None:
    jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update(_LEAST, least)
    reset_cache()


def sampled(data: Any) -> dict[str, jax.Array]:
    """Returns what contacts depend on, of the first environments of a batch."""
    return {name: getattr(data, name)[:_SAMPLE] for name in ("qpos", "qvel", "mocap_pos", "mocap_quat", "ctrl")}


def contacts(model: mujoco.MjModel, states: dict[str, np.ndarray]) -> dict[str, float]:
    """Returns mean and maximum of contacts and constraint rows over states (M, ...) of `sampled`.

    They are those that MuJoCo's C engine finds, whatever the engine.
    """
    host, found = mujoco.MjData(model), []
    for index in np.flatnonzero(np.isfinite(states["qpos"]).all(axis=1) & np.isfinite(states["qvel"]).all(axis=1)):
        for name, values in states.items():
            getattr(host, name)[:] = values[index]
        mujoco.mj_forward(model, host)
        found.append((host.ncon, host.nefc))
    contact, rows = np.array(found).T
    return {
        "contacts_mean": float(contact.mean()),
        "contacts_max": float(contact.max()),
        "rows_mean": float(rows.mean()),
        "rows_max": float(rows.max()),
    }


def profile(env: QuadrupedEnv, vector: VectorEnv, key: jax.Array, *, steps: int, repeats: int) -> dict[str, Any]:
    """Measures the environment step of a batch: rates in turn with the bare engine, shares, compilation, memory."""
    count, start = vector.num_envs, (jax.jit(vector.reset)(key), key)
    run, bare = programs(env, vector, steps, lambda state: sampled(state.data))
    whole, seconds = compiled(run, start)
    walking, states = whole(start)
    runs: dict[str, tuple[Callable[..., Any], Any]] = {
        "env_steps_per_s": (whole, walking),
        "bare_env_steps_per_s": (jax.jit(bare), jax.tree.map(jnp.copy, start[0].data)),
    }
    rates = _in_turn(runs, count * steps, repeats)
    operations = traced(lambda: whole(walking), whole.as_text(), "other")
    return {
        "num_envs": count,
        **rates,
        "ratio": rates["env_steps_per_s"] / rates["bare_env_steps_per_s"],
        **seconds,
        "kernels_per_step": len(operations) / steps,
        "copies_per_step": sum(operation.copy for operation in operations) / steps,
        "state_bytes_per_env": sum(leaf.nbytes for leaf in jax.tree.leaves(start[0])) / count,
        "work_bytes_per_env": whole.memory_analysis().temp_size_in_bytes / count,
        **contacts(env.physics.model, {name: np.concatenate(np.asarray(x)) for name, x in states.items()}),
        "step": shares(operations),
    }


def _in_turn(runs: dict[str, tuple[Callable[..., Any], Any]], amount: int, repeats: int) -> dict[str, float]:
    """Returns `amount` over the median seconds of each of the calls, which are timed in turn after a first one."""
    for run, argument in runs.values():
        jax.block_until_ready(run(argument))
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(repeats):
        for name, (run, argument) in runs.items():
            began = time.perf_counter()
            jax.block_until_ready(run(argument))
            seconds[name].append(time.perf_counter() - began)
    return {name: amount / median(values) for name, values in seconds.items()}


def profile_training(task: str, impl: str, env: dict[str, Any], num_envs: int) -> dict[str, Any]:
    """Returns the seconds of a training update with the task's settings and its shares, `learner` among them."""
    config = build.for_task(build.base_config(task, None), task, env)
    config = override(config, {"num_envs": num_envs, "evaluation.every": None})
    learner = make_ppo(build.environments(impl, config, 1)[0], config)
    state = jax.jit(learner.init)(jax.random.PRNGKey(0))
    update = jax.jit(learner.update).lower(state).compile()
    state, _ = jax.block_until_ready(update(state))
    began = time.perf_counter()
    jax.block_until_ready(update(state))
    seconds = time.perf_counter() - began
    found = shares(traced(lambda: update(state), update.as_text() or "", "learner"))
    return {"update_s": seconds, "rollout_steps": config.rollout_steps, **found}


def run(command: Any) -> dict[str, Any]:
    """Returns the object of `mqe bench --profile`: a profile for each number of environments."""
    if command.output is not None:
        check_output(command.output)
        if command.output.suffix not in SUFFIXES:
            fail("output", str(command.output), f"a file that ends in {', '.join(SUFFIXES)}")
    rows, impl = [], command.impl
    for num_envs in command.sizes or (command.num_envs,):
        env, vector = build.make_env(command.task, command.impl, command.overrides(), num_envs)
        row = profile(env, vector, jax.random.PRNGKey(command.seed), steps=command.steps, repeats=command.repeats)
        row["training"] = profile_training(command.task, command.impl, command.overrides(), num_envs)
        rows.append(row)
        impl = env.physics.impl
        if not command.json:
            parts = {f"{kind}/{part}": share for kind in ("step", "training") for part, share in row[kind].items()}
            print_table({name: value for name, value in row.items() if name not in ("step", "training")} | parts)
    about = {"task": command.task, "impl": impl, "device": device_name(), "jax": jax.__version__}
    if command.output is not None:
        draw(rows, command.output, ", ".join(about.values()))
    return {**about, "profiles": rows}


def draw(rows: Sequence[dict[str, Any]], path: Path, title: str) -> None:
    """Draws the shares of an environment step and of a training update over the number of environments."""
    from matplotlib.figure import Figure

    figure = Figure((9.0, 3.6), dpi=150, layout="constrained")
    for axes, kind in zip(figure.subplots(1, 2, sharey=True), ("step", "training"), strict=True):
        names, floor = [str(row["num_envs"]) for row in rows], np.zeros(len(rows))
        for number, part in enumerate((*SCOPES, "learner", "other", "idle")):
            values = np.array([100.0 * row[kind].get(part, 0.0) for row in rows])
            axes.bar(names, values, bottom=floor, label=part, color="0.85" if part == "idle" else f"C{number}")
            floor = floor + values
        axes.set(xlabel="environments", title=f"share of time (%): {kind}")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside right upper", frameon=False)
    figure.suptitle(title)
    with replacing(path) as temporary:
        figure.savefig(temporary)
