"""The program of one robot: an exported graph turns its readings into its actions.

Needs numpy and onnxruntime only.

`python -m mqe_jax.export.robot FILE [SEED]` acts for the robot in N episodes at once until its
standard input ends. The file is what `mqe export` writes with `--per-robot`. In each environment
step the program reads a frame (N, 1 + O): whether the row's episode starts, 1 or 0, then the
robot's readings. It answers with the frame of its actions (N, D). A frame is the number of rows and
of columns as little-endian uint32, then the numbers as float32. The seed is that of the normal
numbers with which a graph samples. The program ends if an answer takes longer than `ANSWER`.
"""

import contextlib
import json
import math
import os
import struct
import sys
import threading
from collections.abc import Iterator, Mapping
from typing import IO, Any

import numpy as np
from numpy.typing import ArrayLike

ANSWER = 10.0
"""Time in which a robot answers, s."""
_HEAD = struct.Struct("<II")


class Robot:
    """One robot in N episodes; it keeps the recurrent state of its graph."""

    def __init__(self, graph: str | bytes, seed: int = 0) -> None:
        """Loads a graph, a file or its content."""
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3
        options.intra_op_num_threads = 1  # a team has one program per robot
        self._session: Any = onnxruntime.InferenceSession(graph, options, ["CPUExecutionProvider"])
        self._shapes = {x.name: tuple(x.shape[1:]) for x in self._session.get_inputs()}
        outputs = {x.name: tuple(x.shape[1:]) for x in self._session.get_outputs()}
        if "action" not in outputs or "obs" not in self._shapes:
            raise ValueError("graph: is none of a robot's policy, with obs and action")
        self._outputs = [*outputs]
        self._random = np.random.default_rng(seed)
        self._width = math.prod(outputs["action"])
        self.reset()
        # metadata of the graph
        self.properties: Mapping[str, str] = self._session.get_modelmeta().custom_metadata_map
        about = json.loads(self.properties.get("velocity", "{}"))
        self._velocity = {name: np.asarray(x, float) for name, x in about.items()}

    def reset(self) -> None:
        """Begins an episode: without recurrent state, and with `last_action` 0."""
        self._memory: dict[str, np.ndarray] = {}
        self.last_action = np.zeros(self._width, np.float32)
        """Action of the last `velocity` (D,), 0 before: what the block `action` of readings has."""

    @property
    def size(self) -> int:
        """Number of readings O."""
        return math.prod(self._shapes["obs"])

    @property
    def speed(self) -> np.ndarray:
        """Largest vx, vy and yaw rate of its velocities (3,), m/s and rad/s.

        ValueError unless its actions are these three.
        """
        return np.abs(self._commands["limits"]).max(axis=1)

    def velocity(self, readings: ArrayLike, starts: bool = False) -> np.ndarray:
        """Returns vx, vy and yaw rate (3,) in the trunk's frame, m/s and rad/s, of one episode.

        `readings` (O,); `starts` says whether the episode starts. ValueError as `act` and `speed`.
        """
        (action,) = self.act(np.asarray(readings)[None], [float(starts)])
        self.last_action = action
        about = self._commands
        change = np.where(action < 0, *about["slopes"]) * action
        return np.clip(about["default"] + change, *about["limits"].T)

    @property
    def _commands(self) -> Mapping[str, np.ndarray]:
        if not self._velocity:
            raise ValueError("velocity: the graph has none; export actions vx, vy, yaw_rate again")
        return self._velocity

    def act(self, readings: ArrayLike, starts: ArrayLike) -> np.ndarray:
        """Returns the actions (N, D) for readings (N, O).

        `starts` (N,) is 1 where an episode starts, else 0. ValueError for anything else than finite
        numbers of these shapes.
        """
        readings = _finite("readings", readings, self.size)
        starts = _finite("starts", starts)
        count = len(readings)
        if len(starts) != count:
            raise ValueError(f"starts: {len(starts)} are not allowed; they must be {count}")
        inputs = {"obs": readings.reshape(count, *self._shapes["obs"])}
        if "noise" in self._shapes:
            inputs["noise"] = self._random.standard_normal(
                (count, *self._shapes["noise"]), np.float32
            )
        for name in self._shapes.keys() - inputs:
            zero = np.zeros((count, *self._shapes[name]), np.float32)
            kept = self._memory.get(name, zero)
            first = starts.reshape(count, *(1,) * (zero.ndim - 1)) > 0.5
            inputs[name] = zero if first.all() else np.where(first, zero, kept)
        found = dict(zip(self._outputs, self._session.run(self._outputs, inputs), strict=True))
        action = found.pop("action").reshape(count, -1)
        self._memory = {name.removeprefix("next_"): x for name, x in found.items()}
        return action


def _finite(name: str, numbers: Any, *widths: int) -> np.ndarray:
    """Returns numbers (N, *widths) as float32; ValueError for others, or if one is not finite."""
    found = None
    with contextlib.suppress(TypeError, ValueError), np.errstate(over="ignore"):
        found = np.asarray(numbers).astype(np.float32, casting="same_kind")
    if found is None or not found.shape or found.shape[1:] != widths:
        given = "no numbers" if found is None else found.shape
        expected = ", ".join(["N", *map(str, widths)])
        raise ValueError(f"{name}: {given} are not allowed; they must be numbers ({expected})")
    if not np.isfinite(found).all():
        raise ValueError(f"{name}: contain NaN or infinity; they must be finite")
    return found


def write_frame(stream: IO[bytes], numbers: np.ndarray) -> None:
    """Writes a frame (rows, columns)."""
    stream.write(_HEAD.pack(*numbers.shape) + np.ascontiguousarray(numbers, "<f4").tobytes())
    stream.flush()


def read_frame(stream: IO[bytes]) -> np.ndarray | None:
    """Returns the next frame (rows, columns), or None if the stream has ended."""
    head = stream.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return None
    rows, columns = _HEAD.unpack(head)
    content = stream.read(4 * rows * columns)
    if len(content) < 4 * rows * columns:
        return None
    return np.frombuffer(content, "<f4").reshape(rows, columns)


def main(file: str, seed: str = "0") -> None:
    """Runs the program."""
    robot = Robot(file, int(seed))
    while (frame := read_frame(sys.stdin.buffer)) is not None:
        with _in_time():
            action = robot.act(frame[:, 1:], frame[:, 0])
        write_frame(sys.stdout.buffer, action)


@contextlib.contextmanager
def _in_time() -> Iterator[None]:
    """Ends the process if this takes longer than `ANSWER`, even while the graph computes."""
    timer = threading.Timer(ANSWER, _give_up)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _give_up() -> None:
    os.write(2, f"no answer within {ANSWER:g} s\n".encode())
    os._exit(1)


if __name__ == "__main__":
    main(*sys.argv[1:])
