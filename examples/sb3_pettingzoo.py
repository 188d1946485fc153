"""Trains Climb on Seesaw with Stable-Baselines3's PPO, one policy for all agents.

    pip install -e '.[pettingzoo]' stable-baselines3 supersuit
    python examples/sb3_pettingzoo.py --csv sb3.csv

PettingZoo and SuperSuit connect them. SuperSuit steps environments sequentially: the example
demonstrates compatibility, not speed.
"""

import argparse
import csv
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from mqe_jax.adapters import pettingzoo

NUM_ENVS = 8
ROLLOUT = 256
COLUMNS = {"return": "r", "episode_length": "l"}
"""Columns of the curve and their names in Stable-Baselines3's records of episodes."""


def vectorised(task: str, **settings: Any) -> Any:
    """Returns agents of several environments as one vector environment of Stable-Baselines3.

    It normalises observations.
    """
    # Imported by name: neither library is an extra of mqe-jax.
    supersuit: Any = import_module("supersuit")
    wrappers: Any = import_module("stable_baselines3.common.vec_env")
    env = supersuit.pettingzoo_env_to_vec_env_v1(pettingzoo.parallel_env(task, **settings))
    env = supersuit.concat_vec_envs_v1(env, NUM_ENVS, num_cpus=0, base_class="stable_baselines3")
    return wrappers.VecNormalize(wrappers.VecMonitor(env))


def train(env: Any, steps: int, rollout: int = ROLLOUT) -> list[dict[str, Any]]:
    """Trains and returns a row of each update.

    Its columns are environment steps, and return and length of the agents' last 100 episodes.

    Args:
        env: of `vectorised`.
        steps: environment steps.
        rollout: steps of each environment between updates.
    """
    ppo: Any = import_module("stable_baselines3").PPO
    # PPO's argument `seed` would call a method that SuperSuit's environments lack.
    import_module("stable_baselines3.common.utils").set_random_seed(0)
    settings: dict[str, Any] = {"batch_size": rollout * 2, "n_epochs": 4, "learning_rate": 1e-3}
    policy = {"log_std_init": -0.7}
    model = ppo("MlpPolicy", env, n_steps=rollout, policy_kwargs=policy, device="cpu", **settings)
    rows = []
    agents = env.num_envs // NUM_ENVS
    while model.num_timesteps < steps * agents:
        model.learn(rollout * env.num_envs, reset_num_timesteps=False)
        episodes = model.ep_info_buffer
        if episodes:
            row: dict[str, Any] = {"env_steps": model.num_timesteps // agents}
            for name, key in COLUMNS.items():
                row[name] = round(float(np.mean([episode[key] for episode in episodes])), 3)
            rows.append(row)
            print(row, flush=True)
    return rows


def main() -> None:
    """Runs the example."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--task", default="go1seesaw")
    parser.add_argument("--steps", type=int, default=60_000)
    parser.add_argument("--csv", type=Path)
    arguments = parser.parse_args()
    rows = train(vectorised(arguments.task), arguments.steps)
    if arguments.csv is not None and rows:
        with arguments.csv.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
