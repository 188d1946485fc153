"""Trains Narrow Gate with IPPO through the JaxMARL adapter; writes and plots the returns of its episodes.

    python examples/jaxmarl_ippo.py --csv ippo.csv --png ippo.png
    python examples/jaxmarl_ippo.py --jaxmarl ~/JaxMARL     # JaxMARL's own baselines/IPPO/ippo_ff_mabrax.py

needs `pip install 'mqe-jax[jaxmarl]'`. JaxMARL's wheel ships no baselines, so its own IPPO needs a checkout (and the
packages that the baseline imports: `pip install 'jaxmarl[algs]'`). Without one, the IPPO below trains: one policy
for all agents, clipped PPO, on JaxMARL's `LogWrapper`.
"""

import argparse
import csv
import functools
import importlib.util
import sys
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.adapters.jaxmarl import Env
from mqe_jax.train import nn
from mqe_jax.train.advantage import gae
from mqe_jax.train.optim import adam

# Names and meaning as in JaxMARL's baselines/IPPO/config/ippo_ff_mabrax.yaml.
CONFIG: dict[str, Any] = {
    "LR": 5e-4,
    "NUM_ENVS": 64,
    "NUM_STEPS": 100,
    "TOTAL_TIMESTEPS": 800_000,
    "UPDATE_EPOCHS": 4,
    "NUM_MINIBATCHES": 8,
    "GAMMA": 0.99,
    "GAE_LAMBDA": 0.95,
    "CLIP_EPS": 0.2,
    "ENT_COEF": 1e-3,
    "VF_COEF": 0.5,
    "MAX_GRAD_NORM": 1.0,
    "ACTIVATION": "tanh",
    "ANNEAL_LR": True,
    "SEED": 0,
}
# Reward scale, so that the critic's gradients do not dominate those of the policy.
REWARD_SCALE = 0.1
HIDDEN = (64, 64)
# In training the approach reward has a larger weight, as in configs/demo.yaml.
TRAINING_REWARDS = {"approach": 10.0}
COLUMNS = ("env_steps", "return", "episode_length")


class Batch(NamedTuple):
    """Transitions of all agents (T, A * N, ...)."""

    obs: jax.Array
    action: jax.Array
    log_prob: jax.Array
    value: jax.Array
    next_value: jax.Array
    reward: jax.Array
    done: jax.Array
    truncated: jax.Array


def log_prob(params: Any, obs: jax.Array, action: jax.Array) -> jax.Array:
    """Returns the log-probability of actions under the policy."""
    z = (action - nn.mlp(params["actor"], obs, jnp.tanh)) / jnp.exp(params["log_std"])
    return jnp.sum(-0.5 * z**2 - params["log_std"] - 0.5 * jnp.log(2 * jnp.pi), axis=-1)


def value_of(params: Any, obs: jax.Array) -> jax.Array:
    """Returns the critic's value of observations (..., O)."""
    return nn.mlp(params["critic"], obs, jnp.tanh)[..., 0]


