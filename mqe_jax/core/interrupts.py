"""SIGINT and SIGTERM: a training ends after the update in progress, any other command at once.

Python runs a signal's handler between two of its instructions, which compiled code may delay for
minutes, and JAX loses an exception that is raised in a callback. So in the command line a thread
waits for the signals.
"""

import contextlib
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence

_WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
_REPEATED = 1.0
"""Signals within this time count as one, s: schedulers and `timeout` send the same signal twice."""

temporaries: set[os.PathLike[str]] = set()
"""Files that are removed when a signal ends the process."""

installed = False
"""Whether `install` was called: in the command line, not in a notebook."""
_deferring = False
_noted = 0
_since = 0.0


class Interrupted(KeyboardInterrupt):
    """A signal after which everything was saved; the text says how to continue."""

    def __init__(self, text: str = "", number: int = 0) -> None:
        super().__init__(text)
        self.number = number or _noted or signal.SIGINT

    def __str__(self) -> str:
        return "; ".join(filter(None, [_WORDS[signal.Signals(self.number)], str(self.args[0])]))


def exit_code(number: int) -> int:
    """Returns the exit code of a process that a signal ended, as a shell gives it: 130 or 143."""
    return 128 + number


def install() -> None:
    """Ends the process on SIGINT and SIGTERM from now on.

    A signal that is ignored, as by `nohup`, stays ignored.
    """
    global installed
    if threading.current_thread() is not threading.main_thread():
        return
    wanted = [number for number in _WORDS if signal.getsignal(number) is not signal.SIG_IGN]
    reader, writer = socket.socketpair()  # Windows has pipes that block only
    writer.setblocking(False)
    threading.Thread(target=_watch, args=(reader, wanted), name="interrupts", daemon=True).start()
    signal.set_wakeup_fd(writer.detach(), warn_on_full_buffer=False)
    for number in wanted:
        signal.signal(number, lambda number, frame: None)
    installed = True


@contextlib.contextmanager
def defer() -> Iterator[Callable[[], int]]:
    """Yields a function that returns the signal that came since, or 0.

    A later signal ends the process at once.

    Without `install`, as in a notebook, only SIGINT is deferred, and a later one raises
    KeyboardInterrupt.
    """
    global _deferring, _noted

    def note(number: int, frame: object) -> None:
        if not _note(number):
            raise KeyboardInterrupt

    restore = None
    handled = signal.getsignal(signal.SIGINT) is not signal.SIG_IGN
    if handled and not installed and threading.current_thread() is threading.main_thread():
        restore = signal.signal(signal.SIGINT, note)
    _deferring = True
    _noted = 0
    try:
        yield lambda: _noted
    finally:
        _deferring = False
        if restore is not None:
            signal.signal(signal.SIGINT, restore)


def _note(number: int) -> bool:
    """Notes the first signal while signals are deferred; returns whether the process continues."""
    global _noted, _since
    if not _deferring:
        return False
    if not _noted:
        _noted = number
        _since = time.monotonic()
    return time.monotonic() - _since <= _REPEATED


def _watch(reader: socket.socket, wanted: Sequence[int]) -> None:
    """Waits for signals; the wake-up socket has the number of each as a byte."""
    while True:
        for number in reader.recv(64):
            if number in wanted and not _note(number):
                _exit(number)


def _exit(number: int) -> None:
    with contextlib.suppress(OSError):
        # which a bar has hidden
        cursor = "\x1b[?25h" if sys.stderr is not None and sys.stderr.isatty() else ""
        os.write(2, f"{cursor}mqe: {_WORDS[signal.Signals(number)]}\n".encode())
    for path in tuple(temporaries):
        with contextlib.suppress(OSError):
            os.unlink(path)
    os._exit(exit_code(number))
