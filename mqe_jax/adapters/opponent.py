"""A match against a fixed opponent as an environment of team 0; `opponents.Versus` is its batched
form.
"""

import dataclasses
import hashlib
from collections.abc import Hashable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.spaces import Box

from mqe_jax.acting.seats import Policy
from mqe_jax.core.errors import InputError
from mqe_jax.core.precision import single
from mqe_jax.core.settings import check, check_arguments
from mqe_jax.core.types import AnySingle, Level, Memory, RandomKey
from mqe_jax.envs import QuadrupedEnv, State
from mqe_jax.envs.observation import box
from mqe_jax.envs.state import with_final
from mqe_jax.policies import SimplePolicy, load_as
from mqe_jax.train.policy import TrainedPolicy, groups_of


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TeamEnvState(State):
    """State of a match as seen by team 0, with T agents; observations, rewards and metrics are
    those of team 0.
    """

    rival_obs: jax.Array  # observations of the opponent's agents (T, O)
    rival_memory: Memory  # recurrent state of the opponent, leading axis 1


class TeamEnv:
    """One match as an environment of team 0, in which the opponent controls team 1.

    It has what the adapters use of `QuadrupedEnv`: sizes and spaces are those of team 0, everything
    else the match's.
    """

    @check_arguments(match=AnySingle)
    def __init__(self, match: QuadrupedEnv, opponent: str | Path | Policy) -> None:
        """Creates the environment; `opponent` is a policy, which samples if it does, or what
        `load_policy` accepts.
        """
        if len(match.teams) != 2:
            raise InputError(f"opponent: {match.name} is not a match; omit the opponent")
        self.match = match
        self.opponent: Policy = load_as("opponent", opponent, match)
        self.num_agents = len(match.teams[0])
        if further := groups_of(self.opponent) - {"policy"}:
            raise InputError(
                f"opponent: sees the groups {sorted(further)}; here it must see the group 'policy'"
            )
        self._source = str(opponent) if isinstance(opponent, str | Path) else None

    def __repr__(self) -> str:
        return f"<{type(self).__name__} against {self.opponent}: {self.match}>"

    def __getattr__(self, name: str) -> Any:
        if name == "match":  # while an instance is being copied
            raise AttributeError(name)
        return getattr(self.match, name)

    @property
    def teams(self) -> tuple[tuple[int, ...], ...]:
        """The only team."""
        return (tuple(range(self.num_agents)),)

    @property
    def action_space(self) -> Box:
        """Actions of team 0 (T, action_size) in [-1, 1]."""
        return box(1.0, (self.num_agents, self.match.action_size))

    @property
    def observation_space(self) -> Box:
        """Observations of team 0 (T, O)."""
        return box(np.inf, (self.num_agents, self.match.observation_size))

    @property
    def identity(self) -> Hashable:
        """A value that is equal for opponents that act alike; compared where compiled functions are
        shared.
        """
        if isinstance(self.opponent, TrainedPolicy):
            digest = hashlib.sha256()
            for leaf in jax.tree.leaves(self.opponent.actor):
                digest.update(np.asarray(leaf).tobytes())
            return str(self.opponent.form.by_name()), digest.hexdigest()
        named = isinstance(self.opponent, SimplePolicy) and self._source is not None
        return self._source if named else id(self.opponent)

    def with_num_envs(self, num_envs: int) -> "TeamEnv":
        """Returns an environment whose engine holds `num_envs` environments; see
        `QuadrupedEnv.with_num_envs`.
        """
        match = self.match.with_num_envs(num_envs)
        if match is self.match:
            return self
        larger = TeamEnv(match, self.opponent)
        larger._source = self._source
        return larger

    @single
    @check_arguments(key=RandomKey, assistance=Level)
    def reset(self, key: jax.Array, assistance: jax.Array | float = 0.0) -> TeamEnvState:
        """Returns a randomised initial state; see `QuadrupedEnv.reset`."""
        return with_final(self.with_observations(self.begin(key, assistance)))

    def begin(self, key: jax.Array, assistance: jax.Array | float = 0.0) -> TeamEnvState:
        """Returns the state of `reset` without observations."""
        rival = {
            "rival_obs": jnp.zeros((self.num_agents, self.match.observation_size)),
            "rival_memory": self.opponent.initial_memory(1),
        }
        return self._of_team(TeamEnvState(**vars(self.match.begin(key, assistance)), **rival))

    @single
    def step(self, state: State, action: jax.Array) -> TeamEnvState:
        """Advances by one environment step with the actions of team 0 (T, action_size)."""
        check("state", state, TeamEnvState)
        shape = (self.num_agents, self.match.action_size)
        if jnp.shape(action) != shape:
            raise InputError(
                f"action: shape {jnp.shape(action)}; expected {shape} (agents, action size)"
            )
        own: Any = state  # a `TeamEnvState`; the match's step keeps its further fields
        key = jax.random.fold_in(own.key, 1)
        rival, memory = self.opponent.act(own.rival_obs[None], own.rival_memory, key)
        both = jnp.concatenate(
            [jnp.asarray(action, jnp.float32), jnp.asarray(rival[0], jnp.float32)]
        )
        after: Any = self.match.advance(own, both)
        return with_final(
            self.with_observations(self._of_team(dataclasses.replace(after, rival_memory=memory)))
        )

    def with_observations(self, state: TeamEnvState, groups: Sequence[str] = ()) -> TeamEnvState:
        """Returns the state with the observations of both teams that belong to it."""
        seen: Any = self.match.with_observations(state, groups)
        own = {name: obs[: self.num_agents] for name, obs in seen.groups.items()}
        return dataclasses.replace(seen, groups=own, rival_obs=seen.obs[self.num_agents :])

    def _of_team(self, state: TeamEnvState) -> TeamEnvState:
        """Reduces rewards, outcome and metrics of all agents to those of team 0."""
        return dataclasses.replace(
            state,
            reward=state.reward[: self.num_agents],
            outcome=state.outcome.by_team(lambda x: x[:1]),
            metrics={
                name: value
                for name, value in state.metrics.items()
                if not name.startswith("team1/")
            },
        )


TaskEnv = QuadrupedEnv | TeamEnv
"""What the adapters adapt: a task, or a match against an opponent."""
