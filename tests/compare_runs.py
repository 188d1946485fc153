"""Compares two training runs bit for bit: every metric but times, and every array of the policy.

`python -m tests.compare_runs RUN_A RUN_B [--rename OLD=NEW ...]` exits with 1 and names the first difference of each
kind. With `--rename`, columns and arrays of RUN_A are looked up under a new name in RUN_B.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import numpy as np
from safetensors.numpy import load_file


def content(run: Path) -> dict[str, np.ndarray]:
    """Returns the columns of a run's metrics.csv, as text, without those of times, and the arrays of its policy."""
    with (run / "metrics.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0] if name not in ("seconds", "fps")}
    return columns | load_file(run / "policy.safetensors")


def main() -> int:
    """Prints the differences; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs=2, type=Path)
    parser.add_argument("--rename", nargs="*", default=[], metavar="OLD=NEW")
    arguments = parser.parse_args()
    names = dict(pair.split("=", 1) for pair in arguments.rename)
    first, second = map(content, arguments.runs)
    first = {names.get(name, name): values for name, values in first.items()}
    found = [f"{name}: only in one run" for name in first.keys() ^ second.keys()]
    for name in first.keys() & second.keys():
        a, b = first[name], second[name]
        if a.shape != b.shape:
            found.append(f"{name}: {a.shape} and {b.shape}")
        elif not np.array_equal(a, b):
            place = tuple(np.argwhere(a != b)[0].tolist())
            found.append(f"{name}: at {place} {a[place]} and {b[place]}")
    print("\n".join(found) or f"equal: {len(first)} metrics and arrays of the policy")
    return 1 if found else 0


if __name__ == "__main__":
    raise SystemExit(main())
