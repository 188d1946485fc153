"""The processes of a training that meet, or do not: each ends with one line that names what is wrong."""

import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any

import pytest

from mqe_jax.cli import launch, meeting
from mqe_jax.cli.meeting import meet
from mqe_jax.errors import InputError


@pytest.fixture
def address(monkeypatch: pytest.MonkeyPatch) -> str:
    """A free port of this machine, on which processes wait briefly."""
    monkeypatch.setattr(meeting, "LIMIT", 1.0)
    with socket.create_server(("127.0.0.1", 0)) as free:
        return f"127.0.0.1:{free.getsockname()[1]}"


@pytest.fixture
def start() -> Iterator[Callable[..., Any]]:
    with ThreadPoolExecutor() as pool:
        yield pool.submit


def test_all_meet_whoever_comes_first(address: str, start: Callable[..., Any]) -> None:
    later = [start(meet, address, index, 3) for index in (2, 1)]
    meet(address, 0, 3)
    assert [process.result() for process in later] == [None, None]
    meet(address, 0, 1)


@pytest.mark.parametrize(
    ("answer", "index", "said"),
    [
        (None, 0, r"coordinator: .* is not allowed; it must be a free port of this host, of process 0 \(Address"),
        (None, 1, r"coordinator: process 0 did not answer on 127\.0\.0\.1:\d+ within 1 s"),
        (b"HTTP/1.1 400 Bad Request\r\n", 1, "coordinator: .* of process 0; another program answers there"),
        (bytes(1000), 1, "coordinator: .* of process 0; another program answers there"),
    ],
)
def test_another_program_has_the_port(
    answer: bytes | None, index: int, said: str, address: str, start: Callable[..., Any]
) -> None:
    with socket.create_server(("127.0.0.1", int(address.split(":")[1]))) as other:
        if answer is not None:
            start(lambda: other.accept()[0].sendall(answer))
        with pytest.raises(InputError, match=said):
            meet(address, index, 2)


def test_those_that_do_not_come_are_named(address: str, start: Callable[..., Any]) -> None:
    waiting = start(meet, address, 0, 4)
    came = start(meet, address, 2, 4)
    with pytest.raises(InputError, match="coordinator: of 4 processes 1, 3 did not come within 1 s"):
        waiting.result()
    with pytest.raises(InputError, match="coordinator: process 0 did not answer"):
        came.result()
    with pytest.raises(InputError, match=r"coordinator: 'no\.invalid:1' is not allowed; it must be HOST:PORT"):
        meet("no.invalid:1", 1, 2)


def test_one_that_was_started_wrongly_does_not_keep_the_others_from_meeting(
    address: str, start: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor does another program that connects, such as a scanner of ports."""
    monkeypatch.setattr(meeting, "LIMIT", 10.0)
    waiting = start(meet, address, 0, 3)
    with pytest.raises(InputError, match="coordinator: --processes is 3 in process 0"):
        meet(address, 1, 4)
    host, port = address.split(":")
    with socket.create_connection((host, int(port))) as scanner:
        scanner.sendall(b"GET / HTTP/1.1\r\n")
    refused, came = wait([start(meet, address, 1, 3) for _ in range(2)], return_when="FIRST_COMPLETED")
    assert [str(each.exception()) for each in refused] == ["coordinator: another process has --index 1"]
    meet(address, 2, 3)
    assert [each.result() for each in (waiting, *came)] == [None, None]


def test_a_process_that_jax_keeps_waiting_ends_with_a_line() -> None:
    """Of two tasks of SLURM one is missing."""
    slurm = {"PROCID": "0", "LOCALID": "0", "NTASKS": "2", "JOB_ID": "4242", "STEP_NODELIST": "127.0.0.1"}
    variables = {f"SLURM_{name}": value for name, value in slurm.items()} | {"SLURM_STEP_NUM_NODES": "1"}
    program = "from mqe_jax.cli import launch; launch.LIMIT = 1.0; launch.join()"
    with subprocess.Popen(
        [sys.executable, "-c", program],
        env={**os.environ, **variables, launch.MEMBER: launch.AUTO},
        stdin=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.wait(60) == 2 and process.stderr is not None
        assert process.stderr.read().splitlines()[-1] == (
            "mqe: coordinator: the other processes did not come within 1 s"
        )
