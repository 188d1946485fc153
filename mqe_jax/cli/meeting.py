"""The processes of a training meet at the coordinator's address before they join JAX's service on the same port.

JAX waits for minutes where one is missing, and aborts where another program answers or numbers of processes differ.
A process sends a line with the number of processes and its index; process 0 answers when all have come, or why not.
"""

from __future__ import annotations

import contextlib
import re
import socket
import time

from mqe_jax.errors import InputError, brief
from mqe_jax.settings import fail

LIMIT = 40.0
"""Time in which all processes come, s."""
_LINE = 200  # bytes, at most


def meet(address: str, index: int, count: int) -> None:
    """Returns when all `count` processes have come to HOST:PORT, which process 0 listens on.

    Raises:
        InputError: for a port that is in use, another program that answers, an unknown host, a process of another
            number of processes, and for those that have not come within `LIMIT`.
    """
    host, _, port = address.rpartition(":")
    end = time.monotonic() + LIMIT
    if index == 0:
        _wait(address, "127.0.0.1" if host == "127.0.0.1" else "", int(port), count, end)
    else:
        _come(address, host.strip("[]"), int(port), f"mqe {count} {index}\n", end)


def _wait(address: str, host: str, port: int, count: int, end: float) -> None:
    """Waits for the others as process 0; one that comes again, such as after Ctrl-C, takes its earlier place."""
    there: dict[int, socket.socket] = {}
    with contextlib.ExitStack() as stack:
        try:
            server = stack.enter_context(socket.create_server((host, port)))
        except OSError as error:
            fail("coordinator", address, f"a free port of this host, of process 0 ({error.strerror})")
        while missing := sorted({*range(1, count)} - there.keys()):
            server.settimeout(max(end - time.monotonic(), 0.01))
            try:
                connection = stack.enter_context(server.accept()[0])
            except TimeoutError:
                which = ", ".join(map(str, missing))
                raise InputError(f"coordinator: of {count} processes {which} did not come within {LIMIT:g} s") from None
            words = re.fullmatch(r"mqe (\d+) (\d+)\n", _line(connection, 2.0))
            if words is None:
                continue  # another program
            if int(words[1]) != count:
                _say(connection, f"--processes is {count} in process 0")
                continue
            if int(words[2]) in there:
                _say(there[int(words[2])], f"another process has --index {words[2]}")
            there[int(words[2])] = connection
        for connection in there.values():
            _say(connection, "")


def _come(address: str, host: str, port: int, line: str, end: float) -> None:
    """Comes to process 0, which may start later, as another process."""
    while time.monotonic() < end:
        answer = ""
        try:
            with socket.create_connection((host, port), timeout=5.0) as connection:
                connection.sendall(line.encode())
                answer = _line(connection, max(end - time.monotonic(), 0.01))
        except socket.gaierror as error:
            fail("coordinator", address, f"HOST:PORT of process 0 ({error.strerror})")
        except OSError:
            time.sleep(0.2)
        if answer == "mqe\n":
            return
        if answer.startswith("mqe "):
            raise InputError(f"coordinator: {brief(answer[4:].strip())}")
        if answer:
            fail("coordinator", address, "HOST:PORT of process 0; another program answers there")
    raise InputError(f"coordinator: process 0 did not answer on {address} within {LIMIT:g} s")


def _line(connection: socket.socket, seconds: float) -> str:
    """Returns the first line that comes, or an empty string."""
    connection.settimeout(seconds)
    with contextlib.suppress(OSError), connection.makefile("rb") as file:
        return file.readline(_LINE).decode(errors="replace")
    return ""


def _say(connection: socket.socket, refusal: str) -> None:
    with contextlib.suppress(OSError):
        connection.sendall(f"mqe {refusal}".strip().encode() + b"\n")
