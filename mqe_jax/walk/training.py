"""Training of the walk policy: PPO with a 30-step history, as in walk-these-ways (arXiv 2212.03238).

The rollout stores single observations (70 numbers); the 30-step windows (2100 numbers) are gathered for each minibatch,
which saves a factor of 30 in memory. The adaptation network is trained by regression on the latent target; the policy
receives its output without gradient.
"""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import jax
import jax.numpy as jnp

from mqe_jax import interrupts
from mqe_jax.errors import InputError
from mqe_jax.robots.robot import NUM_JOINTS, Robot
from mqe_jax.skills import walk_policy
from mqe_jax.skills.walk_policy import HISTORY, OBSERVATION_SIZE
from mqe_jax.train import checkpoint, nn
from mqe_jax.train.advantage import gae
from mqe_jax.train.logs import CsvLog
from mqe_jax.train.loss import clipped_surrogate, entropy, kl_divergence, log_prob
from mqe_jax.train.optim import AdamState, adam
from mqe_jax.walk.symmetry import symmetry_loss


class WalkEnvironment(Protocol):
    """Interface between trainer and walking environment; see `mqe_jax.walk.env.WalkEnv`."""

    robot: Robot
    privileged_size: int

    def reset(self, key: jax.Array, spec: Any = None, difficulty: Any = 1.0, step: Any = 0) -> Any: ...
    def step(self, state: Any, action: jax.Array) -> Any: ...
    def autoreset(self, state: Any) -> Any: ...


@dataclasses.dataclass(frozen=True)
class WalkConfig:
    """Settings for training the walk policy; defaults as in walk-these-ways where available."""

    num_envs: int = 8192
    """Number of parallel environments."""
    rollout_steps: int = 24
    """Steps per environment and update."""
    iterations: int = 1200
    """Total number of updates."""
    epochs: int = 5
    """Passes over each rollout."""
    minibatches: int = 6
    """Minibatches per epoch."""
    learning_rate: float = 1e-3
    """Initial learning rate; adapted to `target_kl`."""
    target_kl: float = 0.01
    """Target KL divergence per minibatch."""
    clip: float = 0.2
    """Half width of the clipping interval of the policy ratio."""
    gamma: float = 0.99
    """Discount factor."""
    gae_lambda: float = 0.95
    """Trace decay of generalised advantage estimation."""
    entropy_coef: float = 0.01
    """Coefficient of the entropy bonus."""
    value_coef: float = 1.0
    """Coefficient of the value loss."""
    adaptation_coef: float = 1.0
    """Coefficient of the adaptation network's regression loss."""
    symmetry_coef: float = 0.0
    """Coefficient of the loss of left-right symmetry."""
    max_grad_norm: float = 1.0
    """Global gradient-norm clip."""
    initial_std: float = 1.0
    """Initial standard deviation of the actions."""
    curriculum: int = 400
    """Iterations over which slopes, forces and pushes are ramped to their maxima."""
    critic_warmup: int = 0
    """Initial iterations with the policy frozen, in which only critic and adaptation network are trained."""
    anneal: float = 0.0
    """Final fraction of training over which learning rate and entropy bonus are annealed linearly to zero."""
    seed: int = 1
    """Random seed."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class WalkTrainState:
    """Training state without the environments."""

    params: dict[str, Any]
    """Parameters: {"policy": walk policy weights, "log_std": (12,), "critic": layers}."""
    optimizer: Any
    """Adam's state."""
    learning_rate: jax.Array
    """Learning rate ()."""
    iteration: jax.Array
    """Updates done () int32."""
    key: jax.Array
    """Random key."""


def windows(buffer: jax.Array, episode_steps: jax.Array, time_index: jax.Array, env_index: jax.Array) -> jax.Array:
    """Gathers flattened 30-step histories (B, 2100); observations before the episode's start are zero.

    Args:
        buffer: observations (29 + T, N, 70): row t + 29 is that of step t.
        episode_steps: steps since the reset at each step (T, N).
        time_index: (B,).
        env_index: (B,).
    """
    rows = time_index[:, None] + jnp.arange(HISTORY)
    history = buffer[rows, env_index[:, None]]
    back = HISTORY - 1 - jnp.arange(HISTORY)
    alive = back <= episode_steps[time_index, env_index][:, None]
    return (history * alive[..., None]).reshape(len(time_index), -1)


