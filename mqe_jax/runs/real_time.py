"""How exported robots do in real time: each a process with its own clock, beside step by step."""

import contextlib
import dataclasses
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.progress import Progress

from mqe_jax import names
from mqe_jax.acting.results import Rate
from mqe_jax.core.errors import warn
from mqe_jax.core.limits import Candidates, Latency, Positive, Seed
from mqe_jax.core.literal import line
from mqe_jax.core.settings import Parameters, checked, fail
from mqe_jax.envs import QuadrupedEnv
from mqe_jax.export.real_time import LATE, World, open_robots
from mqe_jax.export.robot_team import open_team
from mqe_jax.names import Source
from mqe_jax.runs.playing import evaluate


@dataclasses.dataclass(frozen=True, repr=False)
class RealTime:
    """Results of exported robots in real time; rates are of success, or of wins in a match."""

    task: str
    about: dict[str, Any]
    """Who acted, by name: policy, actions, opponent, seed."""
    episodes: int
    latency: float
    """Time that was added to each command, s."""
    rate: Rate
    """In real time."""
    synchronous: Rate
    """From the same initial states, in a world that waits for each answer."""
    speed: float
    """Speed of the world, relative to real time."""
    late: float
    """Share of commands that were used more than two steps, and the latency, after the readings."""
    stood: float
    """Share of a robot's steps in which it stood, as no command had come for 0.2 s."""
    delay: float
    """Median time from readings to the step that used the answer, s."""
    endings: dict[str, float]
    """Shares of the episodes in real time that ended so, by name."""

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values for JSON; rates have their 95% intervals beside them."""
        values = {name: x for name, x in vars(self).items() if name != "about"}
        rates = {"rate": self.rate, "synchronous": self.synchronous}
        intervals = {name: [rate.low, rate.high] for name, rate in rates.items()}
        values |= {name: rate.value for name, rate in rates.items()}
        return {**self.about, **values, "intervals": intervals}

    def __repr__(self) -> str:
        rows = {
            "task": self.task,
            **self.about,
            "episodes": self.episodes,
            "added latency": f"{1000 * self.latency:.0f} ms",
            "in real time": self.rate,
            "step by step": self.synchronous,
            "speed of the world": f"{self.speed:.3f} x real time",
            "median delay": f"{1000 * self.delay:.0f} ms",
            "late commands": f"{100 * self.late:.1f}%",
            "stood without commands": f"{100 * self.stood:.1f}%",
        }
        for name, share in self.endings.items():
            rows[f"ends by {name.replace('_', ' ')}"] = f"{100 * share:.1f}%"
        return "\n".join(f"{name:<24} {line(value)}" for name, value in rows.items())


@checked
def real_time(
    task: str | Path | QuadrupedEnv,
    robot: str | Path,
    opponent: Source | None = None,
    *,
    opponent_robot: str | Path | None = None,
    env: Parameters | None = None,
    episodes: Candidates = 20,
    latency: Latency = 0.0,
    deterministic: bool = False,
    seed: Seed = 0,
    log: str | Path | None = None,
    limits: tuple[Positive, Positive, Positive] | None = None,
) -> RealTime:
    """Evaluates exported robots in real time, as `mqe eval TASK --export FILE --real-time`.

    The world runs on the C engine, not faster than time passes. Each robot is a process
    (`mqe_jax.export.runner`).

    Example:
        ```python
        from mqe_jax.runs.real_time import real_time

        # written by mqe export go1gate --per-robot --onnx gate.onnx
        print(real_time("go1gate", "gate.onnx", episodes=1))
        ```

    Args:
        task: as `evaluate`, and so are opponent, env, deterministic and seed.
        robot: graph of one robot of the team.
        opponent_robot: the same for the opponents, in place of `opponent`.
        episodes: number of episodes.
        latency: time added to each command, s.
        log: folder for a log of each robot, which `mqe replay` shows.
        limits: largest vx, vy and yaw rate in real time, m/s and rad/s. Default: those of the
            graph.

    Raises:
        InputError: as `evaluate`, for actions that are not velocities, and on a machine that
            simulates slower than real time.
        ConnectionError: naming a robot whose process ended.
    """
    if sys.platform == "win32":
        fail("real_time", "Windows", "left out there: it needs Linux or macOS")
    read: names.Read = {}
    with contextlib.ExitStack() as stack:
        team = stack.enter_context(open_team(robot, seed))
        other: Source | None = opponent
        if opponent_robot is not None:
            if opponent is not None:
                fail("opponent", opponent, "left out beside the file of a robot")
            other = stack.enter_context(open_team(opponent_robot, (seed + 1) % 2**32))
        options: dict[str, Any] = {"env": env, "impl": "c", "deterministic": deterministic}
        playing = names.table(task, team, other, **options, read=read)
        world = World(playing.env, playing.seats)
        options |= {"episodes": episodes, "num_envs": episodes}  # one of each state
        expected = evaluate(task, team, other, **options, seed=seed)
    ranges = playing.env.params.action_ranges()
    for most, (name, ends) in zip(limits or (), ranges.items(), strict=False):
        if most < max(map(abs, ends)):
            warn(
                f"limits: {most:g} is below the {max(map(abs, ends)):g} of {name} in training; "
                "train with lower command_ranges, and a longer episode_length"
            )
    keys = jax.random.split(jax.random.split(jax.random.PRNGKey(seed))[0], episodes)
    folder = None if log is None else Path(log)
    with (
        Progress(console=Console(stderr=True)) as bar,
        open_robots(world, episodes, latency, folder, limits or ()) as robots,
    ):
        shown = bar.add_task(f"{world.env.name} in real time", total=episodes)
        course = world.play(robots, keys, report=lambda: bar.advance(shown))
    delays = np.array(course.delays or [0]) * world.env.dt  # in an episode that ends at once
    late = delays > LATE * world.env.dt + latency + 1e-6
    return RealTime(
        task=world.env.name,
        about={**playing.about, "seed": seed},
        episodes=episodes,
        latency=latency,
        rate=Rate.of(float(np.mean(course.successes)), episodes),
        synchronous=expected.win or expected.success,
        speed=course.steps * world.env.dt / course.seconds,
        late=float(late.mean()),
        stood=course.stood / (course.steps * len(robots)),
        delay=float(np.median(delays)),
        endings={name: count / episodes for name, count in course.endings.items()},
    )