def make_train(config: dict[str, Any], env: Env):
    """Returns `train(key)`, which returns a table (updates, 3): environment steps, mean return and length."""
    from jaxmarl.wrappers.baselines import LogWrapper

    wrapped, agents, count = LogWrapper(env), env.agents, config["NUM_ENVS"]
    steps, actors = config["NUM_STEPS"], len(agents) * count
    updates = config["TOTAL_TIMESTEPS"] // steps // count
    size, width = env.env.action_size, env.env.observation_size
    optimizer = adam(max_grad_norm=config["MAX_GRAD_NORM"])

    def stack(values: Any) -> jax.Array:
        """Stacks a mapping from agents to (N, ...) to (A * N, ...)."""
        return jnp.stack([values[a] for a in agents]).reshape(actors, *values[agents[0]].shape[1:])

    def per_agent(values: jax.Array) -> jax.Array:
        """Moves agents (N, A, ...) to the front: (A * N, ...)."""
        return jnp.swapaxes(values, 0, 1).reshape(actors, *values.shape[2:])

    def loss(params: Any, batch: Batch, advantage: jax.Array, target: jax.Array) -> jax.Array:
        ratio = jnp.exp(log_prob(params, batch.obs, batch.action) - batch.log_prob)
        clipped = jnp.clip(ratio, 1 - config["CLIP_EPS"], 1 + config["CLIP_EPS"])
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        policy_loss = -jnp.minimum(ratio * advantage, clipped * advantage).mean()
        value_loss = jnp.mean((value_of(params, batch.obs) - target) ** 2)
        return policy_loss + config["VF_COEF"] * value_loss - config["ENT_COEF"] * jnp.sum(params["log_std"])

    def act(params: Any, carry: Any, key: jax.Array) -> tuple[Any, Any]:
        state, obs = carry
        action_key, step_key = jax.random.split(key)
        mean = nn.mlp(params["actor"], obs, jnp.tanh)
        action = mean + jnp.exp(params["log_std"]) * jax.random.normal(action_key, mean.shape)
        actions = dict(zip(agents, action.reshape(len(agents), count, size), strict=True))
        after, state, reward, done, info = jax.vmap(wrapped.step)(jax.random.split(step_key, count), state, actions)
        batch = Batch(
            obs=obs,
            action=action,
            log_prob=log_prob(params, obs, action),
            value=value_of(params, obs),
            # The observation before an automatic reset, so that a truncated episode bootstraps from its last state.
            next_value=value_of(params, per_agent(state.env_state.final_obs)),
            reward=REWARD_SCALE * stack(reward),
            done=stack(done),
            truncated=per_agent(info["truncation"]) > 0,
        )
        over = done["__all__"]
        ended = [info[f"returned_episode_{name}"].mean(-1) * over for name in ("returns", "lengths")]
        return (state, stack(after)), (batch, jnp.stack([over.sum(), *(x.sum() for x in ended)]))

    def update(carry: Any, index: jax.Array) -> tuple[Any, jax.Array]:
        params, moments, state, obs, key = carry
        key, act_key, *shuffle_keys = jax.random.split(key, 2 + config["UPDATE_EPOCHS"])
        keys = jax.random.split(act_key, steps)
        (state, obs), (batch, counts) = jax.lax.scan(functools.partial(act, params), (state, obs), keys)
        advantage, target = gae(
            batch.reward,
            batch.value,
            batch.next_value,
            batch.done & ~batch.truncated,
            batch.done,
            gamma=config["GAMMA"],
            gae_lambda=config["GAE_LAMBDA"],
        )
        rate = config["LR"] * (1 - index / updates if config["ANNEAL_LR"] else 1.0)

        def descend(carry: Any, part: Any) -> tuple[Any, None]:
            params, moments, _ = optimizer.update(jax.grad(loss)(carry[0], *part), carry[1], carry[0], rate)
            return (params, moments), None

        flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), (batch, advantage, target))
        for shuffle_key in shuffle_keys:
            order = jax.random.permutation(shuffle_key, steps * actors).reshape(config["NUM_MINIBATCHES"], -1)
            parts = jax.tree.map(lambda x, order=order: x[order], flat)
            (params, moments), _ = jax.lax.scan(descend, (params, moments), parts)
        ended, returns, lengths = counts.sum(0)
        row = jnp.stack([(index + 1) * steps * count, returns / ended, lengths / ended])
        jax.debug.print("{steps:.0f} steps: return {gain:.3f}", steps=row[0], gain=row[1])
        return (params, moments, state, obs, key), row

    def train(key: jax.Array) -> jax.Array:
        actor_key, critic_key, reset_key, key = jax.random.split(key, 4)
        params = {
            "actor": nn.mlp_init(actor_key, (width, *HIDDEN, size), final_scale=0.01),
            "critic": nn.mlp_init(critic_key, (width, *HIDDEN, 1)),
            "log_std": jnp.full(size, -0.5),
        }
        obs, state = jax.vmap(wrapped.reset)(jax.random.split(reset_key, count))
        carry = (params, optimizer.init(params), state, stack(obs), key)
        return jax.lax.scan(update, carry, jnp.arange(updates))[1]

    return train


