"""Memory and descriptors of a training over time."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from statistics import median
from typing import NamedTuple

from tests.soak.report import Report

WARM_UP = 300.0
"""Time after which memory should not grow, s."""
GROWTH = 0.05
"""Largest growth of memory after that time."""
EVERY = 2.0  # s


class Sample(NamedTuple):
    """A process at one time."""

    seconds: float
    """Time since the first sample, s."""
    memory: int
    """Resident memory, bytes."""
    descriptors: int
    """Open files."""
    threads: int
    """Threads."""


def sample(pid: int, began: float) -> Sample:
    """Reads a process from /proc; OSError where it has ended."""
    proc = Path(f"/proc/{pid}")
    pages = int((proc / "statm").read_text().split()[1])
    counts = (len(os.listdir(proc / name)) for name in ("fd", "task"))
    return Sample(time.monotonic() - began, pages * os.sysconf("SC_PAGE_SIZE"), *counts)


def memory(report: Report) -> None:
    """Trains with evaluations and checkpoints until the time is over; compares early with late samples."""
    if not list(report.pending("memory", ["train"])):
        return
    run = report.folder / "kept" / "long"
    shutil.rmtree(run, ignore_errors=True)
    command = [sys.executable, "-m", "mqe_jax.cli", "train", "go1gate", "--impl", report.options.engine]
    command += ["--config", "demo", "--num-envs", "64", "--total-steps", "1000000000", "--checkpoint.every", "5"]
    command += ["--evaluation.every", "10", "--evaluation.episodes", "8", "--run-dir", str(run)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        samples, began = [], 0.0
        while process.poll() is None and report.seconds_left() > 0.0:
            if not began and (run / "evaluations.json").exists():
                began = time.monotonic()  # everything is compiled
            if began:
                samples.append(sample(process.pid, began))
            time.sleep(EVERY)
        process.send_signal(signal.SIGTERM)
        code = process.wait(60)
    wrong = [] if code == 143 else [f"ended with {code}"]
    report.add("memory", "train", *judged(samples, wrong))
    shutil.rmtree(run, ignore_errors=True)


def judged(samples: list[Sample], wrong: list[str]) -> tuple[dict[str, float], list[str]]:
    """Returns medians of the minute around the end of the warm-up and of the last minute, and what grew."""
    if not samples:
        return {"minutes": 0.0}, [*wrong, "the time was over before the first evaluation"]
    last = samples[-1].seconds
    warm = min(WARM_UP, last / 2)
    early = [s for s in samples if abs(s.seconds - warm) <= 30.0]
    late = [s for s in samples if s.seconds >= last - 60.0]
    growth = median(s.memory for s in late) / median(s.memory for s in early) - 1.0
    if growth > GROWTH:
        wrong.append(f"memory grew by {100 * growth:.1f}%")
    row = {"minutes": round(last / 60, 1), "growth_%": round(100 * growth, 2)}
    for name in ("memory", "descriptors", "threads"):
        values = [median(getattr(s, name) for s in part) for part in (early, late)]
        row |= {f"{name}_early": values[0], f"{name}_late": values[1]}
        if name != "memory" and values[1] > values[0] + 2:
            wrong.append(f"{name}: {values[0]:.0f}, later {values[1]:.0f}")
    return row, wrong
