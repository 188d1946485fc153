"""Behaviour cloning: learns a policy from a data set of episodes.

`python examples/clone.py` records the shipped team of Narrow Gate, clones it and evaluates the
clone; a minute on a CPU. It needs the extra `record`.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import minari
import numpy as np

import mqe_jax
from mqe_jax.acting.results import Result
from mqe_jax.train.optim import adam

SIZES = (128, 128)  # of the hidden layers
BATCH = 1024
LEARNING_RATE = 1e-3


def read(folder: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns observations (S, O) and actions (S, D) of all agents in all episodes."""
    episodes = list(minari.MinariDataset(Path(folder, "data")))
    seen = np.concatenate([episode.observations["policy"][:-1] for episode in episodes])
    actions = np.concatenate([episode.actions for episode in episodes])
    return seen.reshape(-1, seen.shape[-1]), actions.reshape(-1, actions.shape[-1])


def act(layers: list[dict[str, jax.Array]], x: Any) -> jax.Array:
    """Returns the network's actions (..., D) for observations (..., O)."""
    for layer in layers[:-1]:
        x = jax.nn.elu(x @ layer["weights"] + layer["bias"])
    return jnp.tanh(x @ layers[-1]["weights"] + layers[-1]["bias"])


def clone(seen: np.ndarray, actions: np.ndarray, steps: int, seed: int = 0) -> Any:
    """Returns a function (..., O) -> (..., D) that imitates the actions by least squares."""
    mean, deviation = seen.mean(0), seen.std(0) + 1e-3
    key, *keys = jax.random.split(jax.random.PRNGKey(seed), len(SIZES) + 2)
    widths = zip((seen.shape[1], *SIZES), (*SIZES, actions.shape[1]), keys, strict=True)
    layers = [
        {"weights": jax.random.normal(k, (i, o)) / i**0.5, "bias": jnp.zeros(o)}
        for i, o, k in widths
    ]
    optimizer = adam()
    data = jnp.asarray((seen - mean) / deviation), jnp.asarray(actions)

    def loss(layers: Any, rows: jax.Array) -> jax.Array:
        return jnp.mean((act(layers, data[0][rows]) - data[1][rows]) ** 2)

    def step(carry: Any, inputs: Any) -> Any:
        number, key = inputs
        rows = jax.random.randint(key, (BATCH,), 0, len(seen))
        error, grads = jax.value_and_grad(loss)(carry[0], rows)
        rate = LEARNING_RATE * (1 - number / steps)
        return optimizer.update(grads, carry[1], carry[0], rate)[:2], error

    inputs = jnp.arange(steps), jax.random.split(key, steps)
    (layers, _), errors = jax.jit(lambda c: jax.lax.scan(step, c, inputs))(
        (layers, optimizer.init(layers))
    )
    print(f"{len(seen):,} actions, mean squared error {float(errors[-100:].mean()):.4f}")
    return lambda obs: act(layers, (obs - mean) / deviation)


def main(
    folder: str = "runs/clone/gate-v0",
    episodes: int = 256,
    steps: int = 10_000,
    evaluated: int = 256,
) -> Result:
    """Records a data set, if it is missing; clones its policy; returns the clone's evaluation."""
    if not Path(folder).exists():
        mqe_jax.record("go1gate", folder=folder, episodes=episodes)
    policy = clone(*read(folder), steps)
    return mqe_jax.evaluate(
        "go1gate", lambda obs, memory, key: (policy(obs), memory), episodes=evaluated
    )


if __name__ == "__main__":
    print(main())
