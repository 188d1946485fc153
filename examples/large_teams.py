"""Football, four against four, on a CPU: one policy for four robots learns from the scripted team.

`python examples/large_teams.py` prints how often the new team beats robots that stand; a few
minutes on a CPU.
"""

import mqe_jax

TASK = "go1football-1vs1"
SIZES = {"num_agents": 8}
SETTINGS = {
    "num_envs": 64,
    "rollout_steps": 32,
    "total_steps": 160_000,
    "opponents": ["idle"],
    "curriculum": {"assistance_until": 0.7},
    "imitation": {"teacher": "scripted", "weight": 30.0, "until": 1.0},
    "ppo": {"epochs": 8, "minibatches": 4},
    "optimizer": {"learning_rate": 2e-3},
    "network": {"hidden_sizes": [128, 64], "log_std_init": -1.2, "log_std_min": -1.6},
}

if __name__ == "__main__":
    run = mqe_jax.learn(TASK, SETTINGS, env=SIZES)
    print(mqe_jax.evaluate(TASK, run.policy, "idle", env=SIZES, episodes=128, deterministic=True))
