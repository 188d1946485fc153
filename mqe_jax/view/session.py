"""The simulation behind the viewer: environments, a policy, and a teleoperated robot.

Independent of the browser.
"""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.acting.seats import Seats
from mqe_jax.core.types import RESULTS, VectorEnv, observations
from mqe_jax.envs import QuadrupedEnv
from mqe_jax.sensors.marks import Marks
from mqe_jax.sensors.suite import ONBOARD
from mqe_jax.viz.recording import Episode

DRIVEN = ("vx", "vy", "yaw_rate")
"""Teleoperation commands: m/s, m/s, rad/s."""
HOLD_TIME = 0.35
"""Time after a button's last hold message at which it counts as released, s; the browser sends ten
per second."""


class Scene(NamedTuple):
    """What is drawn of a step."""

    frame: Episode  # poses, those of an environment in each frame
    qvel: np.ndarray  # velocities (N, nv)
    ctrl: np.ndarray  # actuator targets (N, nu)
    obs: np.ndarray  # observations of the agents (N, A, O)
    marks: tuple[Marks, ...] = ()  # what they sense; arrays (N, A, ...)


@dataclass
class Drive:
    """Teleoperation of one robot: a command set by keys, plus the commands of held buttons."""

    low: np.ndarray  # lowest command (3,), m/s and rad/s
    high: np.ndarray  # highest command (3,), m/s and rad/s
    env: int = 0  # index of its environment
    robot: int | None = None  # index of the agent, or None if no robot is driven
    command: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """Command set by keys: vx, vy, yaw_rate (3,), m/s and rad/s."""
    clock: Callable[[], float] = time.monotonic  # clock, s

    def __post_init__(self) -> None:
        self._held: dict[tuple[float, ...], float] = {}

    def change(self, step: tuple[float, float, float]) -> None:
        """Adds fractions of the maximum command to the command; zeros stop the robot."""
        self._held.clear()
        moved = self.command + self._scale(step)
        self.command = np.clip(moved, self.low, self.high) if any(step) else np.zeros(3)

    def hold(self, direction: tuple[float, float, float]) -> None:
        """Adds fractions of the maximum command until `HOLD_TIME` after the last call."""
        self._held[direction] = self.clock() + HOLD_TIME

    def now(self) -> np.ndarray:
        """Returns the current command (3,), within its limits."""
        held = [direction for direction, until in list(self._held.items()) if until > self.clock()]
        total = self.command + np.sum([np.zeros(3), *map(self._scale, held)], axis=0)
        return np.clip(total, self.low, self.high)

    def _scale(self, direction: tuple[float, ...]) -> np.ndarray:
        return np.abs(direction) * np.where(np.asarray(direction) < 0, self.low, self.high)


