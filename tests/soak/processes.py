"""Processes watched from outside: a function with a limit of time and memory; memory of a training over time."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from tests.soak.__main__ import Report


SECONDS, BYTES = 20.0, 2 * 10**9
"""Largest computing time, s, and resident memory of a process."""
WAITING = 3.0
"""A process is killed after that many times `SECONDS`: on a busy machine it waits for the processor."""


@dataclass(frozen=True)
class Outcome:
    """How a process ended."""

    code: int | None
    """Exit code; None where it was killed."""
    said: str
    """Standard error."""
    seconds: float
    """Time it took."""
    computing: float
    """Time for which it used a processor, s."""
    memory: int
    """Largest resident memory, bytes."""
    left: list[str]
    """Names of the files in its folder, at any depth."""

    def failures(self, code: int | tuple[int, ...]) -> list[str]:
        """Returns what is wrong, where one of the exit codes is expected."""
        codes = (code,) if isinstance(code, int) else code
        wrong = [] if self.code in codes else [f"exit code {self.code}: {self.said[-200:]!r}"]
        wrong += ["a traceback"] if "Traceback" in self.said else []
        slow = self.computing > SECONDS or self.seconds > WAITING * SECONDS
        wrong += [f"{self.seconds:.0f} s, {self.computing:.0f} s of them computing"] if slow else []
        wrong += [f"{self.memory / 1e9:.1f} GB"] if self.memory > BYTES else []
        # What tyro says of flags has a frame of several lines.
        lines = [line for line in self.said.splitlines() if line.strip() and line[0] not in "╭│╰─"]
        wrong += [f"{len(lines)} lines: {self.said[:200]!r}"] if self.code == 2 and len(lines) > 1 else []
        return wrong + [f"left {name}" for name in self.left if name.rpartition("/")[2].startswith(".")]


def contained(act: Callable[[], int], prepare: Callable[[Path], None] = lambda folder: None) -> Outcome:
    """Runs `act`, which returns an exit code, in a fork of this process, whose modules are imported already.

    This process must not have started JAX's backend, whose threads a fork lacks. `prepare` fills the folder first.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name, "work")
        folder.mkdir()
        prepare(folder)
        said = Path(name, "said")
        began = time.monotonic()
        pid = os.fork()
        if pid == 0:
            _child(act, folder, said)
        memory = 0
        while not (ended := os.wait4(pid, os.WNOHANG))[0]:
            memory = max(memory, _resident(pid))
            if time.monotonic() - began > WAITING * SECONDS or memory > BYTES:
                os.kill(pid, signal.SIGKILL)
            time.sleep(0.005)
        _, status, usage = ended
        left = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))
        code = os.WEXITSTATUS(status) if os.WIFEXITED(status) else None
        text = said.read_text(encoding="utf-8", errors="replace")
        return Outcome(code, text, time.monotonic() - began, usage.ru_utime + usage.ru_stime, memory, left)


def _resident(pid: int) -> int:
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, IndexError):
        return 0


def _child(act: Callable[[], int], folder: Path, said: Path) -> None:
    """Runs the act with its output in files; does not return."""
    code = 1
    try:
        os.chdir(folder)
        os.dup2(os.open(os.devnull, os.O_RDWR), 0)
        os.dup2(os.open(os.devnull, os.O_RDWR), 1)
        os.dup2(os.open(said, os.O_WRONLY | os.O_CREAT), 2)
        code = act()
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else 1
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


# -- memory and descriptors of a training ------------------------------------------------------------------------------

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
