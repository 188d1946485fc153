"""The program of one robot in real time: `mqe_jax.export.runner` between two pipes.

`python -m mqe_jax.export.live_robot FILE SEED SECONDS [LOG [VX VY YAW_RATE]]` drives a simulated
robot by the file that `mqe export` writes with `--per-robot`, at most at these speeds. Its standard
input are frames of 2 + O float32 (little-endian), of which it reads the newest: the number of the
readings, that of the episode, the readings. Its standard output are commands of 4: the number of
the readings for which they are, vx, vy, yaw rate, m/s and rad/s. The first command says that the
program is ready.

The program ends after SECONDS, and with its parent: its input ends then, and Linux kills it.
"""

import ctypes
import os
import signal
import sys
import threading

import numpy as np

from mqe_jax.export.robot import Robot
from mqe_jax.export.runner import Limits, run

COMMAND = 4
"""Numbers of a command."""
JITTER = 0.004
"""Longest random delay of a period, s."""
_KILL_WITH_PARENT = 1  # PR_SET_PDEATHSIG


class World:
    """The client whose robot is simulated by the parent process."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._newest = np.zeros(0)
        self._number = -1.0  # of the readings that were sensed last
        self._episode = -1.0
        threading.Thread(target=self._read, daemon=True).start()

    def move(self, vx: float, vy: float, yaw_rate: float) -> None:
        """Sends a command."""
        os.write(1, np.array([self._number, vx, vy, yaw_rate], "<f4").tobytes())

    def stop(self) -> None:
        """Sends the command to stand."""
        self.move(0.0, 0.0, 0.0)

    def sense(self) -> np.ndarray | None:
        """Returns the newest frame, None if there is no new one."""
        newest = self._newest
        if not len(newest) or newest[0] == self._number:
            return None
        self._number = float(newest[0])
        return newest

    def act(self, frame: np.ndarray) -> np.ndarray:
        """Returns the velocity for a frame."""
        starts = frame[1] != self._episode
        self._episode = float(frame[1])
        return self._robot.velocity(frame[2:], starts)

    def _read(self) -> None:
        size = 4 * (2 + self._robot.size)
        while len(content := sys.stdin.buffer.read(size)) == size:
            self._newest = np.frombuffer(content, "<f4")
        os._exit(0)  # the parent has ended


def main(file: str, seed: str, seconds: str, log: str = "", *speed: str) -> None:
    """Runs the program."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_KILL_WITH_PARENT, signal.SIGKILL)
    timer = threading.Timer(float(seconds), os._exit, [1])  # also while the graph computes
    timer.daemon = True
    timer.start()
    robot = Robot(file, int(seed))
    vx, vy, yaw_rate = map(float, speed or robot.speed)
    limits = Limits(speed=(vx, vy, yaw_rate))
    world = World(robot)
    run(
        world,
        world.sense,
        world.act,
        seconds=float(seconds),
        limits=limits,
        log=log or None,
        jitter=JITTER,
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
