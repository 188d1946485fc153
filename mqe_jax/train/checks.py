"""Checks that training settings fit the environment and the network."""

from typing import Any

import jax

from mqe_jax.core.errors import InputError
from mqe_jax.core.memory import check_memory
from mqe_jax.core.precision import single
from mqe_jax.core.settings import fail
from mqe_jax.core.types import VectorEnv, final_observations, observations, teams_of
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.networks import EnvDims, Network


@single
def check_environment(
    env: VectorEnv, config: TrainConfig, dims: EnvDims, processes: int = 1
) -> None:
    """Checks the shapes of the environment's state, and the fields that the settings require."""
    if len(teams_of(env)) > 1:
        raise InputError(
            f"env: {env.name} has {len(teams_of(env))} teams; use versus(env, opponents) or "
            "Mirror(env)"
        )
    if env.num_envs * processes != config.num_envs:
        fail(
            "num_envs",
            config.num_envs,
            f"equal to the environment's num_envs, {env.num_envs * processes}",
        )
    state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
    count = env.num_envs
    agents = (count, dims.agents)
    obs = (*agents, dims.observation)
    privileged = (count, dims.privileged)
    group = config.group
    own = f"obs (group {group!r})"
    reads = config.network.critic_reads
    final_privileged = state.final_privileged_obs
    expected = [
        (own, observations(state).groups.get(group), obs, True),
        (f"final_{own}", final_observations(state).get(group), obs, "obs" in reads),
        ("privileged_obs", state.privileged_obs, privileged, True),
        ("final_privileged_obs", final_privileged, privileged, "privileged_obs" in reads),
        ("reward", state.reward, agents, True),
        ("terminated", state.terminated, (count,), True),
        ("truncated", state.truncated, (count,), True),
    ]
    for name, value, shape, required in expected:
        if value is None and not required:
            continue
        if value is None or value.shape != shape:
            found = "is missing" if value is None else f"has shape {value.shape}"
            raise InputError(f"env: {name} of {env.name} {found}; expected {shape}")
    numbers = dims.agents * (dims.observation + dims.action + 4) + dims.privileged
    check_memory(
        "rollout_steps", config.rollout_steps, 4.0 * numbers * config.steps_per_update / processes
    )
    assistance = config.curriculum.assistance
    if assistance and not hasattr(state, "assistance"):
        fail("curriculum.assistance", assistance, f"0: the state of {env.name} has no such field")
    if config.stagger_episodes and not (
        hasattr(env, "max_episode_steps") and hasattr(state, "step")
    ):
        fail(
            "stagger_episodes",
            True,
            f"false: {env.name} has no max_episode_steps, or its state has no field step",
        )


def check_teacher(config: TrainConfig, teacher: Any) -> None:
    """Checks that there is a teacher if and only if the settings name one."""
    if (config.imitation.teacher is None) != (teacher is None):
        fail(
            "imitation.teacher",
            config.imitation.teacher,
            "a policy, which is the learner's argument `teacher`",
        )


def check_divisible(config: TrainConfig, network: Network, processes: int = 1) -> None:
    """Checks that rollouts split into chunks, and these into minibatches."""
    if config.rollout_steps % network.chunk_length:
        fail(
            "rollout_steps",
            config.rollout_steps,
            f"a multiple of the network's chunk_length, {network.chunk_length}",
        )
    chunks = config.steps_per_update // network.chunk_length
    if chunks % config.ppo.minibatches:
        fail(
            "ppo.minibatches",
            config.ppo.minibatches,
            f"a divisor of the rollout's number of chunks ({chunks})",
        )
    groups = config.ppo.groups
    if config.num_envs % groups or chunks // groups % config.ppo.minibatches:
        wanted = (
            f"a divisor of num_envs ({config.num_envs}) that leaves each a multiple of "
            "ppo.minibatches chunks"
        )
        fail("ppo.groups", groups, f"{wanted} ({config.ppo.minibatches}), of {chunks} in all")
    if config.ppo.minibatches > 1 and groups % processes:
        fail(
            "ppo.groups",
            groups,
            f"a multiple of the number of processes, {processes}, if there are minibatches",
        )
