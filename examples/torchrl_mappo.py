"""Trains a task with TorchRL's multi-agent PPO, a central critic and shared parameters.

    pip install -e '.[pettingzoo]' torchrl
    python examples/torchrl_mappo.py --csv torchrl.csv
    python examples/torchrl_mappo.py --task go1tug --opponent idle

PettingZoo connects them. TorchRL steps one environment on the host: the example demonstrates
compatibility, not speed.
"""

import argparse
from importlib import import_module
from pathlib import Path
from typing import Any

from mqe_jax.adapters import pettingzoo

BATCH = 2000
EPOCHS = 8
MINIBATCHES = 4
GROUP = "robot"
"""TorchRL's group of the agents robot_0, robot_1, ..."""


def train(
    task: str = "go1seesaw", steps: int = 26_000, batch: int = BATCH, **settings: Any
) -> list[float]:
    """Trains and returns an agent's mean return over the episodes that ended in each batch.

    It is NaN if none ended.

    Args:
        task: id.
        steps: environment steps.
        batch: environment steps between updates.
        settings: arguments of `mqe_jax.adapters.pettingzoo.parallel_env`, such as `opponent`.
    """
    # Imported by name: TorchRL is not an extra of mqe-jax.
    torch: Any = import_module("torch")
    envs: Any = import_module("torchrl.envs")
    collectors: Any = import_module("torchrl.collectors")
    objectives: Any = import_module("torchrl.objectives")
    torch.manual_seed(0)
    env = envs.PettingZooWrapper(pettingzoo.parallel_env(task, **settings))
    total = (GROUP, "episode_reward")
    env = envs.TransformedEnv(env, envs.RewardSum(in_keys=[env.reward_key], out_keys=[total]))
    actor, critic = networks(env)
    loss = objectives.ClipPPOLoss(
        actor, critic, clip_epsilon=0.2, entropy_coeff=1e-3, normalize_advantage=True
    )
    loss.set_keys(
        reward=env.reward_key,
        action=env.action_key,
        value=(GROUP, "state_value"),
        done=(GROUP, "done"),
        terminated=(GROUP, "terminated"),
    )
    loss.make_value_estimator(objectives.ValueEstimators.GAE, gamma=0.99, lmbda=0.95)
    optimizer = torch.optim.Adam(loss.parameters(), lr=5e-4)
    returns = []
    for data in collectors.Collector(env, actor, frames_per_batch=batch, total_frames=steps):
        ended = data["next", GROUP, "done"]
        returns.append(float(data["next", *total][ended].mean()))
        print(f"{batch * len(returns)} steps, return {returns[-1]:.3f}", flush=True)
        for _ in range(EPOCHS):
            with torch.no_grad():
                loss.value_estimator(
                    data,
                    params=loss.critic_network_params,
                    target_params=loss.target_critic_network_params,
                )
            for part in data[torch.randperm(len(data))].chunk(MINIBATCHES):
                values = loss(part)
                total_loss = values["loss_objective"] + values["loss_critic"]
                total_loss += values["loss_entropy"]
                total_loss.backward()
                torch.nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
                optimizer.step()
                optimizer.zero_grad()
    return returns


def networks(env: Any) -> tuple[Any, Any]:
    """Returns the policy, shared by the agents, and the central critic."""
    torch: Any = import_module("torch")
    tensordict: Any = import_module("tensordict.nn")
    modules: Any = import_module("torchrl.modules")
    observation = (GROUP, "observation")
    action = env.full_action_spec_unbatched[env.action_key]
    agents, size = action.shape
    settings = {
        "n_agent_inputs": env.observation_spec[observation].shape[-1],
        "n_agents": agents,
        "share_params": True,
        "depth": 2,
        "num_cells": 64,
        "activation_class": torch.nn.Tanh,
    }
    mean = modules.MultiAgentMLP(n_agent_outputs=2 * size, centralised=False, **settings)
    mean = torch.nn.Sequential(mean, tensordict.NormalParamExtractor())
    parameters = [(GROUP, "loc"), (GROUP, "scale")]
    actor = modules.ProbabilisticActor(
        tensordict.TensorDictModule(mean, in_keys=[observation], out_keys=parameters),
        spec=action,
        in_keys=parameters,
        out_keys=[env.action_key],
        distribution_class=modules.TanhNormal,
        return_log_prob=True,
    )
    value = modules.MultiAgentMLP(n_agent_outputs=1, centralised=True, **settings)
    critic = tensordict.TensorDictModule(
        value, in_keys=[observation], out_keys=[(GROUP, "state_value")]
    )
    return actor, critic


def main() -> None:
    """Runs the example."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--task", default="go1seesaw")
    parser.add_argument("--opponent", help="policy of team 1 of a match")
    parser.add_argument("--steps", type=int, default=26_000)
    parser.add_argument("--csv", type=Path)
    arguments = parser.parse_args()
    returns = train(arguments.task, arguments.steps, opponent=arguments.opponent)
    if arguments.csv is not None:
        rows = [f"{BATCH * (i + 1)},{value:.3f}\n" for i, value in enumerate(returns)]
        arguments.csv.write_text("".join(["env_steps,return\n", *rows]), encoding="utf-8")


if __name__ == "__main__":
    main()
