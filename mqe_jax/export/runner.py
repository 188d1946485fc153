"""The loop that drives one robot by velocities: readings, policy, limits, watchdog, log.

Needs Python only: copy this file to the robot. It drives robots in simulation; no real robot has
run it.

`run` asks `sense` for readings and `act` for a velocity at a fixed rate. The velocity goes to a
`Client`, such as one that calls Unitree's high-level interface, within `Limits`. Readings that stop
to arrive, or an `act` that takes too long, keep the last velocity for `HOLD`; then a thread calls
`stop`. `run` also calls it at its end, whatever the reason: an error, Ctrl-C or SIGTERM.
"""

import contextlib
import math
import random
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import TracebackType
from typing import IO, Any, NamedTuple, Protocol, TypeVar

HOLD = 0.2
"""Time without a new velocity after which the robot stands, s."""
COLUMNS = (
    "time",
    "age",
    "asked_vx",
    "asked_vy",
    "asked_yaw_rate",
    "vx",
    "vy",
    "yaw_rate",
    "moving",
)
"""Columns of a log (CSV, a row for each period): time and age of the readings, s; the velocity of
`act` and the one sent, m/s and rad/s; 1 while the robot moves, 0 while it stands."""

Readings = TypeVar("Readings")
Velocity = tuple[float, float, float]
STILL = (0.0, 0.0, 0.0)


class Client(Protocol):
    """A robot that walks at a velocity. Its functions return at once."""

    def move(self, vx: float, vy: float, yaw_rate: float) -> None:
        """Walks at a velocity in the trunk's frame, m/s and rad/s."""
        ...

    def stop(self) -> None:
        """Stands."""
        ...


class Limits(NamedTuple):
    """Largest magnitudes of what is sent: forward, sideways, turning."""

    speed: Velocity = (1.0, 0.5, 0.5)  # m/s, m/s, rad/s
    acceleration: Velocity = (50.0, 50.0, 100.0)  # m/s^2, m/s^2, rad/s^2


def run(
    client: Client,
    sense: Callable[[], Readings | None],
    act: Callable[[Readings], Iterable[float]],
    *,
    seconds: float,
    rate: float = 50.0,
    limits: Limits = Limits(),  # noqa: B008
    hold: float = HOLD,
    log: str | Path | None = None,
    jitter: float = 0.0,
) -> None:
    """Drives a robot for some time.

    Example:
        ```python
        from mqe_jax.export.runner import run

        class Printed:
            def move(self, vx, vy, yaw_rate):
                print(vx, vy, yaw_rate)

            def stop(self):
                print("stop")

        run(Printed(), lambda: "readings", lambda readings: (0.5, 0.0, 0.0), seconds=0.1)
        ```

    Args:
        client: the robot.
        sense: returns the newest readings, or None if none have arrived since the last call.
        act: returns the velocity (vx, vy, yaw_rate) for readings, m/s and rad/s.
        seconds: time after which it ends, s.
        rate: of the loop, Hz.
        limits: largest speeds and accelerations.
        hold: time without a new velocity after which the robot stands, s.
        log: file to write, with the columns `COLUMNS`.
        jitter: longest random delay of a period, s, as a busy computer causes.

    Raises:
        ValueError: for a velocity that is not three finite numbers. The robot stands then.
    """
    end = time.monotonic() + seconds
    with _ending_on_sigterm(), _Drive(client, limits, hold, log) as drive:
        tick = time.monotonic()
        while tick < end:
            readings = sense()
            if readings is not None:
                arrived = time.monotonic()
                drive.ask(_velocity(act(readings)), arrived)
            drive.send()
            tick = max(tick + 1.0 / rate, time.monotonic())
            time.sleep(max(0.0, tick + random.uniform(0.0, jitter) - time.monotonic()))


class _Drive:
    """The client under limits, and a thread that stops it without a new velocity."""

    def __init__(self, client: Client, limits: Limits, hold: float, log: str | Path | None) -> None:
        self._client = client
        self._limits = limits
        self._hold = hold
        self._log: IO[str] | None = None if log is None else Path(log).open("w", encoding="utf-8")
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._watchdog = threading.Thread(target=self._watch, daemon=True)
        self._start = time.monotonic()
        self._sent_at = self._start
        self._arrived = self._start  # when the readings of the asked velocity arrived
        self._asked: Velocity = STILL
        self._sent: Velocity = STILL
        self._moving = False

    def __enter__(self) -> "_Drive":
        self._write(",".join(COLUMNS))
        self._client.stop()
        self._watchdog.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: Any, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        with self._lock:
            self._client.stop()
            if self._log is not None:
                self._log.close()

    def ask(self, velocity: Velocity, arrived: float) -> None:
        """Sets the velocity for readings that arrived at a time, unless they are old by now."""
        with self._lock:
            if time.monotonic() - arrived <= self._hold:
                self._asked = velocity
                self._arrived = arrived
                self._moving = True

    def send(self) -> None:
        """Sends the asked velocity, within the limits, if the robot moves; logs a row."""
        with self._lock:
            now = time.monotonic()
            self._stop_if_old(now)
            if self._moving:
                self._sent = self._limited(now - self._sent_at)
                self._client.move(*self._sent)
            self._sent_at = now
            row = (now - self._start, now - self._arrived, *self._asked, *self._sent)
            self._write(",".join(f"{x:.4f}" for x in row) + f",{self._moving:d}")

    def _limited(self, passed: float) -> Velocity:
        """Returns the velocity that may be sent, some time after the last one."""
        found = []
        for asked, sent, most, change in zip(
            self._asked, self._sent, self._limits.speed, self._limits.acceleration, strict=True
        ):
            step = change * min(passed, self._hold)
            bounded = min(max(asked, -most), most)
            found.append(min(max(bounded, sent - step), sent + step))
        return found[0], found[1], found[2]

    def _watch(self) -> None:
        while not self._ended.wait(self._hold / 20):
            with self._lock, contextlib.suppress(Exception):  # `send` meets the same error
                if not self._ended.is_set():
                    self._stop_if_old(time.monotonic())

    def _stop_if_old(self, now: float) -> None:
        if self._moving and now - self._arrived > self._hold:
            self._sent = STILL
            self._client.stop()
            self._moving = False

    def _write(self, line: str) -> None:
        if self._log is not None:
            self._log.write(f"{line}\n")
            self._log.flush()  # also for the time before a power cut


def _velocity(found: Iterable[float]) -> Velocity:
    numbers = [float(x) for x in found]
    if len(numbers) != 3 or not all(map(math.isfinite, numbers)):
        raise ValueError(f"act: {numbers} is not allowed; it must be vx, vy and yaw_rate")
    return numbers[0], numbers[1], numbers[2]


@contextlib.contextmanager
def _ending_on_sigterm() -> Iterator[None]:
    """Lets SIGTERM raise SystemExit, after which the robot stands."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def leave(number: int, frame: object) -> None:
        sys.exit(128 + number)

    before = signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
