"""Trains on an environment outside the package, without robots or physics engine.

Two points on a plane must meet. `python examples/foreign_env.py` prints the distance at the end of
episodes before and after; a minute on a CPU.
"""

from __future__ import annotations

import tempfile
from typing import NamedTuple

import jax
import jax.numpy as jnp

from mqe_jax.core.settings import build
from mqe_jax.core.types import Outcome
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.runner import train


class State(NamedTuple):
    """N environments of two agents; see `mqe_jax.core.types.VectorEnv`."""

    position: jax.Array
    """Positions of both agents (N, 2, 2), m."""
    step: jax.Array
    """Steps since the reset (N,) int32."""
    key: jax.Array
    obs: jax.Array
    """Observations (N, 2, 6)."""
    privileged_obs: jax.Array
    """Privileged observations (N, 4)."""
    final_obs: jax.Array
    final_privileged_obs: jax.Array
    reward: jax.Array
    """Rewards (N, 2)."""
    terminated: jax.Array
    """Whether an episode terminated (N,)."""
    truncated: jax.Array
    """Whether an episode was truncated at the time limit (N,)."""
    outcome: Outcome
    """How episodes ended."""
    metrics: dict[str, jax.Array]
    """Metrics by name (N,) each."""


def distance(position: jax.Array) -> jax.Array:
    """Returns the distance between the agents (N,), m."""
    return jnp.linalg.norm(position[:, 0] - position[:, 1], axis=-1)


class Meeting:
    """Agents start within 1 m of the origin and move by at most 0.1 m a step.

    The episode is truncated after 20 steps.

    Observation: one-hot agent 2, own position 2, offset to the other agent 2. Reward, shared: minus
    the distance.
    """

    name = "meeting"
    num_agents = 2
    action_size = 2
    max_episode_steps = 20
    observation_size = 6
    privileged_observation_size = 4

    def __init__(self, num_envs: int) -> None:
        self.num_envs = num_envs

    def observe(self, position: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Returns all agents' observations and the privileged one."""
        agent = jnp.broadcast_to(jnp.eye(2), (self.num_envs, 2, 2))
        obs = jnp.concatenate([agent, position, position[:, ::-1] - position], axis=-1)
        return obs, position.reshape(self.num_envs, 4)

    def reset(self, key: jax.Array) -> State:
        """Returns N new episodes."""
        key, draw = jax.random.split(key)
        position = jax.random.uniform(draw, (self.num_envs, 2, 2), minval=-1.0)
        obs, privileged = self.observe(position)
        zero = jnp.zeros(self.num_envs)
        done = zero > 0
        step = zero.astype(jnp.int32)
        reward = jnp.zeros((self.num_envs, 2))
        return State(
            position=position,
            step=step,
            key=key,
            obs=obs,
            privileged_obs=privileged,
            final_obs=obs,
            final_privileged_obs=privileged,
            reward=reward,
            terminated=done,
            truncated=done,
            outcome=self.outcome(zero),
            metrics={"average_step_reward": zero},
        )

    def outcome(self, apart: jax.Array) -> Outcome:
        """Returns success, and the distance, m, of the only team (N, 1) each."""
        success = (apart < 0.1).astype(jnp.float32)
        return Outcome(success=success[:, None], further={"distance": apart[:, None]})

    def step(self, state: State, action: jax.Array) -> State:
        """Moves the agents, with automatic reset."""
        position = state.position + 0.1 * jnp.clip(action, -1.0, 1.0)
        apart = distance(position)
        truncated = state.step + 1 >= self.max_episode_steps
        final_obs, final_privileged = self.observe(position)
        fresh = self.reset(state.key)
        position = jnp.where(truncated[:, None, None], fresh.position, position)
        obs, privileged = self.observe(position)
        return State(
            position=position,
            step=jnp.where(truncated, 0, state.step + 1),
            key=fresh.key,
            obs=obs,
            privileged_obs=privileged,
            final_obs=final_obs,
            final_privileged_obs=final_privileged,
            reward=-jnp.stack([apart, apart], axis=-1),
            terminated=jnp.zeros_like(truncated),
            truncated=truncated,
            outcome=self.outcome(apart),
            metrics={"average_step_reward": -apart},
        )


def main(num_envs: int = 64, updates: int = 100, **settings: object) -> list[float]:
    """Trains, and returns the distance at the end of episodes after every update, m."""
    config = build(
        TrainConfig,
        {
            "num_envs": num_envs,
            "rollout_steps": 20,
            "total_steps": updates * num_envs * 20,
            "ppo": {"epochs": 4, "minibatches": 2, "entropy_coef": 0.0},
            "optimizer": {"learning_rate": 3e-3},
            "network": {"recurrent": False, "log_std_init": -0.5},
            **settings,
        },
    )
    distances: list[float] = []

    def note(state: object, row: dict[str, float]) -> None:
        distances.append(row["success/distance"])

    with tempfile.TemporaryDirectory() as folder:
        train(Meeting(num_envs), config, folder, on_update=note)
    return distances


if __name__ == "__main__":
    first, *_, last = main()
    print(f"distance at the end of an episode: {first:.2f} m before, {last:.2f} m after")
