"""Brax: `Env` over the joint observations and actions of all agents, and a training wrapper.

Importing this module registers every task under its id, for `brax.envs.get_environment` and
`brax.envs.create`.

`ppo.train(environment=env, wrap_env_fn=wrap, episode_length=env.episode_length)` trains with
automatic resets to new episodes. Brax's own wrapper also works, except on `warp-mjx`, but
restarts an environment from the same initial state.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from mqe_jax import envs
from mqe_jax.adapters import (
    advance,
    begin,
    missing,
    seen_group,
    select,
    task_env,
    team_reward,
)
from mqe_jax.adapters.host import info_of
from mqe_jax.adapters.opponent import TaskEnv
from mqe_jax.core.errors import InputError
from mqe_jax.core.limits import PositiveInt
from mqe_jax.core.precision import single
from mqe_jax.core.settings import checked
from mqe_jax.core.types import RandomKeys, where_rows
from mqe_jax.envs import QuadrupedEnv
from mqe_jax.envs import State as TaskState
from mqe_jax.envs.autoreset import autoreset
from mqe_jax.envs.registry import REGISTERED

try:
    from brax.envs import register_environment
    from brax.envs.base import Env as BraxEnv
    from brax.envs.base import State, Wrapper
    from brax.envs.wrappers.training import EpisodeWrapper, VmapWrapper
except ImportError as error:
    raise missing("brax", error) from None

# Key proposed in google-deepmind/mujoco_playground, issue 305.
FINAL_OBS = "AutoResetWrapper_final_obs"


def register() -> None:
    """Registers every task under its id, as later `mqe_jax.envs.register_task` does."""
    for task in envs.tasks():
        register_environment(task, functools.partial(Env, task))  # pyright: ignore[reportArgumentType]


class Env(BraxEnv):
    """One environment: observation (A * O,), action (A * action_size,) in [-1, 1].

    Agents follow each other in both. They see what their sensors measure, if the task has any
    (`senses`).

    With an `opponent`, A counts the agents of team 0. The reward is the mean of team 0's agents
    that take part. `done` is 1 on termination; time limits are left to Brax's EpisodeWrapper.
    `info["truncation"]` is 1 in the step that reaches the time limit, `info[FINAL_OBS]` the
    observation at the end of the step. `pipeline_state` is the task's `State`.
    """

    def __init__(self, task: str | QuadrupedEnv, **overrides: Any) -> None:
        """Creates the environment from a task id or an environment.

        The overrides are those of `task_env`.
        """
        self.env: TaskEnv = task_env(task, **overrides)
        self.episode_length: int = self.env.max_steps
        self.group = seen_group(self.env)  # of observations

    @single
    def reset(self, rng: jax.Array) -> State:
        state = begin(self.env, rng)
        obs = state.groups[self.group].reshape(-1)
        info = {"truncation": jnp.zeros(()), FINAL_OBS: obs}
        pipeline: Any = state  # any pytree, although Brax's annotation is narrower
        zero = jnp.zeros(())
        return State(pipeline, obs, reward=zero, done=zero, metrics=info_of(state), info=info)

    @single
    def step(self, state: State, action: jax.Array) -> State:
        """Advances by one environment step; raises an InputError for an action of another size."""
        if jnp.shape(action) != (self.action_size,):
            raise InputError(
                f"action: shape {jnp.shape(action)}; expected ({self.action_size},), agents * "
                "action size"
            )
        before: Any = state.pipeline_state
        action = action.reshape(self.env.num_agents, self.env.action_size)
        after = advance(self.env, before, action)
        obs = after.groups[self.group].reshape(-1)
        info = {**state.info, "truncation": after.truncated.astype(jnp.float32), FINAL_OBS: obs}
        return state.replace(  # pyright: ignore[reportAttributeAccessIssue]
            pipeline_state=after,
            obs=obs,
            reward=team_reward(self.env, after.reward, after.active),
            done=after.terminated.astype(jnp.float32),
            # Wrappers may have added entries.
            metrics={**state.metrics, **info_of(after)},
            info=info,
        )

    @property
    def observation_size(self) -> int:
        return self.env.num_agents * self.env.group_sizes[self.group]

    @property
    def action_size(self) -> int:
        return self.env.num_agents * self.env.action_size

    @property
    def backend(self) -> str:
        return self.env.impl


class Hold(Wrapper):
    """Keeps an environment as it is once its episode ends within the repetitions of an action."""

    def step(self, state: State, action: jax.Array) -> State:
        """Steps the environments (N,) whose episodes go on; the others have a reward of 0."""
        after = self.env.step(state, action)
        task: Any = self.env.unwrapped.env  # pyright: ignore[reportAttributeAccessIssue]
        ended = state.done.astype(bool)
        pair: Any = (state.pipeline_state, after.pipeline_state)
        own = jax.vmap(functools.partial(select, task))(ended, *pair)
        names = ("obs", "done", "metrics", "info")
        kept = {
            name: where_rows(ended, getattr(state, name), getattr(after, name)) for name in names
        }
        reward = jnp.where(ended, 0.0, after.reward)
        return after.replace(pipeline_state=own, reward=reward, **kept)  # pyright: ignore[reportAttributeAccessIssue]


class AutoReset(Wrapper):
    """Resets ended environments to new episodes; wraps a batch of `Env` with EpisodeWrapper.

    `info["truncation"]` and `info[FINAL_OBS]` belong to the step, `obs` and `pipeline_state` to the
    new episode.
    """

    @single
    @checked
    def reset(self, rng: RandomKeys) -> State:
        return self.env.reset(rng)

    @single
    def step(self, state: State, action: jax.Array) -> State:
        """Steps the batch, then resets the environments whose episodes ended."""
        shape = (*jnp.shape(state.done), self.action_size)
        if jnp.shape(action) != shape:
            raise InputError(
                f"action: shape {jnp.shape(action)}; expected {shape}, environments and all actions"
            )
        info = {**state.info, "steps": jnp.where(state.done, 0.0, state.info["steps"])}
        cleared = state.replace(done=jnp.zeros_like(state.done), info=info)  # pyright: ignore[reportAttributeAccessIssue]
        after = self.env.step(cleared, action)
        adapter: Any = self.env.unwrapped
        task = adapter.env
        group = adapter.group

        def restart(own: TaskState, done: jax.Array) -> TaskState:
            # EpisodeWrapper may end an episode earlier than the task's time limit.
            truncated = done.astype(bool) & ~own.terminated
            return autoreset(task, dataclasses.replace(own, truncated=truncated), groups=[group])

        reached: Any = after.pipeline_state
        own = jax.vmap(restart)(reached, after.done)
        obs = own.groups[group].reshape(*after.done.shape, -1)
        return after.replace(pipeline_state=own, obs=obs)  # pyright: ignore[reportAttributeAccessIssue]


@checked
def wrap(
    env: BraxEnv,
    episode_length: PositiveInt = 1000,
    action_repeat: PositiveInt = 1,
    randomization_fn: Callable[..., Any] | None = None,
) -> Wrapper:
    """Wraps an `Env` for Brax's trainers, as `wrap_env_fn`: batch, time limit, new episodes.

    An episode that ends within the repetitions of an action ends there.
    """
    inner = getattr(env, "unwrapped", env)
    if not isinstance(inner, Env):
        raise InputError(f"env: {type(inner).__name__} is not a mqe_jax.adapters.brax.Env")
    if randomization_fn is not None:
        raise InputError(
            "randomization_fn: not supported; pass randomization=... to the Env instead"
        )
    batch = VmapWrapper(env)
    if action_repeat > 1:
        batch = Hold(batch)
    return AutoReset(EpisodeWrapper(batch, episode_length, action_repeat))


register()
REGISTERED.append(register)


def _replicate(tree: Any, devices: Sequence[Any]) -> Any:
    return jax.tree.map(lambda x: jnp.stack([jnp.asarray(x)] * len(devices)), tree)


if not hasattr(jax, "device_put_replicated"):  # removed in jax 0.10; Brax 0.14.2 calls it
    jax.device_put_replicated = _replicate  # pyright: ignore[reportAttributeAccessIssue]
