"""Robots with clocks of their own: the loop that a user copies to a robot, and worlds at 1x."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from mqe_jax import names
from mqe_jax.core.settings import build
from mqe_jax.envs import make
from mqe_jax.export import robot, robot_log, runner
from mqe_jax.export.processes import LiveRobot
from mqe_jax.export.runner import Limits, run
from mqe_jax.train.config import TrainConfig
from tests.inputs import refuses
from tests.training import untrained


class Simulated:
    """A client that keeps its calls and their times."""

    def __init__(self) -> None:
        self.calls: list[tuple[float, Any]] = []
        self.fails = False

    def move(self, vx: float, vy: float, yaw_rate: float) -> None:
        if self.fails:
            raise ConnectionError("the robot is gone")
        self.calls.append((time.monotonic(), (vx, vy, yaw_rate)))

    def stop(self) -> None:
        self.calls.append((time.monotonic(), None))


def test_a_robot_is_driven_at_a_rate_within_limits_and_its_log_is_shown(
    tmp_path: Path, mqe: Any
) -> None:
    client = Simulated()
    log = tmp_path / "robot.csv"
    limits = Limits(speed=(1.0, 0.5, 0.25), acceleration=(2.0, 20.0, 20.0))
    run(client, lambda: 0, lambda _: (3.0, -0.4, 9.0), seconds=1.0, limits=limits, log=log)
    assert client.calls[0][1] is None and client.calls[-1][1] is None  # it stands before and after
    sent = np.array([velocity for _, velocity in client.calls[1:-1]])
    assert 10 <= len(sent) <= 51  # at most 50 Hz
    np.testing.assert_allclose(sent[-1], [1.0, -0.4, 0.25])
    columns = robot_log.load_log(log)
    np.testing.assert_allclose(columns["vx"], sent[:, 0], atol=1e-4)
    change = np.diff(columns["vx"], prepend=0.0)[1:] / np.diff(columns["time"])
    assert columns["vx"][0] < 0.5 and change.max() <= 2.2  # rounded times
    shown = mqe(f"replay {log} -o {tmp_path / 'robot.png'}").out
    assert "largest_vx                   1\n" in shown and "stops                        0" in shown
    assert (tmp_path / "robot.png").stat().st_size > 5000
    log.write_text("time,age\n1,2\n")
    assert "not the log of a robot" in mqe(f"replay {log}", code=2).err


@pytest.mark.parametrize("lost", ["readings", "answers"])
def test_a_robot_stands_when_nothing_new_comes_and_walks_again(lost: str, tmp_path: Path) -> None:
    """Without readings the loop goes on; while an answer takes too long, a thread stops it."""
    client = Simulated()
    start = time.monotonic()
    log = tmp_path / "robot.csv"

    def gap() -> bool:
        return 0.2 < time.monotonic() - start < 0.9

    def sense() -> Any:
        return None if lost == "readings" and gap() else 0

    def act(readings: Any) -> Any:
        while lost == "answers" and gap():
            time.sleep(0.01)
        return 0.1, 0.0, 0.0

    run(client, sense, act, seconds=1.5, log=log)
    times = np.array([when - start for when, _ in client.calls[1:-1]])
    moves = np.array([velocity is not None for _, velocity in client.calls[1:-1]])
    stopped = times[~moves]
    assert np.any((stopped > 0.35) & (stopped < 0.95))  # 0.2 s after the last readings
    assert moves[-1] and times[-1] > 0.9
    assert robot_log.summarize(robot_log.load_log(log))["stood_share"] > 0.0 or lost == "answers"


def test_a_robot_stands_after_an_error_and_after_sigterm() -> None:
    client = Simulated()
    with pytest.raises(ValueError, match=r"act: \[nan.* is not allowed; it must be vx, vy and yaw"):
        run(client, lambda: 0, lambda _: (float("nan"), 0.0, 0.0), seconds=60.0)
    assert client.calls[-1][1] is None
    client.fails = True
    with pytest.raises(ConnectionError, match="the robot is gone"):
        run(client, lambda: 0, lambda _: (0.1, 0.0, 0.0), seconds=60.0)
    assert client.calls[-1][1] is None
    client.fails = False
    threading.Timer(0.2, signal.raise_signal, [signal.SIGTERM]).start()
    with pytest.raises(SystemExit, match="143"):
        run(client, lambda: 0, lambda _: (0.1, 0.0, 0.0), seconds=60.0)
    assert client.calls[-1][1] is None and client.calls[-2][1] is not None


def test_a_robot_needs_python_only(tmp_path: Path) -> None:
    copied = tmp_path / "runner.py"
    copied.write_text(Path(runner.__file__).read_text())
    code = (
        "import sys; before = {*sys.modules}; import runner;"
        "print(*sorted({x.split('.')[0] for x in sys.modules} - sys.stdlib_module_names))"
    )
    done = subprocess.run(
        [sys.executable, "-S", "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert set(done.stdout.split()) <= {"__main__", "runner"}


# -- worlds in real time

RANGES: dict[str, Any] = {"command_ranges": {"vx": (-0.5, 1.2)}}
SHORT = {"episode_length": 1.0, "collision_force": 1e6, **RANGES}


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The graph of a robot with random weights."""
    graph = pytest.importorskip("mqe_jax.export.robot_graph")
    env = make("go1gate", impl="c", num_envs=1, **RANGES)
    settings = {"task": env.name, "network": {"recurrent": True, "gru_size": 8}, "env": RANGES}
    policy = untrained(env, build(TrainConfig, settings)).acting(True)
    written = tmp_path_factory.mktemp("robot") / "robot.onnx"
    written.write_bytes(graph.robot_onnx(policy, env).SerializeToString())
    return written


