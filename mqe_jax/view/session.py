"""The simulation behind the viewer: environments, a policy, and a teleoperated robot. Independent of the browser."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.train.policy import Policy
from mqe_jax.viz.recording import Episode

DRIVEN = ("vx", "vy", "yaw_rate")
"""Teleoperation commands: m/s, m/s, rad/s."""
HOLD_TIME = 0.35
"""Time after a button's last hold message at which it counts as released, s; the browser sends ten per second."""


@dataclass
class Drive:
    """Teleoperation of one robot: a command set by keys, plus the commands of held buttons."""

    limit: np.ndarray
    """Greatest command (3,), m/s and rad/s."""
    env: int = 0
    """Index of its environment."""
    robot: int | None = None
    """Index of the agent, or None if no robot is driven."""
    command: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """Command set by keys: vx, vy, yaw_rate (3,), m/s and rad/s."""
    clock: Callable[[], float] = time.monotonic
    """Clock, s."""

    def __post_init__(self) -> None:
        self._held: dict[tuple[float, ...], float] = {}

    def change(self, step: tuple[float, float, float]) -> None:
        """Adds fractions of the maximum command to the command; zeros stop the robot."""
        self._held.clear()
        moved = self.command + np.asarray(step) * self.limit
        self.command = np.clip(moved, -self.limit, self.limit) if any(step) else np.zeros(3)

    def hold(self, direction: tuple[float, float, float]) -> None:
        """Adds fractions of the maximum command until `HOLD_TIME` after the last call."""
        self._held[direction] = self.clock() + HOLD_TIME

    def now(self) -> np.ndarray:
        """Returns the current command (3,), within its limits."""
        held = [direction for direction, until in list(self._held.items()) if until > self.clock()]
        total = self.command + np.sum([np.zeros(3), *(np.asarray(d) * self.limit for d in held)], axis=0)
        return np.clip(total, -self.limit, self.limit)


class Session:
    """N environments stepped under a policy, with a history of recent steps."""

    env: Any
    """The task."""
    num_envs: int
    """N."""
    paused: bool
    """Whether the simulation is paused."""
    speed: float
    """Target real-time factor."""
    drive: Drive
    """Teleoperation."""
    terms: tuple[str, ...]
    """Names of the logged rewards: the terms, then their sum."""
    steps: int
    """Environment steps so far."""
    episodes: np.ndarray
    """Number of finished episodes of each environment (N,)."""

    def __init__(self, env: Any, vector_env: Any, policy: Policy, seed: int = 0, history: float = 10.0) -> None:
        """Creates the environments; `policy` acts for all agents, `history` is the length of the history, s."""
        self.env, self.num_envs = env, vector_env.num_envs
        self.paused, self.speed, self.drive = False, 1.0, Drive(np.zeros(3))
        self._vector_env, self._policy = vector_env, policy
        self._first_memory = policy.initial_memory(self.num_envs)
        self._key = jax.random.PRNGKey(seed)
        self._reset = jax.jit(vector_env.reset)
        self._step = jax.jit(self._advance)
        self.drivable = getattr(env, "control", "") == "command" and set(DRIVEN) <= set(env.params.commands)
        if self.drivable:
            self._columns = np.array([env.params.commands.index(name) for name in DRIVEN])
            skill = env.controller.skill
            self._gain, self.drive.limit = (skill.column(field, DRIVEN) for field in ("gain", "limit"))
        self.steps = 0
        self.episodes = np.zeros(self.num_envs, int)
        self.reset()
        rewards = [name for name in self.state.metrics if name.startswith("reward/")]
        self.terms = (*rewards, "average_step_reward")
        length = max(2, round(history / env.dt))
        self.times: deque[float] = deque(maxlen=length)
        self.rewards: deque[np.ndarray] = deque(maxlen=length)  # (N, terms)
        self.commands: deque[np.ndarray] = deque(maxlen=length)  # (N, A, 3)

    def reset(self) -> None:
        """Resets all environments."""
        self._key, key = jax.random.split(self._key)
        self.state = self._reset(key)
        self.memory = self._first_memory

    def advance(self) -> None:
        """Advances all environments by one step, with automatic reset."""
        self._key, key = jax.random.split(self._key)
        mask = np.zeros((self.num_envs, self.env.num_agents), bool)
        driven = np.zeros(self.env.action_size, np.float32)
        if self.drivable and self.drive.robot is not None:
            mask[self.drive.env, self.drive.robot] = True
            driven[self._columns] = self.drive.now() / self._gain
        self.state, self.memory, done, rewards, commands = self._step(self.state, self.memory, key, mask, driven)
        self.steps += 1
        self.episodes += np.asarray(done)
        self.times.append(self.steps * self.env.dt)
        self.rewards.append(np.asarray(rewards))
        self.commands.append(np.asarray(commands))

    def frame(self) -> Episode:
        """Returns the current poses, those of an environment in each frame."""
        data = self.state.data
        return Episode(*map(np.asarray, (data.qpos, data.mocap_pos, data.mocap_quat)), dt=self.env.dt)

    def _advance(self, state: Any, memory: Any, key: jax.Array, mask: jax.Array, driven: jax.Array) -> Any:
        env = self.env
        action, memory = self._policy.act(state.obs, memory, key)
        commands = jnp.zeros((*mask.shape, len(DRIVEN)))
        if self.drivable:
            # Teleoperation commands are in the robot's frame: mirrored here for team 1, `step` unmirrors them.
            own = env.unmirror_action(jnp.broadcast_to(driven, (env.num_agents, env.action_size)))
            action = jnp.where(mask[..., None], own, action)
            applied = jax.vmap(lambda a: env.controller.skill_commands(env.unmirror_action(jnp.clip(a, -1.0, 1.0))))
            commands = applied(action)[..., env.controller.skill.index(DRIVEN)]
        state = self._vector_env.step(state, action)
        done = state.terminated | state.truncated

        def restart(now: jax.Array, first: jax.Array) -> jax.Array:
            return jnp.where(done.reshape(done.shape + (1,) * (now.ndim - 1)), first, now)

        memory = jax.tree.map(restart, memory, self._first_memory)
        names = [name for name in state.metrics if name.startswith("reward/")]
        rewards = jnp.stack([state.metrics[name] for name in (*names, "average_step_reward")], axis=-1)
        return state, memory, done, rewards, commands
