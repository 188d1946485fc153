"""Wrappers for vectorised environments."""

import copy
import dataclasses
from typing import Any, Self

import jax
import jax.numpy as jnp

from mqe_jax.core import devices
from mqe_jax.core.precision import single
from mqe_jax.core.types import group_sizes
from mqe_jax.envs.autoreset import EnvBatch
from mqe_jax.envs.state import EnvironmentState


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class WrappedState(EnvironmentState):
    """States of N environments as a wrapper shows them."""

    inner: Any  # states of the wrapped batch
    action: jax.Array  # actions that the wrapped batch received in the last step (N, A, D)


class Outer(EnvBatch):
    """A batch of environments around another one, `inner`, which has all further attributes."""

    def __init__(self, inner: Any) -> None:
        self.inner = inner
        self.env = inner.env
        self.name = inner.name
        self.num_envs = inner.num_envs
        self.num_agents = inner.num_agents
        self.teams = inner.teams
        self.action_size = inner.action_size
        self.observation_size = inner.observation_size
        self.group_sizes = group_sizes(inner)
        self.privileged_observation_size = inner.privileged_observation_size
        self.max_episode_steps = inner.max_episode_steps

    def share(self, parts: int) -> Self:
        """Returns the batch of one of several processes, as `VectorEnv.share`."""
        other = copy.copy(self)
        other.num_envs = devices.share("num_envs", self.num_envs, parts)
        other.inner = self.inner.share(parts)
        return other


class Wrapper(Outer):
    """A batch of environments around another; subclasses change what is seen."""

    @single
    def reset(self, key: jax.Array) -> WrappedState:
        """Returns the initial states of all environments."""
        inner = self.inner.reset(key)
        action = jnp.zeros((self.num_envs, self.num_agents, self.action_size))
        return self._state(inner, action, inner.step)

    @single
    def step(self, state: WrappedState, action: jax.Array) -> WrappedState:
        """Advances all environments by one step with actions (N, A, action_size).

        Errors are those of `VectorEnv`.
        """
        self.check_step(state, action, WrappedState)
        action = self.pass_on(action)
        inner = dataclasses.replace(state.inner, step=state.step, assistance=state.assistance)
        return self._state(self.inner.step(inner, action), action, state.step + 1)

    def pass_on(self, action: jax.Array) -> jax.Array:
        """Returns the actions that the wrapped batch receives (N, A, action_size)."""
        return action

    def view(self, inner: Any, reached: jax.Array) -> dict[str, Any]:
        """Returns the fields that differ from the wrapped states'.

        `reached` (N,) are the steps before any reset.
        """
        return {}

    def _state(self, inner: Any, action: jax.Array, reached: jax.Array) -> WrappedState:
        names = [field.name for field in dataclasses.fields(EnvironmentState)]
        fields = {name: getattr(inner, name) for name in names}
        fields |= self.view(inner, reached)
        return WrappedState(**fields, inner=inner, action=action)


class Deadline(Wrapper):
    """The time limit terminates episodes.

    The privileged observation has one more number, the share of time left.

    Time-outs are terminal, without bootstrapping (Pardo et al., arXiv 1712.00378).
    """

    def __init__(self, inner: Any) -> None:
        super().__init__(inner)
        self.privileged_observation_size += 1

    def view(self, inner: Any, reached: jax.Array) -> dict[str, Any]:
        def add_time(privileged: jax.Array, step: jax.Array) -> jax.Array:
            left = 1.0 - step[:, None] / self.max_episode_steps
            return jnp.concatenate([privileged, left], axis=1)

        final = inner.final_privileged_obs
        if final is not None:
            final = add_time(final, reached)
        return {
            "privileged_obs": add_time(inner.privileged_obs, inner.step),
            "final_privileged_obs": final,
            "terminated": inner.terminated | inner.truncated,
            "truncated": jnp.zeros_like(inner.truncated),
        }