class Session:
    """N environments stepped under a policy, with a history of recent steps."""

    def __init__(
        self,
        env: QuadrupedEnv,
        vector_env: VectorEnv,
        seats: Seats,
        seed: int = 0,
        history: float = 20.0,
    ) -> None:
        """Creates the environments, in which `seats` act, with a history of that length, s."""
        self.env = env
        self.num_envs = vector_env.num_envs
        self.paused = False
        self.speed = 1.0  # a real-time factor
        self.drive = Drive(np.zeros(3), np.zeros(3))
        self._vector_env = vector_env
        self._seats = seats
        self._key = jax.random.PRNGKey(seed)
        self._reset = jax.jit(vector_env.reset)
        self._step = jax.jit(self._advance)
        self.senses = ONBOARD in getattr(vector_env, "groups", ())
        """Whether there are sensors' readings to draw."""
        self._marks = jax.jit(jax.vmap(env.marks)) if self.senses else lambda _: ()
        self.drivable = getattr(env, "control", "") == "command" and set(DRIVEN) <= set(
            env.params.commands
        )
        self._moving = env.controller.action_size if self.drivable else env.action_size
        if self.drivable:
            self._columns = np.array([env.params.commands.index(name) for name in DRIVEN])
            self.drive.low, self.drive.high = env.controller.changes[self._columns].T
        self.steps = 0
        self.episodes = np.zeros(self.num_envs, int)  # finished ones
        self.last = [""] * self.num_envs  # outcome of the last finished episode, if any
        self.reset()
        self.outcomes: tuple[str, ...] = ("success",) if self.state.outcome.win is None else RESULTS
        self.counts = np.zeros(len(self.outcomes), int)  # of finished episodes with each outcome
        rewards = [name for name in self.state.metrics if name.startswith("reward/")]
        self.terms: tuple[str, ...] = (*rewards, "average_step_reward")
        length = max(2, round(history / env.dt))
        self.times: deque[float] = deque(maxlen=length)
        self.rewards: deque[np.ndarray] = deque(maxlen=length)  # (N, terms)
        self.commands: deque[np.ndarray] = deque(maxlen=length)  # (N, A, 3)
        self.moments: deque[Scene] = deque(maxlen=length)

    def reset(self) -> None:
        """Resets all environments."""
        self._key, key = jax.random.split(self._key)
        self.state = self._reset(key)
        self.memory = self._seats.initial_memory(self.num_envs)

    def advance(self) -> None:
        """Advances all environments by one step, with automatic reset."""
        self._key, key = jax.random.split(self._key)
        mask = np.zeros((self.num_envs, self.env.num_agents), bool)
        driven = np.zeros(self._moving, np.float32)  # change of the commands
        if self.drivable and self.drive.robot is not None:
            mask[self.drive.env, self.drive.robot] = True
            driven[self._columns] = self.drive.now()
        self.state, self.memory, done, ended, rewards, commands = self._step(
            self.state, self.memory, key, mask, driven
        )
        self.steps += 1
        self.episodes += np.asarray(done)
        self._count(np.asarray(done), np.asarray(ended))
        self.times.append(self.steps * self.env.dt)
        self.rewards.append(np.asarray(rewards))
        self.commands.append(np.asarray(commands))
        self.moments.append(self.moment())

    def moment(self, back: int = 0) -> Scene:
        """Returns the current step, or that of `back` steps ago, at most the oldest one kept."""
        if back and self.moments:
            return self.moments[self.at(back)]
        data = self.state.data
        poses = map(np.asarray, (data.qpos, data.mocap_pos, data.mocap_quat))
        arrays = map(np.asarray, (data.qvel, data.ctrl, self.state.obs))
        return Scene(
            Episode(*poses, dt=self.env.dt), *arrays, marks=jax.device_get(self._marks(self.state))
        )

    def at(self, back: int) -> int:
        """Returns the index into the history of the step `back` steps ago, at most its oldest."""
        return -1 - min(back, len(self.moments) - 1)

    def _count(self, done: np.ndarray, ended: np.ndarray) -> None:
        """Counts the outcomes (N, K) of the environments whose episode ended (N,)."""
        self.counts += np.sum(done[:, None] & ended, axis=0)
        for index in np.flatnonzero(done):
            names = [name for name, is_it in zip(self.outcomes, ended[index], strict=True) if is_it]
            self.last[index] = names[0] if names else "no success"

    def _advance(
        self, state: Any, memory: Any, key: jax.Array, mask: jax.Array, driven: jax.Array
    ) -> Any:
        env = self.env
        still = jnp.zeros((*mask.shape, env.action_size))
        action, memory = self._seats.act(observations(state), memory, key, still)
        commands = jnp.zeros((*mask.shape, len(DRIVEN)))
        if self.drivable:
            # Teleoperation commands are in the robot's frame: mirrored here for team 1, `step`
            # unmirrors them.
            driven = env.controller.action_of(driven)
            own = env.unmirror_action(jnp.broadcast_to(driven, (env.num_agents, len(driven))))
            moving = jnp.where(mask[..., None], own, action[..., : len(driven)])
            action = action.at[..., : len(driven)].set(moving)
            applied = jax.vmap(
                lambda a: env.controller.skill_commands(env.unmirror_action(jnp.clip(a, -1.0, 1.0)))
            )
            commands = applied(moving)[..., env.controller.skill.index(DRIVEN)]
        state = self._vector_env.step(state, action)
        done = state.terminated | state.truncated
        memory = self._seats.restart(memory, done)
        rewards = jnp.stack([state.metrics[name] for name in self.terms], axis=-1)
        ended = jnp.stack(
            [getattr(state.outcome, name)[:, 0] > 0 for name in self.outcomes], axis=-1
        )
        return state, memory, done, ended, rewards, commands
