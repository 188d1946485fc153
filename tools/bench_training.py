"""Measures the wall time of a training update: one seed and several, and the fractions of learner and evaluation.

`python tools/bench_training.py --algorithms mappo jrpo mat --seeds 1 5 --json FILE` starts a process per algorithm and
number of seeds. They compile in parallel and are then timed in turn, with the paper's settings: the whole update, its
rollout alone (the rest is the learner), and an evaluation (32 episodes each with sampled and with mean actions).
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from statistics import median
from typing import Any


def work(task: str, impl: str, algorithm: str, seeds: int, num_envs: int, total_steps: int, repeats: int) -> None:
    """Process of one case: compiles, reports readiness, and times on request."""
    answer = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # whatever libraries print

    import jax
    import jax.numpy as jnp

    from mqe_jax.cli.setup import base_config, environments, for_task
    from mqe_jax.settings import override
    from mqe_jax.train.learner import env_dims, make_learner
    from mqe_jax.train.monitor import Monitor
    from mqe_jax.train.policy import policy_of
    from mqe_jax.train.rollout import rollout
    from mqe_jax.train.seeds import shared_leaves, take

    config = override(
        for_task(base_config(task, None, algorithm), task),
        {"num_envs": num_envs, "total_steps": total_steps, "evaluation": {"every": 20}},
    )
    env, eval_env = environments(impl, config, seeds)
    assert eval_env is not None
    learner = make_learner(env, config)
    keys = jax.vmap(jax.random.PRNGKey)(jnp.arange(seeds))
    batched = (lambda f: f) if seeds == 1 else jax.vmap
    shared = shared_leaves(learner.init)
    state = jax.jit(batched(learner.init))(keys[0] if seeds == 1 else keys)

    def roll(state: Any) -> Any:
        return rollout(
            env,
            learner.network,
            state.params,
            state.obs_normalizer,
            state.rollout,
            state.key,
            config.rollout_steps,
            normalize=config.normalization.observations,
            action_scale=config.action_scale,
        )[:2]

    update, act = jax.jit(batched(learner.update)), jax.jit(batched(roll))
    monitor, dims = Monitor(eval_env, config), env_dims(env, config)

    def policies() -> list[Any]:
        one = (lambda i: state) if seeds == 1 else (lambda i: take(state, shared, i))
        return [policy_of(one(i), dims, config, task=task, env_steps=0) for i in range(seeds)]

    def evaluate() -> None:
        monitor.evaluate(policies(), [0] * seeds, config.evaluation.episodes)

    def seconds(run: Any) -> list[float]:
        times = []
        for _ in range(repeats):
            began = time.perf_counter()
            run()
            times.append(time.perf_counter() - began)
        return times

    def one_update() -> None:
        nonlocal state
        state, _ = jax.block_until_ready(update(state))

    began = time.perf_counter()
    one_update()
    compiled = time.perf_counter() - began
    jax.block_until_ready(act(state))
    evaluate()
    print(json.dumps({"ready": True}), file=answer, flush=True)
    sys.stdin.readline()
    figures = {
        "update_s": median(seconds(one_update)),
        "rollout_s": median(seconds(lambda: jax.block_until_ready(act(state)))),
        "evaluation_s": median(seconds(evaluate)),
        "compile_s": compiled,
    }
    figures["learner_share"] = 1.0 - figures["rollout_s"] / figures["update_s"]
    updates = config.num_updates
    # Twenty evaluations per run.
    spent = 20 * figures["evaluation_s"]
    figures["evaluation_share"] = spent / (spent + updates * figures["update_s"])
    figures["env_steps_per_s"] = seeds * config.steps_per_update / figures["update_s"]
    case = {"task": task, "impl": impl, "algorithm": algorithm, "seeds": seeds, "num_envs": config.num_envs}
    rounded = {name: round(value, 4) for name, value in figures.items()}
    print(json.dumps({**case, **rounded, "device": jax.devices()[0].device_kind}), file=answer, flush=True)


def main() -> int:
    """Runs all cases and prints one JSON object for each."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--task", default="go1gate")
    parser.add_argument("--impl", default="warp")
    parser.add_argument("--algorithms", nargs="+", default=["mappo", "jrpo", "mat"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 5])
    parser.add_argument("--num-envs", type=int, default=500, help="of each seed")
    parser.add_argument("--total-steps", type=int, default=40_000_000)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--work", nargs=7, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.work:
        work(*arguments.work[:3], *map(int, arguments.work[3:]))
        return 0
    cases = [(algorithm, seeds) for algorithm in arguments.algorithms for seeds in arguments.seeds]
    processes = []
    for algorithm, seeds in cases:
        command = [sys.executable, str(Path(__file__).resolve()), "--work", arguments.task, arguments.impl, algorithm]
        command += [str(seeds), str(arguments.num_envs), str(arguments.total_steps), str(arguments.repeats)]
        # The processes share the GPU: none may preallocate all memory.
        environment = os.environ | {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
        processes.append(
            subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment)
        )
    rows: list[dict[str, Any]] = []
    failed = False
    ready = [bool(process.stdout and process.stdout.readline()) for process in processes]
    for process, compiled, case in zip(processes, ready, cases, strict=True):
        line = process.communicate("\n")[0] if compiled else ""
        if not line:
            print(f"bench_training: {case} failed", file=sys.stderr, flush=True)
            failed = True
            continue
        rows.append(json.loads(line))
        print(line, end="", flush=True)
        if arguments.json is not None:
            arguments.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return int(failed)


if __name__ == "__main__":
    raise SystemExit(main())
