"""Trains Narrow Gate with Stable-Baselines3's PPO, one policy for all agents, through PettingZoo and SuperSuit.

    pip install 'mqe-jax[pettingzoo]' stable-baselines3 supersuit
    python examples/sb3_pettingzoo.py --csv sb3.csv

Evaluates the returns of agents on the unmodified task during training. SuperSuit steps environments sequentially: the
example demonstrates compatibility, not speed.
"""

import argparse
import csv
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from mqe_jax.adapters import pettingzoo

AGENTS, NUM_ENVS, EPISODES, EVALUATIONS = 2, 8, 32, 6
# In training the approach reward has a larger weight, as in configs/demo.yaml.
TRAINING_REWARDS = {"approach": 10.0}


def vectorised(task: str, **settings: Any) -> Any:
    """Returns agents of several environments as one Stable-Baselines3 vector environment, observations normalised."""
    # Imported by name: neither library is an extra of mqe-jax.
    supersuit: Any = import_module("supersuit")
    wrappers: Any = import_module("stable_baselines3.common.vec_env")
    env = supersuit.pettingzoo_env_to_vec_env_v1(pettingzoo.parallel_env(task, **settings))
    env = supersuit.concat_vec_envs_v1(env, NUM_ENVS, num_cpus=0, base_class="stable_baselines3")
    return wrappers.VecNormalize(wrappers.VecMonitor(env))


def main() -> None:
    """Runs the example."""
    ppo: Any = import_module("stable_baselines3").PPO
    evaluate: Any = import_module("stable_baselines3.common.evaluation").evaluate_policy
    # PPO's argument `seed` would call a method that SuperSuit's environments lack.
    import_module("stable_baselines3.common.utils").set_random_seed(0)
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--steps", type=int, default=100_000, help="steps of agents")
    parser.add_argument("--csv", type=Path)
    arguments = parser.parse_args()
    env, eval_env = vectorised("go1gate", rewards=TRAINING_REWARDS), vectorised("go1gate")
    eval_env.training, eval_env.norm_reward, eval_env.obs_rms = False, False, env.obs_rms
    policy = {"log_std_init": -0.7}
    model = ppo(
        "MlpPolicy",
        env,
        n_steps=256,
        batch_size=512,
        n_epochs=4,
        learning_rate=1e-3,
        policy_kwargs=policy,
        device="cpu",
    )
    rows = []
    for number in range(EVALUATIONS + 1):
        if number:
            model.learn(arguments.steps // EVALUATIONS, reset_num_timesteps=False)
        returns, lengths = evaluate(
            model, eval_env, n_eval_episodes=AGENTS * EPISODES, deterministic=False, return_episode_rewards=True
        )
        # Agents of one environment have equal rewards and come one after the other: an episode counts once.
        returns = np.reshape(returns, (-1, AGENTS)).mean(axis=1)
        rows.append(
            {
                "agent_steps": model.num_timesteps,
                "return": round(float(np.mean(returns)), 4),
                "return_standard_error": round(float(np.std(returns, ddof=1) / len(returns) ** 0.5), 4),
                "episode_length": round(float(np.mean(lengths)), 1),
            }
        )
        print(rows[-1], flush=True)
        write(arguments.csv, rows)


def write(path: Path | None, rows: list[dict[str, Any]]) -> None:
    """Writes the rows to a CSV file, where there is a path."""
    if path is None:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
