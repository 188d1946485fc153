"""Processes of robots, as the simulation starts them: one that answers each step, one in real time.

They exchange frames of numbers through pipes. A process ends with its parent, as its input ends.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import IO

import numpy as np

from mqe_jax.export import live_robot, robot
from mqe_jax.export.robot import read_frame, write_frame

START = 60.0
"""Time in which a process in real time starts, s."""
_CLOSING = 10.0  # s, after which a process that does not end is killed
_LIVE = (
    f"import sys; sys.path.insert(0, {str(Path(__file__).parents[2])!r}); "
    f"from {live_robot.__name__} import main; main(*sys.argv[1:])"
)


class RobotProcess:
    """The process of one robot."""

    def __init__(self, number: int, *arguments: str) -> None:
        """Starts Python with arguments."""
        self.name = f"export: the process of robot {number}"
        self._errors: IO[bytes] = tempfile.TemporaryFile()
        # Ctrl-C must reach the parent only; this process sees its end.
        self._process = subprocess.Popen(
            [sys.executable, "-P", *arguments],  # -P: no module of the current folder
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            start_new_session=True,
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._stdin: IO[bytes] = self._process.stdin
        self._stdout: IO[bytes] = self._process.stdout

    @property
    def end(self) -> str:
        """What it ended with; the process must have ended."""
        code = self._process.wait(_CLOSING)
        self._errors.seek(0)
        last = self._errors.read().decode("utf-8", "replace").strip().rpartition("\n")[2]
        return f"{self.name} ended with {code} ({last or 'without a message'})"

    def close(self, seconds: float = _CLOSING) -> None:
        """Ends the process: it ends with its input, or is killed after some seconds."""
        for stream in (self._stdin, self._stdout):
            with contextlib.suppress(BrokenPipeError):
                stream.close()
        try:
            self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._errors.close()


class AskedRobot(RobotProcess):
    """A robot that answers each frame of readings; see `mqe_jax.export.robot`."""

    def __init__(self, file: Path, number: int, seed: int) -> None:
        super().__init__(number, robot.__file__, str(file), str(seed))

    def send(self, frame: np.ndarray) -> None:
        """Sends a frame (N, 1 + O)."""
        with contextlib.suppress(BrokenPipeError):  # `receive` says why
            write_frame(self._stdin, frame)

    def receive(self, shape: tuple[int, int]) -> np.ndarray:
        """Returns the actions (N, D); ConnectionError for anything else."""
        frame = read_frame(self._stdout)
        if frame is None:
            raise ConnectionError(self.end)
        if frame.shape != shape:
            raise ConnectionError(f"{self.name} answered {frame.shape} numbers, not {shape}")
        if not np.isfinite(frame).all():
            raise ConnectionError(f"{self.name} answered numbers that are not finite")
        return frame


class LiveRobot(RobotProcess):
    """A robot with its own clock; see `mqe_jax.export.live_robot`.

    Nothing waits for it: `send` leaves readings, `receive` takes what has arrived.
    """

    def __init__(
        self,
        file: Path,
        number: int,
        seed: int,
        *,
        seconds: float,
        latency: int = 0,
        log: Path | None = None,
        speed: Sequence[float] = (),
    ) -> None:
        """Starts the process, which ends after some seconds.

        Its commands count `latency` steps of the world after they have arrived. `speed` are its
        largest vx, vy and yaw rate, by default those of the graph.
        """
        words = [str(file), str(seed), str(seconds), "" if log is None else str(log)]
        words += map(str, speed)
        super().__init__(number, "-c", _LIVE, *words)
        self.ended = False
        self._latency = latency
        self._unsent = b""
        self._received = b""
        self._arrived: deque[tuple[int, np.ndarray]] = deque()  # step, command
        for stream in (self._stdin, self._stdout):
            os.set_blocking(stream.fileno(), False)

    def wait(self) -> None:
        """Waits for its first command; ConnectionError if it does not come."""
        end = time.monotonic() + START
        while not self._received and not self.ended and time.monotonic() < end:
            time.sleep(0.01)
            self._read()
        if self.ended:
            raise ConnectionError(self.end)
        if not self._received:
            raise ConnectionError(f"{self.name} did not start within {START:g} s")

    def send(self, number: int, episode: int, readings: np.ndarray) -> None:
        """Sends readings (O,) of a step, unless those of a step before still wait to be sent."""
        frame = np.concatenate([[number, episode], readings]).astype("<f4")
        content = self._unsent or frame.tobytes()
        with contextlib.suppress(BlockingIOError, BrokenPipeError):
            self._unsent = content[os.write(self._stdin.fileno(), content) :]

    def receive(self, step: int) -> np.ndarray | None:
        """Returns the newest command that counts from a step on, None without a new one.

        A command (4,) is the number of the readings for which it is, and a velocity. `ended` is set
        if the process has ended. ConnectionError for numbers that are not finite.
        """
        self._read()
        size = 4 * live_robot.COMMAND
        whole = len(self._received) // size * size
        frames = np.frombuffer(self._received[:whole], "<f4").reshape(-1, live_robot.COMMAND)
        self._received = self._received[whole:]
        if not np.isfinite(frames).all():
            raise ConnectionError(f"{self.name} answered numbers that are not finite")
        self._arrived.extend((step, frame) for frame in frames)
        found = None
        while self._arrived and self._arrived[0][0] + self._latency <= step:
            _, found = self._arrived.popleft()
        return found

    def _read(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while content := os.read(self._stdout.fileno(), 2**16):
                self._received += content
            self.ended = True
