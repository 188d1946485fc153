"""The viewer's server, its scene and its panel: which requests it answers, what it draws, what
widgets do.
"""

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

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from viewer import Client, Driven, free_port, open_page, session

from tests.fake_env import FakeEnv
from tests.inputs import refuses

pytest.importorskip("mjviser")

import viser
from websockets.exceptions import InvalidStatus

from mqe_jax import make
from mqe_jax.core.errors import InputError
from mqe_jax.sensors.marks import marks
from mqe_jax.view.menu import Entry, Menu
from mqe_jax.view.overlay import _METRES_PER_NEWTON, Overlay, contact_arrows
from mqe_jax.view.panel import HOLD_RATE, Panel, robot_labels
from mqe_jax.view.server import authorities, open_server, refusal
from mqe_jax.view.stage import Stage
from mqe_jax.view.viewer import Viewer
from mqe_jax.viz.recording import Episode


@pytest.fixture(scope="module")
def shown() -> Iterator[SimpleNamespace]:
    server = open_server("127.0.0.1", free_port(), "test")
    run = session(Driven())
    panel = Panel(server, run, ("robot 1", "robot 2"), lambda: None, ("robot 1", "robot 2"))
    yield SimpleNamespace(port=server.get_port(), session=run, panel=panel, server=server)
    server.stop()


@pytest.fixture
def said(capfd: pytest.CaptureFixture[str]) -> Callable[[], list[str]]:
    """Returns the lines on standard error, at the beginning of a second without any from earlier
    tests.
    """
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
        (
            "127.0.0.1",
            "127.0.0.1",
            "127.0.0.1 localhost LOCALHOST [::1]",
            "evil.org 127.0.0.2 localhost. 0.0.0.0",
        ),
        ("localhost", "::1", "127.0.0.1 localhost [::1]", "::1 evil.org"),
        ("192.168.1.5", "192.168.1.5", "192.168.1.5", "localhost 127.0.0.1 evil.org"),
        (
            "server.lan",
            "192.168.1.5",
            "server.lan 192.168.1.5 Server.LAN",
            "localhost evil.server.lan lan",
        ),
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
        others = (
            f"http://{name}:8081",
            f"https://{own}",
            f"http://{name}",
            "http://evil.org:8080",
            "null",
            "",
        )
        for origin in others:
            assert refusal([own], [origin], allowed) is not None, origin
        assert refusal([own], [f"http://{own}", "http://evil.org"], allowed) is not None
        assert refusal([f"{name}:8081"], [], allowed) is not None
    for name in refused.split():
        assert refusal([f"{name}:8080"], [f"http://{name}:8080"], allowed) is not None, name
    assert refusal([], [], allowed) is not None
    assert refusal([f"{host}:8080"] * 2, [], allowed) is not None


def test_port_80_is_implied() -> None:
    assert (
        refusal(["localhost"], ["http://localhost"], authorities("localhost", "127.0.0.1", 80))
        is None
    )
    assert (
        refusal(["localhost"], ["http://localhost"], authorities("localhost", "127.0.0.1", 8080))
        is not None
    )


def test_a_foreign_origin_or_host_is_answered_with_403_and_a_line(
    shown: SimpleNamespace, said: Any
) -> None:
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
    assert lines[0].startswith(
        "mqe: view: rejected a connection: Origin is http://evil.org, allowed: http://127.0.0.1:"
    )


def test_other_requests_than_get_print_nothing(said: Any) -> None:
    server = open_server("127.0.0.1", free_port(), "test")
    for method in "HEAD", "POST":
        connection = http.client.HTTPConnection("127.0.0.1", server.get_port())
        connection.request(method, "/")
        with pytest.raises(http.client.RemoteDisconnected):
            connection.getresponse()
    server.stop()
    assert said() == []


def test_rewinding_pauses_and_shows_an_earlier_step(shown: SimpleNamespace) -> None:
    run = shown.session
    panel = shown.panel
    run.drive.env = 0
    run.drive.robot = 0
    for step in range(4):
        run.drive.command = np.array([0.25 * step, 0.0, 0.0])
        run.advance()
    places = [moment.frame.qpos[0, run.env.robot_x[0]] for moment in run.moments]
    with Client(shown.port) as client:
        seen = client.panel()
        client.update(seen.uuid("Back"), 2 * run.env.dt)
        until(lambda: panel.back == 2)
        assert (
            run.paused
            and run.moment(panel.back).frame.qpos[0, run.env.robot_x[0]] == places[-3] != places[-1]
        )
        panel.show(np.zeros((2, 3)), 1.0)
        client.update(seen.uuid("Contacts"), True)
        until(lambda: panel.contacts)
        client.update(seen.uuid("Contacts"), False)
        client.update(seen.uuid("Pause"), True)
        until(lambda: not run.paused)
    with Client(shown.port) as client:
        text = client.panel().values["state"]
    assert (
        f"at {(run.steps - 2) * run.env.dt:.2f} s, paused" in text
        and ">1 (driven)<" in text
        and ">0.00<" in text
    )
    assert "episodes: success 0 of" in text and ">+0.25<" in text
    assert panel.back == 0 and run.moment(1000) is run.moments[0]
    run.drive.command = np.zeros(3)
    run.drive.robot = None