def own_ippo(config: dict[str, Any], env: Env) -> np.ndarray:
    """Trains with the IPPO of this file; returns rows of `COLUMNS`."""
    return np.asarray(jax.jit(make_train(config, env))(jax.random.PRNGKey(config["SEED"])))


def baseline_ippo(checkout: Path, config: dict[str, Any], env: Env) -> np.ndarray:
    """Trains with the IPPO of a JaxMARL checkout, in which this environment is registered as 'mqe'."""
    import jaxmarl

    path = checkout / "baselines" / "IPPO" / "ippo_ff_mabrax.py"
    if not path.is_file():
        raise SystemExit(f"--jaxmarl: {path} does not exist")
    spec = importlib.util.spec_from_file_location("ippo_ff_mabrax", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    jaxmarl.make = lambda name, **_: env
    module.wandb.init(mode="disabled")
    key, init_key = jax.random.split(jax.random.PRNGKey(config["SEED"]))
    settings = {**config, "ENV_NAME": "mqe", "ENV_KWARGS": {}}
    settings |= {"ACTOR_ARCH": list(HIDDEN), "CRITIC_ARCH": list(HIDDEN)}
    needs_key = module.make_train.__code__.co_argcount > 1
    train = module.make_train(settings, init_key) if needs_key else module.make_train(settings)
    metrics = jax.jit(train)(key)["metrics"]
    returns, lengths = (np.asarray(metrics[f"returned_episode_{name}"]) for name in ("returns", "lengths"))
    returns, lengths = (x.reshape(len(x), -1).mean(-1) for x in (returns, lengths))
    steps = (1 + np.arange(len(returns))) * config["NUM_STEPS"] * config["NUM_ENVS"]
    return np.stack([steps, returns, lengths], axis=1)


def plot(rows: np.ndarray, path: Path, title: str) -> None:
    """Plots the returns over the environment steps."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5, 3), dpi=90, layout="constrained")
    axes = figure.add_subplot()
    axes.plot(rows[:, 0] / 1000, rows[:, 1], color="#2a5fa5")
    axes.set(xlabel="environment steps, thousands", ylabel="mean return of an agent's episodes", title=title)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def main() -> None:
    """Runs the example."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--task", default="go1gate")
    parser.add_argument("--jaxmarl", type=Path, metavar="CHECKOUT", help="train with the IPPO of this checkout")
    parser.add_argument("--steps", type=int, default=CONFIG["TOTAL_TIMESTEPS"])
    parser.add_argument("--seed", type=int, default=CONFIG["SEED"])
    parser.add_argument("--csv", type=Path)
    parser.add_argument("--png", type=Path)
    arguments = parser.parse_args()
    config = {**CONFIG, "TOTAL_TIMESTEPS": arguments.steps, "SEED": arguments.seed}
    shaping = {"rewards": TRAINING_REWARDS} if arguments.task == "go1gate" else {}
    env = Env(arguments.task, **shaping)
    if arguments.jaxmarl is not None:
        rows = baseline_ippo(arguments.jaxmarl, config, env)
    else:
        print("no --jaxmarl CHECKOUT: training with the IPPO of this example", file=sys.stderr)
        rows = own_ippo(config, env)
    rows = rows[np.isfinite(rows).all(1)]  # no episode may have ended in the first updates
    if arguments.csv is not None:
        arguments.csv.parent.mkdir(parents=True, exist_ok=True)
        with arguments.csv.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(COLUMNS)
            writer.writerows([int(step), round(float(gain), 4), round(float(length), 1)] for step, gain, length in rows)
    if arguments.png is not None:
        name = "JaxMARL's IPPO" if arguments.jaxmarl else "IPPO on JaxMARL's wrappers"
        plot(rows, arguments.png, f"{arguments.task}, {name}")


if __name__ == "__main__":
    main()
