"""Training of skills by `mqe_jax.train`; settings as in walk-these-ways (arXiv 2212.03238) where known."""

from __future__ import annotations

from pathlib import Path

import jax

from mqe_jax.core.settings import fail, override, to_mapping
from mqe_jax.envs.autoreset import VectorEnv
from mqe_jax.physics.robots.robot import Robot
from mqe_jax.train.config import PPO, Checkpointing, Curriculum, Normalization, OptimizerSettings, TrainConfig
from mqe_jax.train.learner import TrainState
from mqe_jax.train.runner import train
from mqe_jax.walk.env import WalkEnv
from mqe_jax.walk.network import HistorySettings, WalkNetwork
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

AGILE = override(
    WALK,
    {
        "task": "agile",
        "num_envs": 4096,
        "total_steps": 160_000_000,
        "network": {"name": "agile"},
        "curriculum.assistance_until": 0.5,
    },
)
"""Settings for training the agile skill from nothing; the assistance is the curriculum of commands and disturbances."""

AGILE_TASK = WalkTask(start=0.5, tolerance=2.0, command_period=4.0, slope=0.15, shove=100.0, action_lag=1)
"""The walking task of the agile skill: fast commands, shoves as in contact with robots and boxes, gentle slopes."""

SETTINGS: dict[str, tuple[TrainConfig, WalkTask]] = {"walk": (WALK, WalkTask()), "agile": (AGILE, AGILE_TASK)}
"""Settings and task of each skill that can be trained."""


def train_skill(
    skill: str,
    robot: Robot,
    run_dir: Path,
    config: TrainConfig,
    task: WalkTask | None = None,
    *,
    impl: str,
    resume: bool,
) -> TrainState:
    """Trains a skill's weights and writes them to SKILL.safetensors (float16) in the run folder, at every checkpoint.

    `config` and `task` are like those of `SETTINGS`; run folder, resuming and errors are those of
    `mqe_jax.train.runner.train`.
    """
    if config.opponents:
        fail("opponents", list(config.opponents), "empty: walking is not a match")
    network = config.network
    assert isinstance(network, HistorySettings)
    env = WalkEnv(robot, task or SETTINGS[skill][1], skill=skill, impl=impl, num_envs=config.num_envs)
    config = override(config, {"env": {"control": env.control, **to_mapping(env.params)}})

    def save(state: TrainState, row: dict[str, float]) -> None:
        updates = int(row["updates"])
        if jax.process_index() > 0:
            return
        if updates % config.checkpoint.every == 0 or updates == config.num_updates:
            about = {"robot": robot.name, "env_steps": int(row["env_steps"])}
            weights = run_dir / f"{skill}.safetensors"
            network.form().networks.save(state.params["policy"], weights, about, half=True)

    return train(VectorEnv(env, config.num_envs), config, run_dir, resume, on_update=save)
