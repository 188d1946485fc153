"""SIGINT and SIGTERM in the command line: a training is saved first, everything else ends at once.

A signal raises no exception, which an import in C, a callback of JAX or a destructor could swallow. It wakes up a
thread, also while the main thread computes or compiles, which runs the registered acts, prints one line and ends the
process.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NoReturn

from mqe_jax.errors import one_line
from mqe_jax.literal import line

Act = Callable[[], str | None]

_WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
_REPEATED = 1.0
"""Signals within this time count as one, s: schedulers and `timeout` send the same signal twice."""

temporaries: set[os.PathLike[str]] = set()
"""Files that are removed when a signal ends the process."""

_acts: list[Act] = []
_ending = threading.Event()


def exit_code(number: int) -> int:
    """Returns the exit code of a process that a signal ended, as a shell gives it: 130 or 143."""
    return 128 + number


def install() -> None:
    """Ends the process on SIGINT and SIGTERM from now on. A signal that is ignored, as by `nohup`, stays ignored."""
    if threading.current_thread() is not threading.main_thread():
        return
    wanted = [number for number in _WORDS if signal.getsignal(number) is not signal.SIG_IGN]
    reader, writer = socket.socketpair()  # Windows has pipes that block only
    writer.setblocking(False)
    threading.Thread(target=_watch, args=(reader, wanted), name="interrupts", daemon=True).start()
    signal.set_wakeup_fd(writer.detach(), warn_on_full_buffer=False)
    for number in wanted:
        signal.signal(number, lambda number, frame: None)


@contextlib.contextmanager
def before_exit(act: Act) -> Iterator[None]:
    """Registers what is done, by another thread, when a signal ends the process: the last registered act first.

    The text that an act returns, or the message of its exception, becomes part of the line on standard error. A second
    signal ends the process without waiting for the acts.
    """
    _acts.append(act)
    try:
        yield
    finally:
        _acts.remove(act)


@contextlib.contextmanager
def child(command: Sequence[str], **options: Any) -> Iterator[Any]:
    """Starts a program as `subprocess.Popen` does, killed at an exception or when a signal ends this process."""
    import subprocess  # 5 ms, which `install` should not wait for

    with subprocess.Popen(command, **options) as process, before_exit(process.kill):
        try:
            yield process
        except BaseException:
            process.kill()
            raise


def settle() -> None:
    """Does not return while a signal ends the process, so that the main thread reports no error of that."""
    if _ending.is_set():
        threading.Event().wait()


def end() -> NoReturn:
    """Ends the process as SIGTERM does, and its main thread here."""
    if not _ending.is_set():
        signal.raise_signal(signal.SIGTERM)  # `os.kill` of Windows runs no handler
    while True:
        threading.Event().wait()


def _watch(reader: socket.socket, wanted: Sequence[int]) -> None:
    """Waits for signals; the wake-up socket has the number of each as a byte."""
    began = 0.0
    while True:
        for number in reader.recv(64):
            if number not in wanted:
                continue
            if not _ending.is_set():
                began = time.monotonic()
                _ending.set()
                if not _acts:
                    _exit(number)
                threading.Thread(target=_end, args=(number,), daemon=True).start()
            elif time.monotonic() - began > _REPEATED:
                _exit(number)


def _end(number: int) -> None:
    said = []
    for act in reversed(_acts[:]):
        try:
            said.append(act())
        except Exception as error:
            said.append(one_line(error))
    _exit(number, *filter(None, said))


def _exit(number: int, *said: str) -> None:
    text = line("; ".join([f"mqe: {_WORDS[signal.Signals(number)]}", *said]))
    with contextlib.suppress(OSError):
        # A reader that has stopped would block for ever; Windows selects sockets only.
        if os.name != "posix" or select.select([], [2], [], 1.0)[1]:
            os.write(2, f"{text}\n".encode())
    for path in tuple(temporaries):
        with contextlib.suppress(OSError):
            os.unlink(path)
    os._exit(exit_code(number))
