"""Trains Climb on Seesaw with Brax's own PPO through the Brax adapter.

    python examples/brax_ppo.py --csv brax_ppo.csv

prints and writes the evaluations. It needs `pip install -e '.[brax]'`, in the repository's folder.
"""

import argparse
import csv
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

# First, as it hides MJX's note about a missing Warp.
from mqe_jax.adapters.brax import Env, wrap

# isort: split
from brax.training.agents.ppo import networks as ppo_networks
from brax.training.agents.ppo import train as ppo

NUM_ENVS = 64
EVAL_ENVS = 64


def train(
    env: Env,
    eval_env: Env,
    seed: int,
    steps: int,
    evaluations: int,
    num_envs: int = NUM_ENVS,
    eval_envs: int = EVAL_ENVS,
) -> list[dict[str, float]]:
    """Trains once and returns a row of each evaluation.

    Its columns are seed, environment steps, mean and standard error of the return, and length.
    """
    rows = []

    def evaluated(env_steps: int, metrics: Mapping[str, Any]) -> None:
        spread = float(metrics["eval/episode_reward_std"]) / eval_envs**0.5
        row = {
            "seed": seed,
            "env_steps": int(env_steps),
            "return": round(float(metrics["eval/episode_reward"]), 4),
            "return_standard_error": round(spread, 4),
            "episode_length": round(float(metrics["eval/avg_episode_length"]), 1),
        }
        print(row, flush=True)
        rows.append(row)

    networks = functools.partial(
        ppo_networks.make_ppo_networks,
        policy_hidden_layer_sizes=(64, 64),
        value_hidden_layer_sizes=(64, 64),
    )
    ppo.train(
        environment=env,
        eval_env=eval_env,
        num_timesteps=steps,
        wrap_env_fn=wrap,
        episode_length=env.episode_length,
        num_envs=num_envs,
        num_eval_envs=eval_envs,
        num_evals=evaluations,
        batch_size=num_envs,
        num_minibatches=4,
        num_updates_per_batch=4,
        unroll_length=20,
        learning_rate=5e-4,
        entropy_cost=3e-3,
        discounting=0.99,
        normalize_observations=True,
        max_grad_norm=1.0,
        network_factory=networks,
        progress_fn=evaluated,
        seed=seed,
    )
    return rows


def main() -> None:
    """Runs the example."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--task", default="go1seesaw")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--steps", type=int, default=400_000)
    parser.add_argument("--evaluations", type=int, default=6)
    parser.add_argument("--csv", type=Path)
    arguments = parser.parse_args()
    env = Env(arguments.task)
    rows = []
    for seed in arguments.seeds:
        rows += train(env, env, seed, arguments.steps, arguments.evaluations)
        if arguments.csv is not None:
            arguments.csv.parent.mkdir(parents=True, exist_ok=True)
            with arguments.csv.open("w", encoding="utf-8", newline="") as file:
                writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
                writer.writeheader()
                writer.writerows(rows)


if __name__ == "__main__":
    main()
