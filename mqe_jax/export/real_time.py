"""A world in real time whose robots are processes with their own clocks."""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.acting.seats import Fixed, Seats
from mqe_jax.core.errors import InputError
from mqe_jax.core.precision import single
from mqe_jax.core.settings import fail
from mqe_jax.core.types import observations
from mqe_jax.envs import QuadrupedEnv
from mqe_jax.export.processes import START, LiveRobot
from mqe_jax.export.robot_graph import VELOCITY
from mqe_jax.export.robot_team import RobotTeam
from mqe_jax.export.runner import HOLD

PAUSE = 1.5 * HOLD
"""Time between episodes, in which robots get no readings and stop, s."""
LATE = 2
"""Steps from readings to the step that uses their answer, above which the answer is late.

One is the least.
"""
_TRIED = 50  # steps that measure how fast the world can run


@dataclass
class Course:
    """What happened in a world; counts are over all robots that are processes."""

    successes: list[float] = field(default_factory=list)
    """Success of team 0 in each episode, or in a match whether it won."""
    endings: Counter[str] = field(default_factory=Counter)
    """Number of episodes that ended so, by name."""
    steps: int = 0
    """Steps of the world."""
    seconds: float = 0.0
    """Time that the steps took, s."""
    delays: list[int] = field(default_factory=list)
    """Steps from readings to the step that used their answer, for each robot's command."""
    stood: int = 0
    """Number of commands that were missing or too old, so that the robot stood."""