def test_keys_and_held_buttons_count_and_waiting_steps_are_limited(shown: SimpleNamespace) -> None:
    run = shown.session
    panel = shown.panel
    with Client(shown.port) as client:
        seen = client.panel()
        client.send({"type": "CommandTriggerMessage", "uuid": seen.commands["Forward"]})
        until(lambda: run.drive.now()[0] == 0.25)
        client.send({"type": "CommandTriggerMessage", "uuid": seen.commands["Stop"]})
        until(lambda: run.drive.now()[0] == 0.0)
        client.send(
            {"type": "GuiButtonHoldMessage", "uuid": seen.uuid("Forward"), "frequency": 0.0}
        )
        client.send(
            {"type": "GuiButtonHoldMessage", "uuid": seen.uuid("Turn left"), "frequency": HOLD_RATE}
        )
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
    refuses(
        r"view: viser .* cannot be restricted \(pip install 'viser==1.1.1' can\)",
        open_server,
        "127.0.0.1",
        free_port(),
        "test",
    )
    assert stopped == [True]


def listening(port: int) -> set[str]:
    rows = [
        line.split()
        for name in ("tcp", "tcp6")
        for line in Path("/proc/net", name).read_text().splitlines()[1:]
    ]
    places = [row[1].rsplit(":", 1) for row in rows if row[3] == "0A"]
    return {address for address, number in places if int(number, 16) == port}


@pytest.mark.skipif(
    not Path("/proc/net/tcp").exists(), reason="no /proc/net/tcp to read the sockets from"
)
def test_the_command_listens_on_this_machine_only_plays_and_ends_with_130() -> None:
    port = free_port()
    # A shell starts background jobs with SIGINT ignored, which children inherit.
    program = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
    program += "from mqe_jax.cli import main; sys.exit(main())"
    command = [
        sys.executable,
        "-c",
        program,
        "view",
        "go1gate",
        "--policy",
        "idle",
        "--port",
        str(port),
    ]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        try:
            assert process.stdout is not None
            assert f"http://127.0.0.1:{port}" in next(
                line for line in process.stdout if "open http" in line
            )
            # a full pipe would stop the viewer
            threading.Thread(target=process.stdout.read, daemon=True).start()
            assert listening(port) == {"0100007F"}

            def plays() -> bool:
                with Client(port) as client:
                    return " at " in client.panel().values.get("state", "")

            until(plays, 240.0)  # without compiled programs
            process.send_signal(signal.SIGINT)
            assert process.wait(30) == 130
        finally:
            process.kill()


EVIL = (
    '<iframe srcdoc="<script>top.ran = \'iframe\'</script>"></iframe><img src=x onerror="ran '
    "= 'img'\">![](a.png)"
)


def test_no_text_of_the_panel_runs_as_html(monkeypatch: pytest.MonkeyPatch) -> None:
    """Names of the task, robots, rewards and observations, choices, outcomes, and errors that hold
    paths.
    """

    def fail(choice: object) -> Any:
        raise InputError(f"runs/{EVIL}: damaged")

    env: Any = Driven()
    env.name = EVIL
    env.observation_layout = SimpleNamespace(
        blocks=[SimpleNamespace(name=EVIL)], slice=lambda name: slice(None)
    )
    run = session(env)
    monkeypatch.setattr("mqe_jax.view.viewer.start_frame", lambda *_: run.moment().frame)
    with open_page(640, 480) as page:
        viewer = Viewer(
            port=free_port(), menu=Menu(fail, Entry("go1gate", EVIL), {EVIL: "go1gate"})
        )
        viewer.announce(env, 2)
        page.goto(viewer.url)
        page.get_by_text("is being compiled").wait_for()
        run.advance()  # compiles the step with the true names
        run.terms = (EVIL, run.terms[-1])
        run.last = [EVIL, EVIL]
        viewer.show(run)
        viewer._panel._robots = (EVIL, EVIL)
        run.advance()
        viewer._panel.show(np.zeros((2, 3)), 1.0)
        page.get_by_text("x real time").wait_for()
        page.get_by_text("Observation of the driven robot").click()
        assert (
            page.evaluate("window.ran") is None
            and page.locator("body").inner_text().count(EVIL) >= 6
        )
        viewer._panel._wanted = Entry("go1gate", EVIL)
        assert not viewer._open_chosen()
        page.get_by_text("not loaded: runs/<iframe").wait_for()
        assert page.evaluate("window.ran") is None and page.locator("iframe").count() == 0
        viewer.server.stop()


