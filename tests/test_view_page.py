"""`mqe view` as a process: its sockets, its page in a real browser, pages of other origins, and bad messages."""

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from viewer import Client, Panel, free_port

msgspec: Any = pytest.importorskip("msgspec")  # of viser
STARTUP = 240.0  # s, on a loaded machine without compiled programs


def listening(port: int) -> set[str]:
    """Local addresses, as the kernel writes them, on which a port is listened to."""
    found = set()
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        for line in Path(table).read_text().splitlines()[1:]:
            local, state = line.split()[1], line.split()[3]
            address, number = local.rsplit(":", 1)
            if state == "0A" and int(number, 16) == port:
                found.add(address)
    return found


@pytest.fixture(scope="module")
def viewer() -> Iterator[SimpleNamespace]:
    """A running `mqe view` of two idle robots."""
    pytest.importorskip("viser")
    port = free_port()
    command = ["view", "go1gate", "--policy", "idle", "--port", str(port), "--set", "episode_length=600"]
    command += ["--set", "end_on_collision=false"]
    # A shell starts background jobs with SIGINT ignored, which children inherit.
    program = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
    program += "from mqe_jax.cli import main; sys.exit(main())"
    with subprocess.Popen(
        [sys.executable, "-c", program, *command], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        assert process.stdout is not None
        said = ""
        for line in process.stdout:
            said += line
            if "open http" in line:
                break
        threading.Thread(target=process.stdout.read, daemon=True).start()  # a full pipe would stop the viewer
        viewer = SimpleNamespace(port=port, process=process, said=said)
        wait_for_panel(viewer, lambda panel: " at " in panel.values["state"], STARTUP)
        yield viewer
        process.send_signal(signal.SIGINT)
        try:
            assert process.wait(30) == 130
        finally:
            process.kill()


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="no /proc/net/tcp to read the sockets from")
def test_nothing_listens_beyond_this_machine(viewer: SimpleNamespace) -> None:
    assert f"http://127.0.0.1:{viewer.port}" in viewer.said
    assert listening(viewer.port) == {"0100007F"}


def wait_for_panel(viewer: SimpleNamespace, condition: Callable[[Panel], bool], seconds: float = 30.0) -> Panel:
    """Connects anew until the panel meets a condition; returns it."""
    end = time.monotonic() + seconds
    while True:
        with Client(viewer.port) as client:
            panel = client.panel()
        if "state" in panel.values and condition(panel):
            return panel
        assert time.monotonic() < end, panel.values.get("state")
        time.sleep(0.2)