def test_a_robot_asks_for_the_velocity_of_its_action(file: Path) -> None:
    readings = np.random.default_rng(0).normal(size=(20, 16))
    alone = robot.Robot(str(file))
    last = first = np.zeros(3)
    own = robot.Robot(str(file))
    controller: Any = make("go1gate", impl="c", num_envs=1, **RANGES).controller
    for step, row in enumerate(readings):
        action = alone.act(row[None], [step == 0])
        np.testing.assert_array_equal(own.last_action, last)
        velocity = own.velocity(row, starts=step == 0)
        first = velocity if step == 0 else first
        last = action[0]
        np.testing.assert_allclose(velocity, controller.change(action)[0], atol=1e-5)
        back = controller.change(controller.action_of(velocity))
        np.testing.assert_allclose(back, velocity, atol=1e-5)
    np.testing.assert_allclose(own.speed, [1.2, 0.5, 0.5])
    own.reset()
    assert not own.last_action.any()
    np.testing.assert_array_equal(own.velocity(readings[0]), first)


@pytest.fixture(scope="module")
def world(file: Path) -> Any:
    real_time = pytest.importorskip("mqe_jax.export.real_time")
    with pytest.importorskip("mqe_jax.export.robot_team").open_team(file) as team:
        playing = names.table("go1gate", team, env=SHORT, impl="c")
        return real_time.World(playing.env, playing.seats)


def test_robots_act_in_real_time_beside_step_by_step(file: Path, tmp_path: Path, mqe: Any) -> None:
    words = f"eval go1gate --export {file} --real-time --episodes 2 --latency 0.1 --json"
    sets = ["--set=episode_length=1.0", "--set=collision_force=1e6"]
    sets.append("--set=command_ranges={vx: [-0.5, 1.2]}")
    sets += ["--limits", "0.05", "0.5", "0.5"]
    with pytest.warns(UserWarning, match="limits: 0.05 is below the 1.2 of vx in training"):
        found = json.loads(mqe(words, *sets, "--log", tmp_path / "logs").out)
    assert found["episodes"] == 2 and found["latency"] == 0.1
    assert sum(found["endings"].values()) == 1.0
    assert 0.0 <= found["rate"] <= 1.0 and 0.0 <= found["synchronous"] <= 1.0
    assert 0.1 < found["speed"] < 1.001 and found["delay"] >= 0.12 - 1e-6
    for number in range(2):
        log = robot_log.load_log(tmp_path / "logs" / f"robot{number}.csv")
        assert log["moving"].max() == 1.0 and 0.0 < np.abs(log["vx"]).max() <= 0.05


