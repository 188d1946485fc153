"""The viewer's server: which requests it answers, and what its panel does."""

import http.client
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
from viewer import Client, Driven, free_port, open_page, session

pytest.importorskip("viser")

import viser
from websockets.exceptions import InvalidStatus

from mqe_jax.core.errors import InputError
from mqe_jax.view.panel import HOLD_RATE, Panel
from mqe_jax.view.server import authorities, open_server, refusal


@pytest.fixture(scope="module")
def shown() -> Iterator[SimpleNamespace]:
    server = open_server("127.0.0.1", free_port(), "test")
    run = session(Driven())
    panel = Panel(server, run, ("robot 1", "robot 2"), lambda: None)
    yield SimpleNamespace(port=server.get_port(), session=run, panel=panel, server=server)
    server.stop()


@pytest.fixture
def said(capfd: pytest.CaptureFixture[str]) -> Callable[[], list[str]]:
    """Returns the lines on standard error, at the beginning of a second without any from earlier tests."""
    time.sleep(1.1)
    capfd.readouterr()
    return lambda: capfd.readouterr().err.splitlines()


def until(condition: Callable[[], Any], seconds: float = 30.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


@pytest.mark.parametrize(
    ("host", "address", "accepted", "refused"),
    [
        ("127.0.0.1", "127.0.0.1", "127.0.0.1 localhost LOCALHOST [::1]", "evil.org 127.0.0.2 localhost. 0.0.0.0"),
        ("localhost", "::1", "127.0.0.1 localhost [::1]", "::1 evil.org"),
        ("192.168.1.5", "192.168.1.5", "192.168.1.5", "localhost 127.0.0.1 evil.org"),
        ("server.lan", "192.168.1.5", "server.lan 192.168.1.5 Server.LAN", "localhost evil.server.lan lan"),
        ("0.0.0.0", "192.168.1.5", "192.168.1.5 0.0.0.0", "evil.org localhost"),
        ("::", "fe80::1%eth0", "[::]", "evil.org localhost"),
    ],
)
def test_only_the_servers_own_names_and_origin_are_allowed(
    host: str, address: str, accepted: str, refused: str
) -> None:
    allowed = authorities(host, address, 8080)
    for name in accepted.split():
        own = f"{name}:8080"
        assert refusal([own], [], allowed) is None
        assert refusal([own], [f"http://{own}"], allowed) is None
        others = (f"http://{name}:8081", f"https://{own}", f"http://{name}", "http://evil.org:8080", "null", "")
        for origin in others:
            assert refusal([own], [origin], allowed) is not None, origin
        assert refusal([own], [f"http://{own}", "http://evil.org"], allowed) is not None
        assert refusal([f"{name}:8081"], [], allowed) is not None
    for name in refused.split():
        assert refusal([f"{name}:8080"], [f"http://{name}:8080"], allowed) is not None, name
    assert refusal([], [], allowed) is not None
    assert refusal([f"{host}:8080"] * 2, [], allowed) is not None


def test_port_80_is_implied() -> None:
    assert refusal(["localhost"], ["http://localhost"], authorities("localhost", "127.0.0.1", 80)) is None
    assert refusal(["localhost"], ["http://localhost"], authorities("localhost", "127.0.0.1", 8080)) is not None


def test_a_foreign_origin_or_host_is_answered_with_403_and_a_line(shown: SimpleNamespace, said: Any) -> None:
    with pytest.raises(InvalidStatus) as refused:
        Client(shown.port, origin="http://evil.org")
    assert refused.value.response.status_code == 403
    for name, status in ((f"localhost:{shown.port}", 200), (f"evil.org:{shown.port}", 403)):
        connection = http.client.HTTPConnection("127.0.0.1", shown.port)
        connection.request("GET", "/", headers={"Host": name})
        response = connection.getresponse()
        text = response.read().decode(errors="replace")
        assert response.status == status
        if status == 200:
            assert response.headers["Content-Security-Policy"] == "frame-ancestors 'none'"
        else:
            assert text.startswith("mqe view: Host is evil.org") and text.count("\n") == 1
        connection.close()
    with Client(shown.port, origin=f"http://127.0.0.1:{shown.port}") as client:
        assert client.panel().widgets
    lines = said()
    assert len(lines) == 2
    assert lines[0].startswith("mqe: view: refused a connection: Origin is http://evil.org, allowed: http://127.0.0.1:")


def test_rewinding_pauses_and_shows_an_earlier_step(shown: SimpleNamespace) -> None:
    run, panel = shown.session, shown.panel
    run.drive.env, run.drive.robot = 0, 0
    for step in range(4):
        run.drive.command = np.array([0.25 * step, 0.0, 0.0])
        run.advance()
    places = [moment.frame.qpos[0, run.env.robot_x[0]] for moment in run.moments]
    with Client(shown.port) as client:
        seen = client.panel()
        client.update(seen.uuid("Back"), 2 * run.env.dt)
        until(lambda: panel.back == 2)
        assert run.paused and run.moment(panel.back).frame.qpos[0, run.env.robot_x[0]] == places[-3] != places[-1]
        panel.show(np.zeros((2, 3)), 1.0)
        client.update(seen.uuid("Contacts"), True)
        until(lambda: panel.contacts)
        client.update(seen.uuid("Contacts"), False)
        client.update(seen.uuid("Pause"), True)
        until(lambda: not run.paused)
    with Client(shown.port) as client:
        text = client.panel().values["state"]
    assert f"at {(run.steps - 2) * run.env.dt:.2f} s, paused" in text and ">1 (driven)<" in text and ">0.00<" in text
    assert "episodes: success 0 of" in text and ">+0.25<" in text
    assert panel.back == 0 and run.moment(1000) is run.moments[0]
    run.drive.command, run.drive.robot = np.zeros(3), None


def test_keys_and_held_buttons_count_and_waiting_steps_are_limited(shown: SimpleNamespace) -> None:
    run, panel = shown.session, shown.panel
    with Client(shown.port) as client:
        seen = client.panel()
        client.send({"type": "CommandTriggerMessage", "uuid": seen.commands["Forward"]})
        until(lambda: run.drive.now()[0] == 0.25)
        client.send({"type": "CommandTriggerMessage", "uuid": seen.commands["Stop"]})
        until(lambda: run.drive.now()[0] == 0.0)
        client.send({"type": "GuiButtonHoldMessage", "uuid": seen.uuid("Forward"), "frequency": 0.0})
        client.send({"type": "GuiButtonHoldMessage", "uuid": seen.uuid("Turn left"), "frequency": HOLD_RATE})
        until(lambda: run.drive.now()[2] > 0.0)
        assert run.drive.now()[0] == 0.0
        for _ in range(100):
            client.update(seen.uuid("One step"), True)
        client.update(seen.uuid("Reset"), True)
        until(panel.take_reset)
    assert 1 <= panel.take_steps() <= 25 and panel.take_steps() == 0


def test_a_viser_without_the_hook_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    stopped = []

    class Other:
        """A server that is not started by websockets.asyncio.server.serve."""

        def __init__(self, **_: Any) -> None:
            pass

        def stop(self) -> None:
            stopped.append(True)

    monkeypatch.setattr(viser, "ViserServer", Other)
    with pytest.raises(InputError, match=r"view: viser .* cannot be restricted \(pip install 'viser==1.1.1' can\)"):
        open_server("127.0.0.1", free_port(), "test")
    assert stopped == [True]


def listening(port: int) -> set[str]:
    """Local addresses, as the kernel writes them, on which a port is listened to."""
    rows = [line.split() for name in ("tcp", "tcp6") for line in Path("/proc/net", name).read_text().splitlines()[1:]]
    places = [row[1].rsplit(":", 1) for row in rows if row[3] == "0A"]
    return {address for address, number in places if int(number, 16) == port}


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="no /proc/net/tcp to read the sockets from")
def test_the_command_listens_on_this_machine_only_plays_and_ends_with_130() -> None:
    port = free_port()
    # A shell starts background jobs with SIGINT ignored, which children inherit.
    program = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
    program += "from mqe_jax.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", program, "view", "go1gate", "--policy", "idle", "--port", str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            assert process.stdout is not None
            assert f"http://127.0.0.1:{port}" in next(line for line in process.stdout if "open http" in line)
            threading.Thread(target=process.stdout.read, daemon=True).start()  # a full pipe would stop the viewer
            assert listening(port) == {"0100007F"}

            def plays() -> bool:
                with Client(port) as client:
                    return " at " in client.panel().values.get("state", "")

            until(plays, 240.0)  # without compiled programs
            process.send_signal(signal.SIGINT)
            assert process.wait(30) == 130
        finally:
            process.kill()