class World:
    """One environment on the C engine, which runs at most as fast as real time.

    A robot's command is a velocity. The world uses the newest that has arrived for `HOLD`, and then
    lets the robot stand. It waits for no robot.
    """

    def __init__(self, env: QuadrupedEnv, seats: Seats) -> None:
        """Compiles the world; the seats of `RobotTeam` are for processes, others act in it.

        Raises:
            InputError: for actions that are not velocities, or if the world cannot reach real time.
        """
        if env.control != "command" or env.controller.commands != VELOCITY:
            found = env.controller.commands if env.control == "command" else env.control
            fail("real_time", found, f"left out: robots get {', '.join(VELOCITY)}")
        self.env = env
        self.teams: dict[int, RobotTeam] = {}
        others = []
        for seat in seats.seats:
            policy = seat.policy.policy if isinstance(seat.policy, Fixed) else None
            if isinstance(policy, RobotTeam):
                self.teams |= dict.fromkeys(seat.acts, policy)
            else:
                others.append(seat)
        self._groups = [*seats.groups]
        self._others = Seats(tuple(others)).fixed()
        self._begin = jax.jit(single(self._first))
        self._step = jax.jit(single(self._next))
        self.speed = self._measure()
        if self.speed < 1.0:
            raise InputError(
                f"real_time: this machine simulates {env.name} at {self.speed:.2f} x real time; "
                "it must reach 1"
            )

    def play(
        self,
        robots: Mapping[int, LiveRobot],
        keys: jax.Array,
        report: Callable[[], None] = lambda: None,
    ) -> Course:
        """Plays an episode for each random key (N, 2); `report` is called after each.

        Raises:
            ConnectionError: naming a robot whose process has ended, and the result until then. The
                robot stands.
        """
        course = Course()
        for robot in robots.values():
            robot.wait()
        for episode, key in enumerate(keys):
            state, memory = self._begin(key)
            time.sleep(PAUSE)
            try:
                self._play(robots, episode, state, memory, course)
            except ConnectionError as error:
                won = round(sum(course.successes))
                said = f"{error}; {won} of {episode} finished episodes succeeded"
                raise ConnectionError(said) from None
            report()
        return course

    def _play(
        self,
        robots: Mapping[int, LiveRobot],
        episode: int,
        state: Any,
        memory: Any,
        course: Course,
    ) -> None:
        """Plays an episode from a state.

        A step uses the commands that have come before it; its readings leave when it has passed.
        """
        first = course.steps
        last = dict.fromkeys(robots, first)  # steps in which commands came
        velocity = np.zeros((self.env.num_agents, 3), np.float32)
        numbers: dict[int, int] = {}  # of the readings to which the commands belong
        start = tick = time.monotonic()
        done = False
        self._send(robots, first, episode, state)
        while not done:
            now = course.steps
            for agent, robot in robots.items():
                new = robot.receive(now)
                if new is not None and new[0] >= first:
                    last[agent] = now
                    numbers[agent] = int(new[0])
                    velocity[agent] = new[1:]
                if robot.ended or (now - last[agent]) * self.env.dt > HOLD + 1e-6:
                    velocity[agent] = 0.0
                    course.stood += 1
                elif agent in numbers:
                    course.delays.append(now - numbers[agent])
            state, memory = self._step(state, memory, velocity)
            done = bool(state.terminated | state.truncated)
            for agent, robot in robots.items():
                if robot.ended:
                    passed = (now - last[agent]) * self.env.dt
                    what = f"told to stand {passed:.2f} s after its last command"
                    raise ConnectionError(f"{robot.end}; it was {what}")
            tick = max(tick + self.env.dt, time.monotonic())
            time.sleep(max(0.0, tick - time.monotonic()))
            course.steps += 1
            if not done:
                self._send(robots, course.steps, episode, state)
        course.seconds += time.monotonic() - start
        outcome = state.outcome
        won = outcome.success if outcome.win is None else outcome.win
        course.successes.append(float(won[0]))
        course.endings.update(name for name, ended in outcome.ending.items() if ended)

    def _send(self, robots: Mapping[int, LiveRobot], number: int, episode: int, state: Any) -> None:
        seen = jax.device_get(state.groups)
        for agent, robot in robots.items():
            robot.send(number, episode, seen[self.teams[agent].needs.group][agent])

    def _first(self, key: jax.Array) -> tuple[Any, Any]:
        state = self.env.with_observations(self.env.begin(key), self._groups)
        return state, self._others.initial_memory(1)

    def _next(self, state: Any, memory: Any, velocity: jax.Array) -> tuple[Any, Any]:
        """Returns the state after a step in which robots walk at velocities (A, 3)."""
        controller = self.env.controller
        default = controller.limits[:, 0] - controller.changes[:, 0]
        action = controller.action_of(velocity - default)[None]
        seen = jax.tree.map(lambda x: x[None], observations(state))
        keys = jax.random.split(jax.random.fold_in(state.key, 1), len(self._others.seats))
        action, memory = self._others.act(seen, memory, tuple(keys), action)
        state = self.env.advance(state, action[0])
        return self.env.with_observations(state, self._groups), memory

    def _measure(self) -> float:
        """Returns how fast the world can run, relative to real time."""
        state, memory = self._begin(jax.random.PRNGKey(0))
        still = jnp.zeros((self.env.num_agents, 3))
        taken = []
        for _ in range(1 + _TRIED):
            start = time.perf_counter()
            state, memory = jax.block_until_ready(self._step(state, memory, still))
            taken.append(time.perf_counter() - start)
        return self.env.dt / float(np.median(taken[1:]))


@contextlib.contextmanager
def open_robots(
    world: World,
    episodes: int,
    latency: float,
    log: Path | None,
    speed: Sequence[float] = (),
) -> Iterator[dict[int, LiveRobot]]:
    """Yields a process for each robot of the world that a team of processes drives, by its number.

    The processes end with the block, or after twice the time that the episodes may take.

    Args:
        world: the world.
        episodes: number of episodes.
        latency: time that a command takes longer, s, rounded to steps of the world.
        log: folder for the robots' logs.
        speed: largest vx, vy and yaw rate, m/s and rad/s. Default: those of the graph.
    """
    env = world.env
    seconds = START + 2.0 * episodes * (env.max_steps * env.dt + PAUSE)
    if log is not None:
        log.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as stack:
        robots = {}
        for agent, team in world.teams.items():
            robots[agent] = LiveRobot(
                team.file,
                agent,
                int(np.random.SeedSequence([team.seed, agent]).generate_state(1)[0]),
                seconds=seconds,
                latency=round(latency / env.dt),
                log=None if log is None else log / f"robot{agent}.csv",
                speed=speed,
            )
            stack.callback(robots[agent].close, 1.0)
        yield robots
