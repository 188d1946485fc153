"""Trains Climb on Seesaw with Stable-Baselines3's PPO, one policy for all agents.

    pip install stable-baselines3
    python examples/sb3.py --csv sb3.csv

Each agent of `gymnasium.make_vec` is an environment of Stable-Baselines3. At the end,
`mqe_jax.evaluate` measures the policy.
"""

import argparse
import csv
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium
import jax.numpy as jnp
import numpy as np

import mqe_jax
import mqe_jax.adapters.gymnasium  # registers the tasks

sb3: Any = import_module("stable_baselines3")  # by name: it is no extra of mqe-jax
wrappers: Any = import_module("stable_baselines3.common.vec_env")

NUM_ENVS = 64
COLUMNS = {"return": "r", "episode_length": "l"}
"""Columns of the curve and their names in Stable-Baselines3's records of episodes."""


class Agents(wrappers.VecEnv):
    """The agents of all environments, one after another."""

    def __init__(self, task: str, num_envs: int = NUM_ENVS, **settings: Any) -> None:
        self.env: Any = gymnasium.make_vec(
            f"mqe/{task}-v0", num_envs=num_envs, autoreset_mode="SameStep", **settings
        )
        self.num_agents, size = self.env.single_observation_space.shape
        seen = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        action = gymnasium.spaces.Box(-1.0, 1.0, self.env.single_action_space.shape[1:], np.float32)
        super().__init__(num_envs * self.num_agents, seen, action)

    def reset(self) -> np.ndarray:
        obs, _ = self.env.reset(seed=self._seeds[0])
        return obs.reshape(self.num_envs, -1)

    def step_async(self, actions: np.ndarray) -> None:
        self.actions = actions.reshape(self.env.action_space.shape)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        obs, _, terminated, truncated, infos = self.env.step(self.actions)
        ended = terminated | truncated
        reward = np.zeros((len(ended), self.num_agents), np.float32)
        for mask, info in ((~ended, infos), (ended, infos.get("final_info"))):
            if mask.any():
                reward[mask] = info["agent_rewards"][mask]
        found: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for env in np.flatnonzero(ended):
            for agent in range(self.num_agents):
                info = found[env * self.num_agents + agent]
                info["terminal_observation"] = infos["final_obs"][env][agent]
                info["TimeLimit.truncated"] = not terminated[env]
        obs = obs.reshape(self.num_envs, -1)
        return obs, reward.reshape(-1), np.repeat(ended, self.num_agents), found

    def close(self) -> None:
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.env, attr_name, None)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        setattr(self.env, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **named: Any) -> Any:
        return [getattr(self.env, method_name)(*args, **named)] * self.num_envs

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs


def train(env: Any, steps: int, rollout: int = 64) -> tuple[Any, list[dict[str, Any]]]:
    """Trains; returns the model, and a row of each update.

    Its columns are environment steps, and return and length of the agents' last 100 episodes.

    Args:
        env: agents, in `VecMonitor` and `VecNormalize`.
        steps: environment steps.
        rollout: steps of each environment between updates.
    """
    settings = {"batch_size": rollout * env.num_envs // 4, "n_epochs": 5, "learning_rate": 1e-3}
    policy = {"log_std_init": -0.7}
    model = sb3.PPO(
        "MlpPolicy", env, n_steps=rollout, policy_kwargs=policy, device="cpu", seed=0, **settings
    )
    rows = []
    agents = env.get_attr("single_observation_space")[0].shape[0]
    while model.num_timesteps < steps * agents:
        model.learn(rollout * env.num_envs, reset_num_timesteps=False)
        episodes = model.ep_info_buffer
        if episodes:
            row: dict[str, Any] = {"env_steps": model.num_timesteps // agents}
            for name, key in COLUMNS.items():
                row[name] = round(float(np.mean([episode[key] for episode in episodes])), 3)
            rows.append(row)
            print(row, flush=True)
    return model, rows


def policy_of(model: Any, env: Any) -> Any:
    """Returns the model's mean actions as a function of JAX, which `mqe_jax.evaluate` accepts."""
    net = model.policy
    parts = [*net.mlp_extractor.policy_net, net.action_net]
    layers = [
        (jnp.asarray(part.weight.detach().numpy().T), jnp.asarray(part.bias.detach().numpy()))
        for part in parts
        if hasattr(part, "weight")
    ]
    mean, scale = env.obs_rms.mean, np.sqrt(env.obs_rms.var + env.epsilon)

    def act(obs: Any, memory: Any, key: Any) -> Any:
        x = jnp.clip((obs - mean) / scale, -env.clip_obs, env.clip_obs).astype(jnp.float32)
        for weights, bias in layers[:-1]:
            x = jnp.tanh(x @ weights + bias)
        weights, bias = layers[-1]
        return x @ weights + bias, memory

    return act


def main() -> None:
    """Runs the example."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--task", default="go1seesaw")
    parser.add_argument("--steps", type=int, default=400_000)
    parser.add_argument("--csv", type=Path)
    arguments = parser.parse_args()
    env = wrappers.VecNormalize(wrappers.VecMonitor(Agents(arguments.task)))
    model, rows = train(env, arguments.steps)
    if arguments.csv is not None and rows:
        with arguments.csv.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    print(mqe_jax.evaluate(arguments.task, policy_of(model, env), episodes=256))


if __name__ == "__main__":
    main()