def test_a_world_names_a_robot_whose_process_is_killed_and_outlasts_a_late_one(world: Any) -> None:
    """The killed one stands at once, the late one when its last command is 0.2 s old."""
    from mqe_jax.export.real_time import open_robots

    keys = jax.random.split(jax.random.PRNGKey(0), 2)
    velocities = []
    at = 15
    step = world._step

    def stepped(state: Any, memory: Any, velocity: Any) -> Any:
        velocities.append(velocity.copy())
        if len(velocities) == at:
            os.kill(robots[1]._process.pid, number)
        return step(state, memory, velocity)

    world._step = stepped
    number = signal.SIGSTOP
    with open_robots(world, 1, 0.0, None) as robots:
        course = world.play(robots, keys[:1])
    assert course.steps == 50 and course.stood >= 10
    assert np.abs(velocities[14][1]).max() > 0.0 and not np.any(velocities[40:], axis=(0, 2))[1]
    velocities.clear()
    number = signal.SIGKILL
    at = 65
    said = r"^export: the process of robot 1 ended with -9 .*; it was told to stand 0\.\d\d s "
    said += "after its last command; [01] of 1 finished episodes succeeded$"
    with (
        pytest.raises(ConnectionError, match=said) as error,
        open_robots(world, 1, 0.0, None) as robots,
    ):
        world.play(robots, keys)
    world._step = step
    assert float(str(error.value).split("stand ")[1][:4]) <= 0.24 and len(velocities) <= at + 12
    assert not velocities[-1][1].any()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_robots_end_with_their_parent(file: Path, number: int) -> None:
    code = """
import sys, time
from pathlib import Path
from mqe_jax.export.processes import LiveRobot
robots = [LiveRobot(Path(sys.argv[1]), i, 0, seconds=600.0) for i in range(2)]
for robot in robots:
    robot.wait()
print(*(robot._process.pid for robot in robots), flush=True)
time.sleep(600)
"""
    command = [sys.executable, "-c", code, str(file)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        started = [int(word) for word in parent.stdout.readline().split()]
        parent.send_signal(number)
    assert len(started) == 2
    end = time.monotonic() + 30.0
    while any(map(lives, started)) and time.monotonic() < end:
        time.sleep(0.05)
    assert not any(map(lives, started))


def lives(process: int) -> bool:
    """Whether a process runs; one that has ended may wait for whoever collects it."""
    status = Path(f"/proc/{process}/stat")
    if status.parent.parent.joinpath("self").exists():
        return status.exists() and status.read_text().rpartition(")")[2].split()[0] != "Z"
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_robot_has_a_time_limit(file: Path) -> None:
    limited = LiveRobot(file, 0, 0, seconds=0.01)
    with pytest.raises(ConnectionError, match="robot 0 ended with 1"):
        limited.wait()
    limited.close()


def test_what_cannot_run_in_real_time_is_rejected_in_a_line(
    file: Path, mqe: Any, monkeypatch: Any
) -> None:
    real_time = pytest.importorskip("mqe_jax.export.real_time")
    words = f"eval go1gate --export {file} --real-time"
    wrong = {
        "eval go1gate --real-time": "real_time: True is not allowed; it must be beside --export",
        "eval go1gate --latency 0.1": "latency: '0.1' is not allowed; it must be left out without",
        f"{words} --impl jax": "impl: 'jax' is not allowed; it must be left out with --real-time",
        f"{words} --sides both": "sides: 'both' is not allowed",
        f"{words} --episodes 2000": "episodes",
    }
    for line, said in wrong.items():
        err = mqe(line, code=2).err
        assert said in err and err.count("\n") == 1
    monkeypatch.setattr(real_time.World, "_measure", lambda self: 0.5)
    said = "real_time: this machine simulates go1gate at 0.50 x real time; it must reach 1"
    assert said in mqe(words, code=2).err
    env = make("go1gate", impl="c", num_envs=1, control="position")
    refuses("real_time: 'position' is not allowed", real_time.World, env, ())
