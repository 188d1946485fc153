"""Compares the throughput of checkouts or parameters on one machine.

    python tools/bench_pairs.py --trees before=PATH after=PATH --cases go1gate:c:256 --csv FILE

starts one process per checkout and case, waits for compilation, and times them in turn. Drifts of
the machine's speed then affect all equally. It prints medians and ratios of the pairs. A case is
TASK:ENGINE:ENVIRONMENTS. Each timing is that of `mqe bench`: the median of a few calls of 50
environment steps, whole step and bare physics. TASK:ENGINE:SETTINGS, as go1gate:c:demo, times
updates of a training instead. `PATH,senses=onboard` is a checkout with a
task parameter.
"""

import argparse
import csv
import itertools
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from statistics import median
from typing import Any

import yaml

RATES = ("env_steps_per_s", "bare_env_steps_per_s")


def work(case: str, *, steps: int, repeats: int, cpu_time: bool, params: dict[str, Any]) -> None:
    """Compiles one case in one checkout, then answers each line on standard input with a timing."""
    output = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # whatever libraries print

    import jax

    import mqe_jax

    clock = time.process_time if cpu_time else time.perf_counter
    task, impl, how = case.split(":")
    if how.isdecimal():
        runs = of_environments(task, impl, int(how), steps, params)
    else:
        runs = of_updates(task, impl, how, params)

    def rate(run: Any, start: Any, count: int) -> float:
        seconds = []
        for _ in range(repeats):
            began = clock()
            start = jax.block_until_ready(run(start))
            seconds.append(clock() - began)
        return round(count / median(seconds), 1)

    for run, begin, _ in runs.values():
        jax.block_until_ready(run(begin))
    device = jax.devices()[0].device_kind
    print(json.dumps({"ready": mqe_jax.__file__}), file=output, flush=True)
    for _ in sys.stdin:
        figures: dict[str, Any] = {name: rate(*each) for name, each in runs.items()}
        about = {"device": device, "jax": jax.__version__}
        print(json.dumps(figures | about), file=output, flush=True)


def of_environments(
    task: str, impl: str, count: int, steps: int, params: dict[str, Any]
) -> dict[str, tuple[Any, Any, int]]:
    """Returns a compiled function, its argument and its environment steps, for each of `RATES`."""
    import jax
    import jax.numpy as jnp

    import mqe_jax
    from mqe_jax.runs.throughput import programs

    env = mqe_jax.make(task, impl=impl, num_envs=count, **params)
    vector: Any = mqe_jax.VectorEnv(env, count, final=())
    if getattr(env.params, "senses", ()):
        vector = vector.with_groups(["onboard"])
    scan, bare = programs(env, vector, steps, lambda state: ())
    carry = (jax.jit(vector.reset)(jax.random.PRNGKey(0)), jax.random.PRNGKey(1))
    data = jax.tree.map(jnp.copy, carry[0].data)
    whole = jax.jit(lambda carry: scan(carry)[0])
    runs = (whole, carry, count * steps), (jax.jit(bare), data, count * steps)
    return dict(zip(RATES, runs, strict=True))


def of_updates(
    task: str, impl: str, settings: str, params: dict[str, Any]
) -> dict[str, tuple[Any, Any, int]]:
    """Returns the same of an update of a training, which has no bare rate."""
    import jax

    from mqe_jax.runs.learning import prepare
    from mqe_jax.train.start import initial_key, own_learner

    (config,), cast = prepare(task, settings, params or None, impl=impl, seeds=[0])
    learner, _ = own_learner(cast, config)
    state = jax.jit(learner.init)(initial_key(config))
    update = jax.jit(learner.update)
    return {RATES[0]: (lambda state: update(state)[0], state, config.steps_per_update)}


def start(place: str, case: str, **options: Any) -> subprocess.Popen[str]:
    """Starts the process that times one case in one checkout, PATH or PATH,PARAMETER=VALUE,..."""
    folder, *pairs = place.split(",")
    tree = Path(folder)
    params = {}
    for pair in pairs:
        name, value = pair.split("=")
        params[name] = yaml.safe_load(value)
    places = [str(tree.resolve()), os.environ.get("PYTHONPATH", "")]
    path = os.pathsep.join(filter(None, places))
    command = [sys.executable, str(Path(__file__).resolve()), "--work", case]
    command.append(json.dumps({**options, "params": params}))
    pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, cwd=tree, env=os.environ | {"PYTHONPATH": path}, **pipes)


def answer(worker: subprocess.Popen[str], ask: bool = True) -> dict[str, Any]:
    """Returns the next answer of a process, a timing if it is asked for one.

    Exits if the process has died.
    """
    assert worker.stdin is not None and worker.stdout is not None
    if ask:
        worker.stdin.write("\n")
        worker.stdin.flush()
    line = worker.stdout.readline()
    if not line:
        raise SystemExit(f"{worker.args}: the benchmark process ended")
    return json.loads(line)


def main() -> int:
    """Runs the pairs and prints one JSON object per case."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--trees",
        nargs="+",
        metavar="NAME=PATH[,PARAMETER=VALUE...]",
        help="ratios are to the first one",
    )
    parser.add_argument("--cases", nargs="+", metavar="TASK:ENGINE:ENVS|SETTINGS")
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument(
        "--cpu-time", action="store_true", help="count CPU time: for CPUs that others use too"
    )
    parser.add_argument("--csv", type=Path)
    parser.add_argument("--work", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.work:
        work(arguments.work[0], **json.loads(arguments.work[1]))
        return 0
    trees = dict(pair.split("=", 1) for pair in arguments.trees)
    options = {name: getattr(arguments, name) for name in ("steps", "repeats", "cpu_time")}
    workers = {}
    for case, name in itertools.product(arguments.cases, trees):
        workers[case, name] = start(trees[name], case, **options)
    for worker in workers.values():
        answer(worker, ask=False)
    rows: list[dict[str, Any]] = []
    for pair in range(arguments.pairs):
        for (case, tree), worker in workers.items():
            rows.append({"case": case, "tree": tree, "pair": pair, **answer(worker)})
    for worker in workers.values():
        worker.kill()
    if arguments.csv is not None:
        with arguments.csv.open("w", encoding="utf-8", newline="") as file:
            names = list(dict.fromkeys(name for row in rows for name in row))
            writer = csv.DictWriter(file, names, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    for case in arguments.cases:
        result: dict[str, Any] = {"case": case}
        measured = [row for row in rows if row["case"] == case]
        for rate in filter(measured[0].__contains__, RATES):
            result[rate] = {}
            result[f"{rate}/ratio"] = {}
            first: list[float] = []
            for name in trees:
                values = [row[rate] for row in measured if row["tree"] == name]
                first = first or values
                ratios = [own / other for own, other in zip(values, first, strict=True)]
                result[rate][name] = median(values)
                result[f"{rate}/ratio"][name] = round(median(ratios), 4)
        print(json.dumps(result), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
