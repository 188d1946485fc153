"""The viewer: its simulation, its scene, its panel, and the page in a real browser."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from browser import open_page
from fake_env import FakeEnv, FakeVectorEnv

from mqe_jax import cli, make
from mqe_jax.cli.players import planner
from mqe_jax.view.session import HOLD_TIME, Drive, Session

STARTUP = 240.0  # s, on a loaded machine without compiled programs


class Driven(FakeEnv):
    """The fake task under walk commands, its second agent in a mirrored frame."""

    control = "command"
    params = SimpleNamespace(commands=("vx", "vy", "yaw_rate"))
    controller = SimpleNamespace(default_commands=np.zeros(15, np.float32))

    def unmirror_action(self, action: jax.Array) -> jax.Array:
        return action * jnp.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0]])


def session(env: Any, num_envs: int = 2, name: str = "idle", **options: Any) -> Session:
    return Session(env, FakeVectorEnv(env, num_envs), planner(name, env), (), **options)


def test_a_driven_robot_obeys_the_hand_and_the_others_their_policy() -> None:
    run = session(Driven(), name="forward")
    run.drive.env, run.drive.robot = 1, 1
    run.drive.change((-1.0, 0.5, 1.0))
    run.advance()
    moved = run.frame().qpos[:, run.env.robot_x] - np.array([1.0, 1.0])
    np.testing.assert_allclose(moved, [[0.025, 0.025], [0.025, -0.05]], atol=1e-6)
    np.testing.assert_allclose(run.commands[-1][0], [[0.5, 0, 0], [0.5, 0, 0]])
    # Teleoperation commands are in the robot's frame, although its agent acts in a mirrored one.
    np.testing.assert_allclose(run.commands[-1][1], [[0.5, 0, 0], [-1.0, 0.25, 0.5]], atol=1e-6)


def test_a_held_button_counts_until_its_messages_stop() -> None:
    now = [0.0]
    drive = Drive(clock=lambda: now[0])
    drive.hold((1.0, 0.0, 0.0))
    drive.hold((0.0, 0.0, 1.0))
    np.testing.assert_allclose(drive.now(), [1.0, 0.0, 0.5])
    now[0] = 0.5 * HOLD_TIME
    drive.hold((1.0, 0.0, 0.0))
    now[0] = 1.1 * HOLD_TIME
    np.testing.assert_allclose(drive.now(), [1.0, 0.0, 0.0])
    now[0] = 2.0 * HOLD_TIME
    np.testing.assert_allclose(drive.now(), 0.0)


def test_keys_step_the_command_within_its_limits_and_stop_it() -> None:
    drive = Drive()
    for _ in range(6):
        drive.change((0.25, 0.0, -0.25))
    np.testing.assert_allclose(drive.now(), [1.0, 0.0, -0.5])
    drive.change((-0.25, 0.0, 0.0))
    np.testing.assert_allclose(drive.now(), [0.75, 0.0, -0.5])
    drive.change((0.0, 0.0, 0.0))
    np.testing.assert_allclose(drive.now(), 0.0)


def test_episodes_start_over_and_the_record_keeps_the_last_seconds() -> None:
    run = session(FakeEnv(), name="forward", history=0.3)
    for _ in range(21):
        run.advance()
    assert run.episodes.tolist() == [2, 2]
    assert run.terms == ("reward/progress", "average_step_reward")
    assert len(run.rewards) == len(run.times) == 15 and run.rewards[-1].shape == (2, 2)
    np.testing.assert_allclose(run.rewards[-1], 0.05, rtol=1e-5)
    assert run.times[-1] == pytest.approx(21 * 0.02)
    assert not run.drivable
    run.reset()
    np.testing.assert_allclose(run.frame().qpos[:, run.env.robot_x], 1.0)


@pytest.fixture(scope="module")
def stage() -> Iterator[Any]:
    """The scene of three environments of Narrow Gate, on a server without a page."""
    pytest.importorskip("mjviser")
    import viser

    from mqe_jax.view.session import Frame
    from mqe_jax.view.stage import Stage

    env = make("go1gate", impl="c", control="position", num_envs=3)
    data = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 3)).data
    frame = Frame(np.asarray(data.qpos), np.asarray(data.mocap_pos), np.asarray(data.mocap_quat))
    server = viser.ViserServer(host="127.0.0.1", port=free_port(), verbose=False)
    yield SimpleNamespace(env=env, frame=frame, stage=Stage(server, env, frame), server=server)
    server.stop()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_environments_stand_side_by_side_and_every_moving_body_is_drawn(stage: Any) -> None:
    scene, frame, model = stage.stage, stage.frame, stage.env.mj_model
    drawn = sorted(int(body) for batch in scene._batches for body in batch.bodies)
    with_shape = {int(model.geom_bodyid[g]) for g in range(model.ngeom) if model.geom_group[g] != 3}
    robots = [b for b in with_shape if model.body_mocapid[b] < 0 and b != 0]
    assert drawn == sorted(robots)
    trunk = model.body("robot0/trunk").id
    batch = next(batch for batch in scene._batches if trunk in batch.bodies)
    place = batch.handle.batched_positions.reshape(3, len(batch.bodies), 3)[:, list(batch.bodies).index(trunk)]
    away = place - frame.qpos[:, stage.env.index.base_qpos[0, :3]]
    np.testing.assert_allclose(away[:, [0, 2]], 0.0, atol=1e-5)
    apart = np.diff(away[:, 1])
    assert np.all(apart > 3.1)  # wider than the track with its walls
    np.testing.assert_allclose(away[1, 1], 0.0, atol=1e-6)


def test_walls_end_at_their_own_track_and_a_followed_body_stays_at_the_origin(stage: Any) -> None:
    scene = stage.stage
    walls = scene._wall_handles
    centre = np.stack([wall.batched_positions for wall in walls]) - scene._offset
    half = np.stack([wall.batched_scales for wall in walls])
    assert np.all(np.abs(centre[..., 1]) + half[..., 1] < 1.55)
    widths = 3.0 - 2 * half[..., 1].sum(0)
    np.testing.assert_allclose(widths, 0.6, atol=0.1)
    trunk = scene.bodies["robot 2"]
    scene.draw(stage.frame, (2, trunk))
    want = stage.frame.qpos[2, stage.env.index.base_qpos[1, :2]] + scene._offset[2, :2]
    np.testing.assert_allclose(np.asarray(scene._root.position)[:2], -want, atol=1e-5)
    scene.release()
    np.testing.assert_allclose(scene._root.position, 0.0)


def test_cameras_follow_robots_and_the_ball() -> None:
    pytest.importorskip("mjviser")
    from mqe_jax.view.stage import followable

    env = make("go1football-1vs1", impl="c", control="position", num_envs=1)
    assert list(followable(env.mj_model)) == ["robot 1", "robot 2", "ball"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--num-envs", "0"], ("num_envs", "0", "between 1 and 16")),
        (["--port", "99999"], ("port", "99999", "65535")),
        (["--host", "192.0.2.1"], ("host", "192.0.2.1", "an address of this machine")),
        (["--host", "no such host"], ("host", "no such host", "an address of this machine")),
        (["--planner", "scriptd"], ("planner", "scriptd", "scripted")),
    ],
)
def test_bad_arguments_are_refused_in_a_line(arguments: list[str], words: tuple[str, ...], capsys: Any) -> None:
    assert cli.main(["view", "go1gate", *arguments]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and all(word in said for word in words)


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
    command = ["view", "go1gate", "--planner", "idle", "--port", str(port), "--set", "episode_length=600"]
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
        yield SimpleNamespace(port=port, process=process, said=said)
        process.send_signal(signal.SIGINT)
        try:
            assert process.wait(30) == 130
        finally:
            process.kill()


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="no /proc/net/tcp to read the sockets from")
def test_nothing_listens_beyond_this_machine(viewer: SimpleNamespace) -> None:
    assert f"http://127.0.0.1:{viewer.port}" in viewer.said
    assert listening(viewer.port) == {"0100007F"}


class Page:
    """The viewer's page, as rendered."""

    def __init__(self, page: Any) -> None:
        self.page = page

    def robots(self) -> np.ndarray:
        """x, y, z, vx, vy, turn of each robot, from the table (A, 6)."""
        rows = self.page.locator("table").first.locator("tbody tr").all_inner_texts()
        return np.array([[float(cell) for cell in row.split("\t")[1:]] for row in rows])

    def text(self) -> str:
        return self.page.locator("body").inner_text()

    def until(self, condition: Callable[[], bool], seconds: float = 60.0) -> None:
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, f"not within {seconds} s; the page says: {self.text()[:400]}"
            time.sleep(0.1)

    def choose(self, label: str, option: str) -> None:
        self.page.get_by_label(label, exact=True).first.click()
        self.page.get_by_role("option", name=option, exact=True).click()


@pytest.fixture(scope="module")
def page(viewer: SimpleNamespace) -> Iterator[Page]:
    with open_page(640, 480) as tab:
        tab.goto(f"http://127.0.0.1:{viewer.port}")
        tab.wait_for_selector("table", timeout=1000 * STARTUP)
        yield Page(tab)


def test_a_robot_is_driven_from_the_page(page: Page) -> None:
    """Hold the drive button, then press keys: only the selected robot moves on the page."""
    page.choose("Driven", "robot 2")
    page.until(lambda: "2 (driven)" in page.text())
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
    page.until(lambda: page.page.get_by_label("Camera", exact=True).first.input_value() == "robot 2")
    assert page.page.locator("canvas").count() >= 2  # the scene, and the plots
    if folder := os.environ.get("MQE_SCREENSHOTS"):
        page.page.screenshot(path=str(Path(folder) / "view.png"))
