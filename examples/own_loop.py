"""Your own training loop: three seeds as one program under `jax.vmap`, without files and logs.

`python examples/own_loop.py` prints each seed's reward after every update; two minutes on a CPU.
"""

import jax

import mqe_jax


def main(seeds: int = 3, updates: int = 10, **settings: object) -> list[list[float]]:
    """Trains, and returns the average step reward of each seed after every update."""
    init, update = mqe_jax.make_learner("go1gate", {"config": "demo", **settings}, seeds=seeds)
    states = jax.jit(jax.vmap(init))(jax.random.split(jax.random.PRNGKey(0), seeds))
    step = jax.jit(jax.vmap(update))
    rewards = []
    for _ in range(updates):
        states, metrics = step(states)
        rewards.append(metrics["average_step_reward"].tolist())
    return rewards


if __name__ == "__main__":
    for number, reward in enumerate(main(), start=1):
        print(f"update {number}: " + ", ".join(f"{value:+.4f}" for value in reward))
