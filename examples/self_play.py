"""Self-play: trains Sumo Wrestling against its own frozen snapshot and a scripted opponent.

`python examples/self_play.py` prints the results against both, after a minute or two on a CPU.
41,000 steps teach little: `mqe train go1wrestling` takes 150 million.
"""

from __future__ import annotations

import dataclasses

import jax
import numpy as np

from mqe_jax import VectorEnv, load_policy, make, versus
from mqe_jax.core.settings import build
from mqe_jax.selfplay.league.tournament import play
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.learner import make_learner
from mqe_jax.train.policy import policy_of


def main(num_envs: int = 32, updates: int = 20, snapshot_every: int = 5) -> np.ndarray:
    """Trains, and returns wins, draws and losses (2, 3).

    They are against the last snapshot and against the scripted policy.
    """
    settings = {
        "num_envs": num_envs,
        "rollout_steps": 64,
        "total_steps": updates * num_envs * 64,
        "stagger_episodes": True,
        "ppo": {"epochs": 4},
        "network": {"recurrent": False, "hidden_sizes": [64, 64]},
    }
    config = build(TrainConfig, settings)
    rewards = {"push": 3.0, "approach": 1.0}
    matches = VectorEnv(make("go1wrestling", rewards=rewards, num_envs=num_envs), num_envs)

    # The first snapshot is untrained: these matches give the sizes of the policy.
    one_team = versus(matches, ["idle"])
    learner = make_learner(one_team, config)
    state = jax.jit(learner.init)(jax.random.PRNGKey(0))
    snapshot = policy_of(state, one_team, config)

    env = versus(matches, [snapshot, "scripted"])  # half of the environments each
    learner = make_learner(env, config)
    state = jax.jit(learner.init)(jax.random.PRNGKey(0))
    update = jax.jit(learner.update)
    for i in range(updates):
        if i % snapshot_every == 0:
            snapshot = policy_of(state, env, config)
            env_state = env.change(state.rollout.env_state, 0, snapshot)  # when their episodes end
            state = dataclasses.replace(state, rollout=state.rollout._replace(env_state=env_state))
        state, metrics = update(state)
        print(f"update {i + 1}: average step reward {float(metrics['average_step_reward']):.4f}")

    opponents = (snapshot, load_policy("scripted", matches.env))
    return play(matches, policy_of(state, env, config), opponents, jax.random.PRNGKey(1))


if __name__ == "__main__":
    for name, outcomes in zip(("snapshot", "scripted"), main().tolist(), strict=True):
        print(f"against {name}: {outcomes[0]} wins, {outcomes[1]} draws, {outcomes[2]} losses")
