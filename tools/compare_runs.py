"""Compares two training runs bit for bit: every metric but times, and every array of the policy.

`python tools/compare_runs.py RUN_A RUN_B [--rename OLD=NEW ...]` exits with 1 and names the first difference of each
kind. With `--rename`, columns and arrays of RUN_A are looked up under a new name in RUN_B.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import numpy as np
from safetensors.numpy import load_file

TIMES = {"seconds", "fps"}


def columns(run: Path) -> dict[str, list[str]]:
    """Columns of a run's metrics.csv, as text, without those of times."""
    with (run / "metrics.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: [row[name] for row in rows] for name in rows[0] if name not in TIMES}


def differences(first: dict[str, list[str]], second: dict[str, list[str]]) -> list[str]:
    """Returns the columns that differ, with the first differing row."""
    found = [f"{name}: only in one run" for name in first.keys() ^ second.keys()]
    for name in first.keys() & second.keys():
        if len(first[name]) != len(second[name]):
            found.append(f"{name}: {len(first[name])} and {len(second[name])} rows")
        pairs = enumerate(zip(first[name], second[name], strict=False))
        found += [f"{name}: row {row}: {a} and {b}" for row, (a, b) in pairs if a != b][:1]
    return found


def main() -> int:
    """Prints the differences; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs=2, type=Path)
    parser.add_argument("--rename", nargs="*", default=[], metavar="OLD=NEW")
    arguments = parser.parse_args()
    names = dict(pair.split("=", 1) for pair in arguments.rename)
    tables = [columns(run) for run in arguments.runs]
    tables[0] = {names.get(name, name): values for name, values in tables[0].items()}
    found = differences(*tables)
    policies = [load_file(run / "policy.safetensors") for run in arguments.runs]
    policies[0] = {names.get(name, name): value for name, value in policies[0].items()}
    found += [f"policy {name}: only in one run" for name in policies[0].keys() ^ policies[1].keys()]
    for name in policies[0].keys() & policies[1].keys():
        if not np.array_equal(policies[0][name], policies[1][name]):
            found.append(f"policy {name}: differs")
    rows = len(next(iter(tables[0].values())))
    print("\n".join(found) or f"equal: {len(tables[0])} metrics x {rows} updates, {len(policies[0])} policy arrays")
    return 1 if found else 0


if __name__ == "__main__":
    raise SystemExit(main())
