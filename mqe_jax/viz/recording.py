"""Episodes recorded as numpy, frame by frame."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

Act = Callable[[Any, Any, Any], tuple[Any, Any]]
"""`act(obs (N, A, O), memory, key) -> (action (N, A, action_size), memory)`."""


@dataclass(frozen=True)
class Episode:
    """One world's episode, frame by frame, with everything that drawing needs."""

    qpos: np.ndarray  # (T, nq)
    mocap_pos: np.ndarray  # (T, n_mocap, 3) metre, world frame
    mocap_quat: np.ndarray  # (T, n_mocap, 4) wxyz
    dt: float  # s between frames
    success: float = 0.0  # `success` on the last step, 0 where the episode was cut
    reward: float = 0.0  # mean over steps of the sum of the reward terms

    def __len__(self) -> int:
        return len(self.qpos)

    def every(self, n: int) -> "Episode":
        """Keep every n-th frame."""
        kept = slice(None, None, n)
        return replace(
            self,
            qpos=self.qpos[kept],
            mocap_pos=self.mocap_pos[kept],
            mocap_quat=self.mocap_quat[kept],
            dt=self.dt * n,
        )


def record(env: Any, act: Act, memory: Any, key: jax.Array, *, worlds: int = 1, seconds: float = 20.0) -> list[Episode]:
    """Play one episode in each of `worlds` fresh worlds, without auto-reset.

    `act` and `memory` are batched over `worlds` as in `Act`. Every episode ends with the frame on which the
    world terminated or was truncated, or after `seconds`.
    """
    reset_key, act_key = jax.random.split(key)

    def frame(state: Any) -> tuple[jax.Array, ...]:
        return (state.data.qpos, state.data.mocap_pos, state.data.mocap_quat)

    def one_step(carry: tuple[Any, Any], key: jax.Array) -> tuple[tuple[Any, Any], Any]:
        state, memory = carry
        action, memory = act(state.obs, memory, key)
        state = jax.vmap(env.step)(state, action)
        done = state.terminated | state.truncated
        reward = state.metrics.get("average_step_reward", state.reward.mean(-1))
        success = state.metrics.get("success", jnp.zeros_like(reward))
        return (state, memory), (*frame(state), done, reward, success)

    chunk = jax.jit(lambda carry, keys: jax.lax.scan(one_step, carry, keys))
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(reset_key, worlds))
    first = [np.asarray(x)[None] for x in frame(state)]
    rows: list[list[np.ndarray]] = []
    steps, length = max(1, round(seconds / env.dt)), 50
    carry = (state, memory)
    for index in range(-(-steps // length)):
        keys = jax.random.split(jax.random.fold_in(act_key, index), length)
        carry, out = chunk(carry, keys)
        rows.append([np.asarray(x) for x in out])
        if np.concatenate([row[3] for row in rows]).any(0).all():
            break
    columns = [np.concatenate([row[i] for row in rows])[:steps] for i in range(6)]
    done, reward, success = columns[3:]
    episodes = []
    for world in range(worlds):
        last = int(done[:, world].argmax()) if done[:, world].any() else len(done) - 1
        poses = [np.concatenate([f, c])[: last + 2, world] for f, c in zip(first, columns[:3], strict=True)]
        won = float(success[last, world]) if done[last, world] else 0.0
        mean = float(reward[: last + 1, world].mean())
        episodes.append(Episode(poses[0], poses[1], poses[2], float(env.dt), won, mean))
    return episodes


def best(episodes: list[Episode]) -> Episode:
    """The episode that shows most: success first, then average step reward."""
    return max(episodes, key=lambda episode: (episode.success, episode.reward))
