"""Your own algorithm: IPPO in a loop over `reset` and `step`, without the package's trainer.

`python examples/own_ippo.py` teaches two robots to walk ahead; a minute on two CPU cores.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

import mqe_jax
from mqe_jax.train.optim import adam

DISCOUNT = 0.98
LAMBDA = 0.95
CLIP = 0.2
LEARNING_RATE = 1e-3
EPOCHS = 4
MINIBATCHES = 4
OPTIMIZER = adam(max_grad_norm=0.5)


class Steps(NamedTuple):
    """Steps of N environments of A agents, leading axes (T, N, A)."""

    obs: jax.Array
    action: jax.Array  # as sampled; the environment clips it to [-1, 1]
    log_prob: jax.Array
    reward: jax.Array
    value: jax.Array
    next_value: jax.Array  # of the state that the step reached, before a reset; 0 if terminated
    done: jax.Array  # terminated, or truncated by the time limit


def init(key: jax.Array, *widths: int) -> Any:
    """Returns the parameters of a network, from the widths of its layers; the last is D + 1."""
    pairs = zip(jax.random.split(key, len(widths)), widths, widths[1:], strict=False)
    layers = [(jax.random.normal(k, (i, o)) / i**0.5, jnp.zeros(o)) for k, i, o in pairs]
    return {"layers": layers, "log_std": jnp.full(widths[-1] - 1, -0.5)}


def network(params: Any, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the mean action (..., D) and the value (...); all agents share the network."""
    for weights, bias in params["layers"][:-1]:
        x = jnp.tanh(x @ weights + bias)
    weights, bias = params["layers"][-1]
    out = 0.1 * (x @ weights) + bias
    return out[..., :-1], out[..., -1]


def log_prob(params: Any, mean: jax.Array, action: jax.Array) -> jax.Array:
    """Returns the log-probabilities (...) of actions (..., D)."""
    return jax.scipy.stats.norm.logpdf(action, mean, jnp.exp(params["log_std"])).sum(-1)


def collect(env: Any, params: Any, state: Any, keys: jax.Array) -> tuple[Any, Steps]:
    """Steps all environments, which reset themselves, once for each random key."""

    def step(state: Any, key: jax.Array) -> tuple[Any, Steps]:
        mean, value = network(params, state.obs)
        action = mean + jnp.exp(params["log_std"]) * jax.random.normal(key, mean.shape)
        after = env.step(state, action)
        next_value = jnp.where(after.terminated[:, None], 0.0, network(params, after.final_obs)[1])
        done = jnp.broadcast_to((after.terminated | after.truncated)[:, None], value.shape)
        chance = log_prob(params, mean, action)
        return after, Steps(state.obs, action, chance, after.reward, value, next_value, done)

    return jax.lax.scan(step, state, keys)


def advantages(steps: Steps) -> jax.Array:
    """Returns generalised advantages (T, N, A)."""
    error = steps.reward + DISCOUNT * steps.next_value - steps.value

    def back(later: jax.Array, now: Any) -> tuple[jax.Array, jax.Array]:
        found = now[0] + DISCOUNT * LAMBDA * jnp.where(now[1], 0.0, later)
        return found, found

    return jax.lax.scan(back, jnp.zeros_like(error[0]), (error, steps.done), reverse=True)[1]


def loss(params: Any, batch: tuple[Steps, jax.Array]) -> jax.Array:
    """Returns the clipped loss of rows (B, ...) of steps and their advantages."""
    steps, advantage = batch
    mean, value = network(params, steps.obs)
    ratio = jnp.exp(log_prob(params, mean, steps.action) - steps.log_prob)
    scaled = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    gain = jnp.minimum(ratio * scaled, jnp.clip(ratio, 1 - CLIP, 1 + CLIP) * scaled)
    return jnp.mean((value - steps.value - advantage) ** 2) - jnp.mean(gain)


def main(updates: int = 30, num_envs: int = 64, rollout: int = 64) -> list[float]:
    """Trains; returns the reward of a step and an agent in each update."""
    env = mqe_jax.VectorEnv(mqe_jax.make("go1plane", episode_length=4.0), num_envs)
    key, reset_key, init_key = jax.random.split(jax.random.PRNGKey(0), 3)
    params = init(init_key, env.observation_size, 64, 64, env.action_size + 1)

    def update(carry: Any, key: jax.Array) -> tuple[Any, jax.Array]:
        learned, state = carry
        act_key, *epoch_keys = jax.random.split(key, EPOCHS + 1)
        state, steps = collect(env, learned[0], state, jax.random.split(act_key, rollout))
        rows = jax.tree.map(lambda x: x.reshape(-1, *x.shape[3:]), (steps, advantages(steps)))

        def improve(learned: Any, chosen: jax.Array) -> tuple[Any, None]:
            grads = jax.grad(loss)(learned[0], jax.tree.map(lambda x: x[chosen], rows))
            return OPTIMIZER.update(grads, learned[1], learned[0], LEARNING_RATE)[:2], None

        orders = [jax.random.permutation(k, len(rows[1])) for k in epoch_keys]
        batches = jnp.concatenate(orders).reshape(EPOCHS * MINIBATCHES, -1)
        learned, _ = jax.lax.scan(improve, learned, batches)
        return (learned, state), steps.reward.mean()

    start = (params, OPTIMIZER.init(params)), jax.jit(env.reset)(reset_key)
    rewards = jax.lax.scan(update, start, jax.random.split(key, updates))[1].tolist()
    print(f"reward of a step: {rewards[0]:.4f} before, {rewards[-1]:.4f} after {updates} updates")
    return rewards


if __name__ == "__main__":
    main()