@pytest.fixture(scope="module")
def stage() -> Iterator[Any]:
    """The scene of three environments of Narrow Gate, on a server without a page."""
    env = make("go1gate", impl="c", control="position", num_envs=3)
    data = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 3)).data
    frame = Episode(
        np.asarray(data.qpos), np.asarray(data.mocap_pos), np.asarray(data.mocap_quat), env.dt
    )
    server = viser.ViserServer(host="127.0.0.1", port=free_port(), verbose=False)
    yield SimpleNamespace(
        env=env, frame=frame, stage=Stage(server, env.mj_model, frame), server=server
    )
    server.stop()


def test_environments_stand_side_by_side_and_every_moving_body_is_drawn(stage: Any) -> None:
    scene = stage.stage
    frame = stage.frame
    model = stage.env.mj_model
    drawn = sorted(int(body) for _, bodies in scene._batches for body in bodies)
    with_shape = {int(model.geom_bodyid[g]) for g in range(model.ngeom) if model.geom_group[g] != 3}
    robots = [b for b in with_shape if model.body_mocapid[b] < 0 and b != 0]
    assert drawn == sorted(robots)
    trunk = model.body("robot0/trunk").id
    handle, bodies = next(batch for batch in scene._batches if trunk in batch[1])
    place = handle.batched_positions.reshape(3, len(bodies), 3)[:, bodies.index(trunk)]
    away = place - frame.qpos[:, stage.env.index.base_qpos[0, :3]]
    np.testing.assert_allclose(away[:, [0, 2]], 0.0, atol=1e-5)
    apart = np.diff(away[:, 1])
    assert np.all(apart > 3.1)  # wider than the track with its walls
    np.testing.assert_allclose(away[1, 1], 0.0, atol=1e-6)


def test_collision_shapes_stand_where_their_bodies_are(stage: Any) -> None:
    overlay = Overlay(stage.server, stage.env.mj_model, stage.stage)
    overlay.draw_shapes(stage.frame, True)
    trunk = stage.env.mj_model.body("robot0/trunk").id
    places = {body: handle.batched_positions for handle, (body,) in overlay._shapes}
    base = stage.frame.qpos[:, stage.env.index.base_qpos[0, :3]]
    np.testing.assert_allclose(places[trunk], base + stage.stage.offset, atol=1e-5)
    overlay.draw_shapes(stage.frame, False)
    assert overlay._shapes == []


def test_what_a_robot_senses_is_drawn_in_its_environment(stage: Any) -> None:
    """Hidden lines are not drawn, and the next drawing replaces the last one."""
    spots = jnp.arange(2 * 3 * 2 * 2.0).reshape(2, 3, 2, 2)
    opacity = jnp.array([[1.0, 1.0, 1.0], [0.0, 1.0, 0.5]])
    area = jnp.array([[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]] * 2)
    mark = marks(
        "lidar",
        (1.0, 0.0, 0.0),
        jnp.full(2, 0.3),
        lines=spots,
        line_opacity=opacity,
        points=spots[:, :, 0],
    )
    view = marks("in view", (0.0, 1.0, 0.0), jnp.full(2, 0.3), area=area)
    every = jax.tree.map(lambda x: np.stack([x] * 3), (mark, view))
    overlay = Overlay(stage.server, stage.env.mj_model, stage.stage)
    overlay.draw_marks(every, 2, 1)
    lines, points, shape = overlay._sensed
    offset = stage.stage.offset[2]
    np.testing.assert_allclose(lines.points, np.array(mark.lines[1, 1:]) + offset, atol=1e-5)
    np.testing.assert_allclose(points.points, np.array(mark.points[1]) + offset, atol=1e-5)
    assert np.all(lines.colors[0, 0] == (255, 0, 0)) and 0 < lines.colors[1, 0, 1] < 255
    assert sorted({*shape.faces.ravel().tolist()}) == [0, 1, 2, 3] and len(shape.faces) == 2
    overlay.draw_marks((), 2, 1)
    assert overlay._sensed == []


