"""A match against a fixed opponent as an environment of team 0.

`opponents.Versus` is its batched form.
"""

import copy
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.spaces import Box

from mqe_jax import names
from mqe_jax.acting.seats import Policy, Seat, Seats, actor_of
from mqe_jax.core import keys
from mqe_jax.core.errors import InputError
from mqe_jax.core.precision import single
from mqe_jax.core.settings import check, checked
from mqe_jax.core.types import Level, Memory, Observations, RandomKey
from mqe_jax.envs import QuadrupedEnv, State
from mqe_jax.envs.match import team_view
from mqe_jax.envs.observation import box
from mqe_jax.envs.state import with_final


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TeamEnvState(State):
    """State of a match as seen by team 0, with T agents.

    Observations, rewards and metrics are those of team 0.
    """

    everyone: jax.Array  # which agents of both teams take part (2 T,) bool
    rival_groups: dict[str, jax.Array]
    """Observations of all agents (2 T, O_g) by the groups that the opponent sees."""
    rival_memory: tuple[Memory]  # recurrent state of the opponent, leading axis 1


class TeamEnv:
    """One match as an environment of team 0, in which the opponent controls team 1.

    It has what the adapters use of `QuadrupedEnv`: sizes and spaces are those of team 0, everything
    else the match's.
    """

    def __init__(self, match: QuadrupedEnv, opponent: str | Path | Policy) -> None:
        """Creates the environment; `opponent` is a policy, or what `load_policy` accepts.

        The opponent samples if its policy does.
        """
        if len(match.teams) != 2:
            raise InputError(f"opponent: {match.name} is not a match; omit the opponent")
        self.match = match
        self.num_agents = len(match.teams[0])
        rivals = match.teams[1]
        rival = actor_of(names.seat(opponent, match, "opponent"))
        self.seats = Seats((Seat(rival, rivals, rivals),))
        """The opponent."""

    def __repr__(self) -> str:
        return f"<{type(self).__name__} against {self.seats.seats[0].policy}: {self.match}>"

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

    def with_num_envs(self, num_envs: int) -> "TeamEnv":
        """Returns an environment whose engine holds `num_envs` environments.

        See `QuadrupedEnv.with_num_envs`.
        """
        other = copy.copy(self)
        other.match = self.match.with_num_envs(num_envs)
        return other

    def with_seats(self, seats: Seats) -> "TeamEnv":
        """Returns an environment with another opponent of the same form."""
        other = copy.copy(self)
        other.seats = seats
        return other

    @single
    @checked
    def reset(self, key: RandomKey, assistance: Level = 0.0) -> TeamEnvState:
        """Returns a randomised initial state; see `QuadrupedEnv.reset`."""
        return with_final(self.with_observations(self.begin(key, assistance)))

    def begin(self, key: jax.Array, assistance: jax.Array | float = 0.0) -> TeamEnvState:
        """Returns the state of `reset` without observations."""
        match = self.match.begin(key, assistance)
        sizes = self.match.group_sizes
        agents = self.match.num_agents
        state = TeamEnvState(
            **vars(match),
            everyone=match.active,
            rival_groups={name: jnp.zeros((agents, sizes[name])) for name in self.seats.groups},
            rival_memory=self.seats.initial_memory(1),
        )
        return self._of_team(state)

    @single
    def step(self, state: State, action: jax.Array) -> TeamEnvState:
        """Advances by one environment step with the actions of team 0 (T, action_size)."""
        return with_final(self.with_observations(self.advance(state, action)))

    def advance(self, state: State, action: jax.Array) -> TeamEnvState:
        """Returns the state of `step`, still with the observations of the state before."""
        check("state", state, TeamEnvState)
        shape = (self.num_agents, self.match.action_size)
        if jnp.shape(action) != shape:
            raise InputError(
                f"action: shape {jnp.shape(action)}; expected {shape} (agents, action size)"
            )
        own: Any = state  # a `TeamEnvState`; the match's step keeps its further fields
        own = dataclasses.replace(own, active=own.everyone)
        key = jax.random.fold_in(own.key, keys.OPPONENT)
        groups = {name: x[None] for name, x in own.rival_groups.items()}
        seen = Observations(groups, own.active[None])
        action = jnp.asarray(action, jnp.float32)
        both = jnp.concatenate([action, jnp.zeros_like(action)])[None]
        both, memory = self.seats.act(seen, own.rival_memory, key, both)
        after: Any = self.match.advance(own, both[0])
        return self._of_team(dataclasses.replace(after, rival_memory=memory))

    def with_observations(self, state: TeamEnvState, groups: Sequence[str] = ()) -> TeamEnvState:
        """Returns the state with its observations of the group `policy` and further groups.

        Those that the opponent sees are among them.
        """
        state = dataclasses.replace(state, active=state.everyone)
        seen: Any = self.match.with_observations(state, (*groups, *self.seats.groups))
        rival_groups = {name: seen.groups[name] for name in self.seats.groups}
        return dataclasses.replace(self._of_team(seen), rival_groups=rival_groups)

    def _of_team(self, state: TeamEnvState) -> TeamEnvState:
        """Returns a state of the match as team 0 sees it."""
        return dataclasses.replace(state, **team_view(state, self.num_agents))


TaskEnv = QuadrupedEnv | TeamEnv
"""What the adapters adapt: a task, or a match against an opponent."""