EVIL = "<iframe srcdoc=\"<script>top.ran = 'iframe'</script>\"></iframe><img src=x onerror=\"ran = 'img'\">![](a.png)"


def test_no_text_of_the_panel_runs_as_html(monkeypatch: pytest.MonkeyPatch) -> None:
    """Names of the task, robots, rewards and observations, choices, outcomes, and errors that hold paths."""
    pytest.importorskip("mjviser")
    from mqe_jax.view.menu import Entry, Menu
    from mqe_jax.view.viewer import Viewer

    def fail(choice: object) -> Any:
        raise InputError(f"runs/{EVIL}: damaged")

    env: Any = Driven()
    env.name = EVIL
    env.observation_layout = SimpleNamespace(blocks=[SimpleNamespace(name=EVIL)], slice=lambda name: slice(None))
    run = session(env)
    monkeypatch.setattr("mqe_jax.view.viewer.start_frame", lambda *_: run.moment().frame)
    with open_page(640, 480) as page:
        viewer = Viewer(port=free_port(), menu=Menu(fail, Entry("go1gate", EVIL), {EVIL: "go1gate"}))
        viewer.announce(env, 2)
        page.goto(viewer.url)
        page.get_by_text("is being compiled").wait_for()
        run.terms, run.last = (EVIL, run.terms[-1]), [EVIL, EVIL]
        viewer.show(run)
        viewer._panel._robots = (EVIL, EVIL)
        run.advance()
        viewer._panel.show(np.zeros((2, 3)), 1.0)
        page.get_by_text("x real time").wait_for()
        page.get_by_text("Observation of the driven robot").click()
        assert page.evaluate("window.ran") is None and page.locator("body").inner_text().count(EVIL) >= 6
        viewer._panel._wanted = Entry("go1gate", EVIL)
        assert not viewer._open_chosen()
        page.get_by_text("not loaded: runs/<iframe").wait_for()
        assert page.evaluate("window.ran") is None and page.locator("iframe").count() == 0
        viewer.server.stop()
