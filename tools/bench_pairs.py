"""Compares the throughput of two checkouts: `mqe bench` in each of them in turn, medians and ratios of the pairs.

`python tools/bench_pairs.py BEFORE AFTER --pairs 5 --csv FILE -- go1gate --impl c --num-envs 256` runs the
same bench in both checkouts, one after the other, five times, so that a machine whose speed drifts slows both alike.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
from pathlib import Path
from statistics import median

RATES = ("env_steps_per_s", "bare_env_steps_per_s")


def bench(tree: Path, arguments: list[str]) -> dict[str, object]:
    """One `mqe bench --json` of the package in `tree`."""
    command = [sys.executable, "-m", "mqe_jax.cli", "bench", *arguments, "--json"]
    path = os.pathsep.join([str(tree.resolve()), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    done = subprocess.run(
        command, cwd=tree, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise SystemExit(f"{tree}: {' '.join(command)} failed:\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.strip().splitlines()[-1])


def main() -> int:
    """Runs the pairs and prints one JSON object."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--csv", type=Path, help="append one row per bench to this file")
    parser.add_argument("bench", nargs="+", help="arguments of mqe bench, after --")
    arguments = parser.parse_args()
    rows: list[dict[str, object]] = []
    for pair in range(arguments.pairs):
        for name in ("before", "after"):
            figures = bench(getattr(arguments, name), arguments.bench)
            kept = {key: figures[key] for key in ("task", "impl", "num_envs", *RATES, "device", "jax")}
            rows.append({"pair": pair, "tree": name, **kept})
            print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    result: dict[str, object] = {"bench": " ".join(arguments.bench), "pairs": arguments.pairs}
    for rate in RATES:
        values = {name: [float(str(r[rate])) for r in rows if r["tree"] == name] for name in ("before", "after")}
        ratios = [a / b for b, a in zip(values["before"], values["after"], strict=True)]
        result[rate] = {
            "before": median(values["before"]), "after": median(values["after"]), "ratio": round(median(ratios), 4),
            "ratios": [round(ratio, 4) for ratio in ratios],
        }  # fmt: skip
    if arguments.csv is not None:
        new = not arguments.csv.exists()
        with arguments.csv.open("a", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
            if new:
                writer.writeheader()
            writer.writerows(rows)
    print(json.dumps(result), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
