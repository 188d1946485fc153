"""A function in a process of its own, with a limit of time and memory, in an empty folder."""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

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
