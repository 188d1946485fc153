"""Training of skills by `mqe_jax.train`.

Settings are those of walk-these-ways (arXiv 2212.03238) where known.
"""

import dataclasses
from pathlib import Path

import jax
import numpy as np

from mqe_jax.core.errors import warn
from mqe_jax.core.settings import checked, fail, override, to_mapping
from mqe_jax.envs.autoreset import VectorEnv
from mqe_jax.physics import robots
from mqe_jax.physics.robots.quadruped import MIRROR
from mqe_jax.train.config import (
    PPO,
    Checkpointing,
    Curriculum,
    Normalization,
    OptimizerSettings,
    TrainConfig,
)
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
        learning_rate=1e-3,
        schedule="linear",
        anneal=0.3,
        target_kl=0.01,
        eps=1e-8,
        max_grad_norm=1.0,
    ),
    network=WalkNetwork(),
    curriculum=Curriculum(assistance=1.0, assistance_until=0.3),
    normalization=Normalization(values=False),
    checkpoint=Checkpointing(every=100, environments=False),
    loggers=(),
)
"""Settings for training walk weights from scratch.

The assistance is the curriculum of slopes, forces and pushes.
"""

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
"""Settings for training the agile skill from scratch.

The assistance is the curriculum of commands and disturbances.
"""

AGILE_TASK = WalkTask(
    start=0.5, tolerance=2.0, command_period=4.0, slope=0.15, shove=100.0, action_lag=1
)
"""The walking task of the agile skill: fast commands, gentle slopes.

Its shoves are as those of robots and boxes.
"""

SETTINGS: dict[str, tuple[TrainConfig, WalkTask]] = {
    "walk": (WALK, WalkTask()),
    "agile": (AGILE, AGILE_TASK),
    "climb": (override(AGILE, {"task": "climb"}), dataclasses.replace(AGILE_TASK, slope=0.3)),
}
"""Settings and task of each skill that can be trained."""


@checked
def train_skill(
    skill: str,
    run_dir: str | Path,
    config: TrainConfig | None = None,
    task: WalkTask | None = None,
    *,
    robot: str = "go1",
    weights: str | Path | None = None,
    impl: str = "auto",
    resume: bool = False,
) -> TrainState:
    """Trains a skill's weights, as `mqe skill train`, and returns the learner's last state.

    Example:
        ```python
        mqe_jax.train_skill("agile", "runs/agile", robot="go2")
        ```

    Args:
        skill: one of `SETTINGS`.
        run_dir: run folder; every checkpoint writes SKILL.safetensors (float16) into it.
        config: settings. Default: those of `SETTINGS`.
        task: parameters of the walking task. Default: those of `SETTINGS`.
        robot: name or file of the robot.
        weights: weights to start from; may be those of another robot. Default: from scratch.
        impl: physics engine: 'auto', 'jax', 'warp' or 'c'.
        resume: whether to continue from the newest checkpoint in the folder, with environments
            reset.

    Raises:
        InputError: for a skill, settings, weights or a run folder that are not allowed.
        NonFiniteError: as `mqe_jax.learn`.
    """
    if skill not in SETTINGS:
        fail("skill", skill, " or ".join(SETTINGS))
    default_config, default_task = SETTINGS[skill]
    body = robots.get(robot)
    run_dir = Path(run_dir)
    config = config or default_config
    if config.opponents:
        fail("opponents", list(config.opponents), "empty: walking is not a match")
    network = config.network
    if not isinstance(network, HistorySettings):
        fail("network.name", network.name, default_config.network.name)
    if weights is not None:
        network.form.networks.load(body, weights, warns=False)
        config = override(config, {"network.weights": str(Path(weights).resolve())})
    if not np.array_equal(body.mirror.source, MIRROR.source):
        warn("network.symmetry_coef: it is 0, since left and right legs of the robot differ")
        config = override(config, {"network.symmetry_coef": 0.0})
    elif not np.array_equal(body.mirror.sign, MIRROR.sign):
        signs = [int(sign) for sign in body.mirror.sign]
        config = override(config, {"network.mirror_signs": signs})
    env = WalkEnv(body, task or default_task, skill=skill, impl=impl, num_envs=config.num_envs)
    config = override(config, {"env": {"control": env.control, **to_mapping(env.params)}})

    def save(state: TrainState, row: dict[str, float]) -> None:
        if jax.process_index() > 0:
            return
        updates = int(row["updates"])
        if updates % config.checkpoint.every == 0 or updates == config.num_updates:
            about = {"robot": body.identity, "env_steps": int(row["env_steps"])}
            file = run_dir / f"{skill}.safetensors"
            network.form.networks.save(state.params["policy"], file, about, half=True)

    return train(VectorEnv(env, config.num_envs), config, run_dir, resume, on_update=save)
