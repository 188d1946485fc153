"""`mqe view` as a process: its sockets, its page in a real browser, pages of other origins, and bad messages."""

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from viewer import Client, Panel, free_port, open_page

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


class Page:
    """The viewer's page, as rendered."""

    def __init__(self, page: Any) -> None:
        self.page = page

    def robots(self) -> np.ndarray:
        """x, y, z, vx, vy, turn of each robot, from the table (A, 6)."""
        cells: list[list[str]] = [[]]
        while not all(len(row) == 6 for row in cells):  # the page may be drawing the table anew
            rows = self.page.locator("table").first.locator("tbody tr").all_inner_texts()
            cells = [row.split("\t")[1:] for row in rows] or [[]]
        return np.array(cells, float)

    def text(self) -> str:
        return self.page.locator("body").inner_text()

    def until(self, condition: Callable[[], bool], seconds: float = 60.0) -> None:
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, f"not within {seconds} s; the page says: {self.text()[:400]}"
            time.sleep(0.1)

    def choose(self, label: str, option: str) -> None:
        self.page.get_by_label(label, exact=True).first.click()
        self.page.get_by_role("option", name=re.compile(rf"^{option}\b")).click()


@pytest.fixture(scope="module")
def page(viewer: SimpleNamespace) -> Iterator[Page]:
    with open_page(640, 480) as tab:
        tab.goto(f"http://127.0.0.1:{viewer.port}")
        tab.wait_for_selector("table", timeout=1000 * STARTUP)
        yield Page(tab)


def test_a_robot_is_driven_from_the_page(page: Page) -> None:
    """Hold the drive button, then press keys: only the selected robot moves on the page."""
    page.choose("Driven", "robot 2")
    page.until(lambda: "(driven)" in page.text())
    start = page.robots()
    button = page.page.get_by_role("button", name="Forward", exact=True)
    button.scroll_into_view_if_needed()
    box = button.bounding_box()
    page.page.mouse.move(box["x"] + 9, box["y"] + 9)
    page.page.mouse.down()
    page.until(lambda: page.robots()[1, 3] == 1.0 and page.robots()[1, 0] > start[1, 0] + 0.3)
    page.page.mouse.up()
    page.until(lambda: page.robots()[1, 3] == 0.0)
    moved = page.robots()
    assert moved[1, 0] - start[1, 0] > 2 * abs(moved[0, 0] - start[0, 0])  # idle robots step in place and drift slowly
    page.page.mouse.move(5, 5)
    page.page.keyboard.press("j")
    page.page.keyboard.press("j")
    page.until(lambda: page.robots()[1, 5] == 0.25)
    page.page.keyboard.press("k")
    page.until(lambda: page.robots()[1, 3] == -0.25)
    page.until(lambda: page.robots()[1, 0] < moved[1, 0] - 0.1)
    page.page.keyboard.press("x")
    page.until(lambda: bool(np.all(page.robots()[1, 3:] == 0.0)))
    assert np.all(page.robots()[0, 3:] == 0.0)


def test_the_page_pauses_steps_and_resets(page: Page) -> None:
    def seconds() -> float:
        return float(page.text().split(" at ")[1].split(" s")[0])

    page.page.keyboard.press("p")
    page.until(lambda: "paused" in page.text())
    before = seconds()
    page.page.keyboard.press("n")
    page.until(lambda: seconds() > before)
    assert seconds() == pytest.approx(before + 0.02, abs=0.005)
    page.page.get_by_role("button", name="Reset", exact=True).click()
    page.until(lambda: bool(np.all(np.abs(page.robots()[:, 0] - 1.0) < 0.05)))
    page.page.get_by_role("button", name="Continue", exact=True).click()
    page.until(lambda: seconds() > before + 0.5)
    page.choose("Camera", "robot 2")
    page.until(lambda: page.page.get_by_label("Camera", exact=True).first.input_value().startswith("robot 2"))
    assert page.page.locator("canvas").count() >= 2  # the scene, and the plots
    if folder := os.environ.get("MQE_SCREENSHOTS"):
        page.page.screenshot(path=str(Path(folder) / "view.png"))
