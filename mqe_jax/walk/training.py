"""Training of the walk policy by `mqe_jax.train`; settings as in walk-these-ways (arXiv 2212.03238) where known."""

from __future__ import annotations

from pathlib import Path

import jax

from mqe_jax import walk_policy
from mqe_jax.envs.autoreset import VectorEnv
from mqe_jax.robots.robot import Robot
from mqe_jax.settings import fail, override, to_mapping
from mqe_jax.train.config import PPO, Checkpointing, Curriculum, Normalization, OptimizerSettings, TrainConfig
from mqe_jax.train.learner import TrainState
from mqe_jax.train.runner import train
from mqe_jax.walk.env import WalkEnv
from mqe_jax.walk.network import WalkNetwork
from mqe_jax.walk.task import WalkTask

WALK = TrainConfig(
    task="walk",
    num_envs=8192,
    total_steps=360_000_000,
    rollout_steps=24,
    stagger_episodes=True,
    seed=1,
    ppo=PPO(epochs=5, minibatches=4, huber_delta=None, value_coef=2.0),
    optimizer=OptimizerSettings(
        learning_rate=1e-3, schedule="linear", anneal=0.3, target_kl=0.01, eps=1e-8, max_grad_norm=1.0
    ),
    network=WalkNetwork(),
    curriculum=Curriculum(assistance=1.0, assistance_until=0.3),
    normalization=Normalization(values=False),
    checkpoint=Checkpointing(every=100, environments=False),
    loggers=(),
)
"""Settings for training walk weights from nothing; the assistance is the curriculum of slopes, forces and pushes."""


def train_walk(
    robot: Robot, run_dir: Path, config: TrainConfig, task: WalkTask | None = None, *, impl: str, resume: bool
) -> TrainState:
    """Trains walk weights and writes them to walk.safetensors (float16) in the run folder, at every checkpoint.

    `config` are settings such as `WALK`; run folder, resuming and errors are those of `mqe_jax.train.runner.train`.
    """
    if config.opponents:
        fail("opponents", list(config.opponents), "empty: walking is not a match")
    task = task or WalkTask()
    config = override(config, {"env": {"robot": robot.name, **to_mapping(task)}})
    env = WalkEnv(robot, task, impl=impl, num_envs=config.num_envs)

    def save(state: TrainState, row: dict[str, float]) -> None:
        updates = int(row["updates"])
        if jax.process_index() > 0:
            return
        if updates % config.checkpoint.every == 0 or updates == config.num_updates:
            about = {"robot": robot.name, "env_steps": int(row["env_steps"])}
            walk_policy.save_params(state.params["policy"], run_dir / "walk.safetensors", about, half=True)

    batch = VectorEnv(env, config.num_envs)  # pyright: ignore[reportArgumentType]: no task, but all that a batch uses
    return train(batch, config, run_dir, resume, on_update=save)