def init_train_state(
    key: jax.Array, config: WalkConfig, privileged_size: int, policy: walk_policy.Params | None = None
) -> WalkTrainState:
    """Samples the initial weights; those of the policy are `policy` if given, for fine-tuning."""
    key, policy_key, critic_key = jax.random.split(key, 3)
    params = {
        "policy": walk_policy.init_params(policy_key) if policy is None else policy,
        "log_std": jnp.full(NUM_JOINTS, jnp.log(config.initial_std)),
        "critic": nn.mlp_init(critic_key, (privileged_size, 512, 256, 128, 1), final_scale=1.0),
    }
    optimizer = adam(1e-8, max_grad_norm=config.max_grad_norm).init(params)
    return WalkTrainState(params, optimizer, jnp.float32(config.learning_rate), jnp.int32(0), key)


def make_iteration(
    env: WalkEnvironment, config: WalkConfig
) -> Callable[..., tuple[WalkTrainState, Any, jax.Array, dict[str, jax.Array]]]:
    """Returns `iterate(train_state, state, history, scale) -> (train_state, state, history, metrics)`: rollout, update.

    `state` is the batched environment state, `history` each environment's last observations (N, 30, 70), newest last,
    `scale` () in [0, 1] the factor on learning rate and entropy bonus; below 1 the KL rule only lowers the rate.
    """
    optimizer = adam(1e-8, max_grad_norm=config.max_grad_norm)
    step = jax.vmap(env.step)
    autoreset = jax.vmap(env.autoreset)

    def critic(params: Any, privileged: jax.Array) -> jax.Array:
        return nn.mlp(params["critic"], privileged, jax.nn.elu)[..., 0]

    def rollout(
        train_state: WalkTrainState, state: Any, history: jax.Array, key: jax.Array
    ) -> tuple[Any, jax.Array, Any]:
        params = train_state.params

        def body(carry: tuple[Any, jax.Array], step_key: jax.Array) -> tuple[tuple[Any, jax.Array], Any]:
            state, history = carry
            flat = history.reshape(config.num_envs, -1)
            latent = walk_policy.infer_latent(params["policy"], flat)
            mean = walk_policy.infer_action(params["policy"], flat, latent)
            action = mean + jnp.exp(params["log_std"]) * jax.random.normal(step_key, mean.shape)
            next_state = step(state, action)
            # The critic takes no history, so the next state's value needs only the observation before the reset.
            record = {
                "obs": state.obs,
                "privileged": state.privileged_obs,
                "episode_steps": state.episode_steps,
                "action": action,
                "mean": mean,
                "log_prob": jnp.sum(log_prob(action, mean, params["log_std"]), -1),
                "next_privileged": next_state.privileged_obs,
                "reward": next_state.reward,
                "terminated": next_state.terminated,
                "truncated": next_state.truncated,
                "latent_target": state.latent_target,
                "length": next_state.episode_steps,
                "metrics": next_state.metrics,
            }
            next_state = autoreset(next_state)
            fresh = (next_state.episode_steps == 0)[:, None, None]
            history = jnp.concatenate([jnp.where(fresh, 0.0, history[:, 1:]), next_state.obs[:, None]], axis=1)
            return (next_state, history), record

        (state, history), records = jax.lax.scan(body, (state, history), jax.random.split(key, config.rollout_steps))
        return state, history, records

    def iterate(
        train_state: WalkTrainState, state: Any, history: jax.Array, scale: jax.Array
    ) -> tuple[WalkTrainState, Any, jax.Array, dict[str, jax.Array]]:
        key, rollout_key, shuffle_key = jax.random.split(train_state.key, 3)
        difficulty = jnp.clip(train_state.iteration / max(config.curriculum, 1), 0.0, 1.0)
        state = dataclasses.replace(state, difficulty=jnp.full(config.num_envs, difficulty))
        before = jnp.moveaxis(history[:, :-1], 1, 0)
        state, history, records = rollout(train_state, state, history, rollout_key)
        buffer = jnp.concatenate([before, records["obs"]])
        value = critic(train_state.params, records["privileged"])
        next_value = critic(train_state.params, records["next_privileged"])
        done = records["terminated"] | records["truncated"]
        advantage, target = gae(
            records["reward"],
            value,
            next_value,
            records["terminated"],
            done,
            gamma=config.gamma,
            gae_lambda=config.gae_lambda,
        )
        advantage = (advantage - jnp.mean(advantage)) / (jnp.std(advantage) + 1e-8)
        old_log_std = train_state.params["log_std"]
        # Policy gradients are zeroed during the first `critic_warmup` iterations of fine-tuning.
        policy_trained = (train_state.iteration >= config.critic_warmup).astype(jnp.float32)

        def loss(params: Any, t: jax.Array, n: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
            flat = windows(buffer, records["episode_steps"], t, n)
            latent = walk_policy.infer_latent(params["policy"], flat)
            mean = walk_policy.infer_action(params["policy"], flat, jax.lax.stop_gradient(latent))
            new = jnp.sum(log_prob(records["action"][t, n], mean, params["log_std"]), -1)
            policy = jnp.mean(clipped_surrogate(new - records["log_prob"][t, n], advantage[t, n], config.clip))
            predicted = critic(params, records["privileged"][t, n])
            near = value[t, n] + jnp.clip(predicted - value[t, n], -config.clip, config.clip)
            wanted = target[t, n]
            value_error = jnp.mean(jnp.maximum(jnp.square(predicted - wanted), jnp.square(near - wanted)))
            adaptation = jnp.mean(jnp.square(latent - records["latent_target"][t, n]))
            bonus = jnp.mean(entropy(params["log_std"]))
            total = policy_trained * (policy - scale * config.entropy_coef * bonus)
            total += config.value_coef * value_error + config.adaptation_coef * adaptation
            symmetry = jnp.zeros(())
            if config.symmetry_coef > 0:
                symmetry = symmetry_loss(params["policy"], flat, mean)
                total += policy_trained * config.symmetry_coef * symmetry
            kl = jnp.mean(kl_divergence(records["mean"][t, n], old_log_std, mean, params["log_std"]))
            losses = {"value_loss": value_error, "adaptation_loss": adaptation, "symmetry_loss": symmetry}
            return total, {"kl": kl, **losses}

        samples = config.rollout_steps * config.num_envs
        size = samples // config.minibatches

        def minibatch(carry: tuple[Any, Any, jax.Array], index: jax.Array) -> tuple[Any, dict[str, jax.Array]]:
            params, state, rate = carry
            grads, info = jax.grad(loss, has_aux=True)(params, index // config.num_envs, index % config.num_envs)
            rate = jnp.where(info["kl"] > 2 * config.target_kl, jnp.maximum(rate / 1.5, 1e-5), rate)
            raised = (info["kl"] < config.target_kl / 2) & (policy_trained > 0) & (scale >= 1.0)
            rate = jnp.where(raised, jnp.minimum(rate * 1.5, 1e-2), rate)
            params, state, info["grad_norm"] = optimizer.update(grads, state, params, rate * scale)
            return (params, state, rate), info

        order = jax.vmap(lambda k: jax.random.permutation(k, samples)[: size * config.minibatches])(
            jax.random.split(shuffle_key, config.epochs)
        )
        (params, optimizer_state, rate), info = jax.lax.scan(
            minibatch, (train_state.params, train_state.optimizer, train_state.learning_rate), order.reshape(-1, size)
        )
        ended = jnp.sum(done)
        metrics = {name: jnp.mean(values) for name, values in {**info, **records["metrics"]}.items()}
        metrics |= {
            "reward": jnp.mean(records["reward"]),
            "learning_rate": rate,
            "std": jnp.mean(jnp.exp(params["log_std"])),
            "fall_per_20s": jnp.mean(records["terminated"]) * 1000.0,
            "difficulty": difficulty,
            "episode_length": jnp.sum(records["length"] * done) / jnp.maximum(ended, 1),
        }
        train_state = WalkTrainState(params, optimizer_state, rate, train_state.iteration + 1, key)
        return train_state, state, history, metrics

    return iterate


def _to_checkpoint(train_state: WalkTrainState) -> dict[str, Any]:
    """Returns the part of a training state that a checkpoint stores: 12 MB instead of 25.

    Adam's second moments are stored as bfloat16 (bits in uint16), its first moments are omitted: they restart from zero
    and recover within about ten minibatches.
    """
    half = lambda x: jax.lax.bitcast_convert_type(x.astype(jnp.bfloat16), jnp.uint16)  # noqa: E731
    return {
        "params": train_state.params,
        "adam_square": jax.tree.map(half, train_state.optimizer.square),
        "adam_updates": train_state.optimizer.updates,
        "learning_rate": train_state.learning_rate,
        "iteration": train_state.iteration,
        "key": train_state.key,
    }


def _from_checkpoint(saved: dict[str, Any]) -> WalkTrainState:
    """Restores a training state from a checkpoint's contents."""
    full = lambda x: jax.lax.bitcast_convert_type(x, jnp.bfloat16).astype(jnp.float32)  # noqa: E731
    params = saved["params"]
    optimizer = AdamState(
        mean=jax.tree.map(jnp.zeros_like, params),
        square=jax.tree.map(full, saved["adam_square"]),
        updates=saved["adam_updates"],
    )
    return WalkTrainState(params, optimizer, saved["learning_rate"], saved["iteration"], saved["key"])


def save(run_dir: Path, train_state: WalkTrainState, robot: Robot, config: WalkConfig) -> Path:
    """Writes a checkpoint and walk.safetensors (float16) into a run folder; returns the checkpoint's path."""
    iteration = int(train_state.iteration)
    about = {"robot": robot.name, "config": dataclasses.asdict(config), "iteration": iteration}
    walk_policy.save_params(train_state.params["policy"], run_dir / "walk.safetensors", about, half=True)
    return checkpoint.save_checkpoint(run_dir, _to_checkpoint(train_state), iteration, about, keep=2)


def restore(run_dir: Path, train_state: WalkTrainState, robot: Robot) -> WalkTrainState:
    """Returns the training state of a run's newest checkpoint; `train_state` itself if there is none.

    Raises:
        InputError: if the checkpoint is damaged or of another robot.
    """
    newest = checkpoint.latest(run_dir)
    if newest is None:
        return train_state
    saved = checkpoint.load_checkpoint(newest, jax.eval_shape(_to_checkpoint, train_state))
    if saved.metadata["robot"] != robot.name:
        trained = saved.metadata["robot"]
        raise InputError(f"{newest}: trained on {trained}; resume it with --robot {trained}, not {robot.name}")
    return _from_checkpoint(saved.tree)


def train_walk(
    env: WalkEnvironment,
    config: WalkConfig,
    run_dir: Path,
    *,
    resume: bool = False,
    policy: walk_policy.Params | None = None,
    max_seconds: float | None = None,
    save_every: int = 100,
    report: Callable[[int, dict[str, float]], None] | None = None,
) -> walk_policy.Params:
    """Trains the walk policy; writes metrics.csv, checkpoints and walk.safetensors into `run_dir`.

    Args:
        env: the walking environment.
        config: settings.
        run_dir: run folder.
        resume: continue from the folder's newest checkpoint; the environments are reset.
        policy: weights to fine-tune; sampled if None.
        max_seconds: stop after this time, compilation included, after saving a checkpoint, s.
        save_every: iterations between checkpoints.
        report: called with the iteration and its metrics every 10 iterations.

    Raises:
        InputError: if the checkpoint to resume from is damaged or of another robot.
    """
    start = time.monotonic()
    run_dir.mkdir(parents=True, exist_ok=True)
    key = jax.random.PRNGKey(config.seed)
    train_key, state_key, stagger_key = jax.random.split(key, 3)
    train_state = init_train_state(train_key, config, env.privileged_size, policy)
    if resume:
        train_state = restore(run_dir, train_state, env.robot)
        state_key = jax.random.fold_in(state_key, train_state.iteration)
    difficulty = jnp.clip(train_state.iteration / max(config.curriculum, 1), 0.0, 1.0)
    keys = jax.random.split(state_key, config.num_envs)
    # Staggered time limits: the environments do not all reset at once.
    steps = jax.random.randint(stagger_key, (config.num_envs,), 0, 900)
    reset = jax.jit(jax.vmap(lambda k, s: env.reset(k, None, difficulty, s)))
    state = reset(keys, steps)
    history = jnp.zeros((config.num_envs, HISTORY, OBSERVATION_SIZE)).at[:, -1].set(state.obs)
    iterate = jax.jit(make_iteration(env, config), donate_argnums=(2,))
    first = int(train_state.iteration)
    if first == 0:
        save(run_dir, train_state, env.robot, config)  # a run killed before its first regular one can be resumed
    log = CsvLog(run_dir, first, "iteration")
    writing = threading.Lock()  # held while files are written and the state is exchanged

    def end() -> None:
        writing.acquire()
        save(run_dir, train_state, env.robot, config)

    with interrupts.before_exit(end):
        for iteration in range(first + 1, config.iterations + 1):
            done = (iteration - 1) / config.iterations
            if max_seconds is not None:
                done = max(done, min((time.monotonic() - start) / max_seconds, 1.0))
            scale = min(1.0, (1.0 - done) / config.anneal) if config.anneal > 0 else 1.0
            after, state, history, metrics = iterate(train_state, state, history, jnp.float32(scale))
            jax.block_until_ready(metrics)  # so that `max_seconds` measures finished work
            last = iteration == config.iterations or (
                max_seconds is not None and time.monotonic() - start > max_seconds
            )
            with writing:
                train_state = after
                if iteration % 10 == 0 or last:
                    row = {name: float(value) for name, value in sorted(jax.device_get(metrics).items())}
                    row = {"iteration": iteration, "seconds": round(time.monotonic() - start, 1), **row}
                    log.write(row)
                    if report is not None:
                        report(iteration, row)
                if iteration % save_every == 0 or last:
                    save(run_dir, train_state, env.robot, config)
            if last:
                break
    return train_state.params["policy"]
