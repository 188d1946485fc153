"""Recording of episodes as numpy arrays."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.acting.seats import Act, Policy, Seats
from mqe_jax.core.limits import CLIP_BYTES
from mqe_jax.core.precision import single
from mqe_jax.core.settings import fail
from mqe_jax.core.types import observations
from mqe_jax.envs import QuadrupedEnv
from mqe_jax.sensors.marks import Marks
from mqe_jax.sensors.suite import ONBOARD

_DRAWN = 2048  # numbers that the marks of an agent take, about


@dataclasses.dataclass(frozen=True)
class Episode:
    """Frames of one episode, with all data needed for rendering."""

    qpos: np.ndarray
    """Generalised coordinates (T, nq)."""
    mocap_pos: np.ndarray
    """Positions of the mocap bodies (T, n_mocap, 3), m, world frame."""
    mocap_quat: np.ndarray
    """Orientations of the mocap bodies, wxyz (T, n_mocap, 4)."""
    dt: float
    """Time between frames, s."""
    success: float = 0.0
    """Success of team 0 on the last step; 0 if the recording was cut at its time limit."""
    reward: float = 0.0
    """Mean over steps of the sum of the reward terms."""
    settled: float = 0.0
    """Time from which `success` has its last value, s."""
    marks: tuple[Marks, ...] = ()
    """What the agents sense, if it is recorded; arrays (T, A, ...)."""

    def __len__(self) -> int:
        return len(self.qpos)

    def cut(self, frames: slice) -> "Episode":
        """Returns the episode with a part of its frames, such as every n-th.

        `settled` stays that of the whole.
        """
        poses = {name: getattr(self, name)[frames] for name in ("qpos", "mocap_pos", "mocap_quat")}
        marks = jax.tree.map(lambda x: x[frames], self.marks)
        return dataclasses.replace(self, **poses, marks=marks, dt=self.dt * (frames.step or 1))


@single
def record_episodes(
    env: QuadrupedEnv,
    policy: Seats | Policy | Act,
    key: jax.Array,
    *,
    episodes: int = 1,
    seconds: float = 20.0,
    sensors: bool = False,
) -> list[Episode]:
    """Records one episode in each of several environments, until it ends or for `seconds`.

    `policy` is that of all agents, seats of several, or a function like a policy's `act` without
    recurrent state; batched over episodes. `sensors` also records what shows the readings of the
    task's sensors.

    Example:
        ```python
        from pathlib import Path

        from mqe_jax.viz.recording import best, record_episodes
        from mqe_jax.viz.render import render_episode

        env = mqe_jax.make("go1gate")
        policy = mqe_jax.load_policy("go1gate", env)
        episodes = record_episodes(env, policy, jax.random.PRNGKey(0), episodes=4, seconds=5)
        render_episode(env, best(episodes), Path("gate.gif"))
        ```
    """
    seats = Seats.of(env, policy)
    groups = {*seats.groups}
    if sensors:
        groups.add(ONBOARD)
    size = env.mj_model.nq + 7 * env.mj_model.nmocap + (_DRAWN * env.num_agents if sensors else 0)
    if 4 * episodes * round(seconds / env.dt) * size > CLIP_BYTES:
        fail(
            "episodes",
            episodes,
            f"fewer for {seconds:g} s: they may have at most {CLIP_BYTES / 2**30:g} GB",
        )
    length = 50
    still = jnp.zeros((episodes, env.num_agents, env.action_size))

    def now(state: Any) -> tuple[jax.Array, ...]:
        return (state.data.qpos, state.data.mocap_pos, state.data.mocap_quat)

    def one_step(carry: tuple[Any, Any], key: jax.Array) -> tuple[tuple[Any, Any], Any]:
        state, memory = carry
        seen = state
        if not groups <= state.groups.keys():
            seen = jax.vmap(functools.partial(env.with_observations, groups=[*groups]))(state)
        action, memory = seats.act(observations(seen), memory, key, still)
        state = jax.vmap(env.step)(dataclasses.replace(seen, groups=state.groups), action)
        done = state.terminated | state.truncated
        reward = state.metrics.get("average_step_reward", state.reward.mean(-1))
        success = state.outcome.success
        success = jnp.zeros_like(reward) if success is None else success[:, 0]
        marks = jax.vmap(env.marks)(seen) if sensors else ()
        return (state, memory), (*now(state), done, reward, success, marks)

    @jax.jit
    def chunk(
        carry: tuple[Any, Any], key: jax.Array, index: jax.Array
    ) -> tuple[tuple[Any, Any], Any]:
        keys = jax.random.split(jax.random.fold_in(jax.random.split(key)[1], index), length)
        return jax.lax.scan(one_step, carry, keys)

    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.split(key)[0], episodes))
    first = [np.asarray(x)[None] for x in now(state)]
    rows: list[Any] = []
    steps = max(1, round(seconds / env.dt))
    carry = (state, seats.initial_memory(episodes))
    for index in range(-(-steps // length)):
        carry, out = chunk(carry, key, np.uint32(index))
        rows.append(jax.device_get(out))
        if np.concatenate([row[3] for row in rows]).any(0).all():
            break
    *columns, drawn = zip(*rows, strict=True)
    *frames, done, reward, success = (np.concatenate(column)[:steps] for column in columns)
    # After the last step nobody senses: the marks before it remain.
    drawn = jax.tree.map(lambda *parts: np.concatenate([*parts, parts[-1][-1:]]), *drawn)
    frames = [np.concatenate(pair) for pair in zip(first, frames, strict=True)]
    recorded = []
    for i in range(episodes):
        last = int(done[:, i].argmax()) if done[:, i].any() else len(done) - 1
        won = float(success[last, i]) if done[last, i] else 0.0
        others = np.flatnonzero(success[: last + 1, i] != success[last, i])
        settled = (int(others[-1]) + 2 if len(others) else 0) * float(env.dt)
        poses = (x[: last + 2, i] for x in frames)
        rest = {"success": won, "reward": float(reward[: last + 1, i].mean()), "settled": settled}
        marks = jax.tree.map(lambda x, i=i, last=last: x[: last + 2, i], drawn)
        recorded.append(Episode(*poses, dt=float(env.dt), marks=marks, **rest))
    return recorded


def best(episodes: list[Episode]) -> Episode:
    """Returns the best episode: by success, then by average step reward."""
    return max(episodes, key=lambda episode: (episode.success, episode.reward))