def test_contact_forces_carry_the_robots() -> None:
    """Of two Go1s that stand on their feet; robots are named by colour."""
    env = make("go1plane", impl="c", control="position", num_envs=1)
    model = env.mj_model
    joints = np.asarray(env.index.joint_qpos)
    data = mujoco.MjData(model)
    data.qpos[joints] = env.robots[0].default_joints
    for i, base in enumerate(env.index.base_qpos):
        data.qpos[base[:3]] = 2.0, i - 0.5, 0.29
    data.ctrl[:] = data.qpos[joints].ravel()
    mujoco.mj_step(model, data, 400)
    frame = Episode(data.qpos[None], data.mocap_pos[None], data.mocap_quat[None], env.dt)
    arrows = contact_arrows(model, mujoco.MjData(model), frame, data.qvel, data.ctrl)
    weight = 9.81 * sum(model.body_subtreemass[model.body(f"robot{i}/trunk").id] for i in range(2))
    force = (arrows[:, 1] - arrows[:, 0]).sum(0) / _METRES_PER_NEWTON
    np.testing.assert_allclose(force, [0.0, 0.0, weight], atol=0.05 * weight)
    assert len(arrows) >= 8 and np.all(np.abs(arrows[:, 0, 2]) < 0.01)
    names = [label.partition(" (")[0] for label in robot_labels(model)]
    assert names == ["robot 1", "robot 2"] and len(set(robot_labels(model))) == 2


def test_a_choice_replaces_the_session_and_a_wrong_one_keeps_it() -> None:
    def open_choice(choice: Entry) -> Any:
        if choice.policy == "bad":
            raise InputError("policy: bad")
        return session(Driven(), num_envs=3)

    viewer = Viewer(port=free_port(), menu=Menu(open_choice, Entry("go1gate"), {}))
    viewer.show(session(Driven()))
    first = viewer.session
    panel = viewer._panel
    gui = viewer.server.gui
    widgets = len(gui._gui_input_handle_from_uuid)
    commands = len(gui._command_handle_from_uuid)
    assert not viewer._open_chosen()
    panel._wanted = Entry("go1gate", "bad")
    assert not viewer._open_chosen() and viewer.session is first and first.paused
    panel._wanted = Entry("go1gate", "idle")
    assert viewer._open_chosen() and viewer.session is not first and viewer.session.num_envs == 3
    assert (len(gui._gui_input_handle_from_uuid), len(gui._command_handle_from_uuid)) == (
        widgets,
        commands,
    )
    assert viewer._panel is not panel and viewer._panel.take_choice() is None
    viewer._panel.shapes = viewer._panel.contacts = True
    viewer._draw()
    assert viewer._overlay._arrows is not None
    viewer._panel.shapes = viewer._panel.contacts = False
    viewer._draw()
    assert viewer._overlay._arrows is None
    viewer.server.stop()


@pytest.mark.parametrize("num_envs", [1, 3])
def test_own_lights_alone_and_cameras_at_the_action_of_one_environment(
    num_envs: int, monkeypatch: Any
) -> None:
    lights: dict[str, Any] = {}
    for name in ("configure_default_lights", "configure_environment_map", "add_light_directional"):
        monkeypatch.setattr(
            viser.SceneApi,
            name,
            lambda _, *first, name=name, **rest: lights.update({name: (first, rest)}),
        )
    viewer = Viewer(port=free_port())
    run = session(Driven(), num_envs=num_envs)
    viewer.show(run)
    camera = viewer.server.initial_camera
    robots = run.moment().frame.qpos[0, FakeEnv.robot_x[:, None] + np.arange(2)]
    assert [lights[f"configure_{name}"][0] for name in ("default_lights", "environment_map")] == [
        (False,),
        (None,),
    ]
    assert lights["add_light_directional"][1]["cast_shadow"] is False
    distance = float(np.linalg.norm(np.subtract(camera.position, camera.look_at)))
    followed = num_envs == 1
    (position, target) = viewer._stage.overview()
    middle = robots.mean(axis=0) if followed else np.zeros(2)
    np.testing.assert_allclose(np.asarray(viewer._stage._root.position)[:2], -middle, atol=1e-5)
    near = 3.0 + np.linalg.norm(np.subtract(*robots))
    whole = np.linalg.norm(np.subtract(position, target))
    assert distance == pytest.approx(near if followed else whole, abs=0.02) and whole > near + 0.2
    viewer.server.stop()
