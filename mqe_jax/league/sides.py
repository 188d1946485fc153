"""Matches whose teams change sides, so that the learner, always team 0, is trained from both."""

from __future__ import annotations

import copy
import dataclasses
from typing import Any, Self

import jax
import jax.numpy as jnp

from mqe_jax.envs import State, VectorEnv
from mqe_jax.envs.match import Match
from mqe_jax.envs.state import EnvironmentState
from mqe_jax.train import devices


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class SidesState(EnvironmentState):
    """States of N matches; in the second half the two teams have changed places."""

    inner: State
    """States of the matches, teams in the task's order."""
    action: jax.Array
    """Actions of all agents in the last step, in the task's order (N, A, D)."""


class BothSides:
    """A batch of matches, in the second half of which team 0 is the task's team 1; the interface of `VectorEnv`.

    The privileged observation has one more number: 1 where the teams have changed places, else 0. Of the metrics,
    outcomes are those of the new teams; terms of the reward, zero-sum, change sign.

    A match that is symmetric under a reflection needs it: robots walk not quite as their mirror images.
    """

    def __init__(self, matches: VectorEnv) -> None:
        self.matches, self.env, self.name, self.num_envs = matches, matches.env, matches.name, matches.num_envs
        self.num_agents, self.teams, self.action_size = matches.num_agents, matches.teams, matches.action_size
        self.observation_size = matches.observation_size
        self.privileged_observation_size = matches.privileged_observation_size + 1
        self.max_episode_steps = matches.max_episode_steps

    def share(self, parts: int) -> Self:
        """Returns the batch of one of several processes, as `VectorEnv.share`."""
        other = copy.copy(self)
        other.num_envs = devices.share("num_envs", self.num_envs, parts)
        other.matches = self.matches.share(parts)
        return other

    def reset(self, key: jax.Array) -> SidesState:
        """Returns the initial states of all environments."""
        return self._seen(self.matches.reset(key), jnp.zeros((self.num_envs, self.num_agents, self.action_size)))

    def step(self, state: SidesState, action: jax.Array) -> SidesState:
        """Advances all environments by one step with actions (N, A, action_size); errors as of `VectorEnv`."""
        self.matches.check_action(action)
        inner = dataclasses.replace(state.inner, step=state.step, assistance=state.assistance)
        action = self._exchanged(action)
        return self._seen(self.matches.step(inner, action), action)

    def _seen(self, inner: State, action: jax.Array) -> SidesState:
        changed = self._changed()
        other = {"team0/": "team1/", "team1/": "team0/"}
        metrics = {}
        for name, value in inner.metrics.items():
            if name[:6] in other:
                value = jnp.where(changed, inner.metrics[other[name[:6]] + name[6:]], value)
            elif name == "success":
                value = jnp.where(changed, inner.metrics["team1/win"], value)
            elif name.startswith("reward/") or name == "average_step_reward":
                value = jnp.where(changed, -value, value)
            metrics[name] = value

        def told(privileged: jax.Array) -> jax.Array:
            return jnp.concatenate([privileged, changed[:, None].astype(privileged.dtype)], axis=1)

        return SidesState(
            inner=inner,
            action=action,
            obs=self._exchanged(inner.obs),
            privileged_obs=told(inner.privileged_obs),
            final_obs=self._exchanged(inner.final_obs),
            final_privileged_obs=told(inner.final_privileged_obs),
            reward=self._exchanged(inner.reward),
            terminated=inner.terminated,
            truncated=inner.truncated,
            metrics=metrics,
            step=inner.step,
            assistance=inner.assistance,
            key=inner.key,
        )

    def _changed(self) -> jax.Array:
        """Returns where the teams have changed places (N,) bool."""
        return devices.rows(lambda n: jnp.arange(n) >= n // 2, self.num_envs)

    def _exchanged(self, x: jax.Array) -> jax.Array:
        """Exchanges the halves of axis 1, the agents, where the teams have changed places (N, A, ...)."""
        other = jnp.roll(x, self.num_agents // 2, axis=1)
        return jnp.where(self._changed().reshape(-1, *(1,) * (x.ndim - 1)), other, x)


def both_sides(matches: Any) -> Any:
    """Returns matches with both sides if their symmetry is a reflection, else the matches."""
    assert isinstance(matches.env, Match)
    return BothSides(matches) if matches.env.symmetry == "reflect" else matches
