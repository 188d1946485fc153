"""Who acts for which agents of an environment: `Seats`, and the protocol `Policy`."""

import dataclasses
import functools
from collections.abc import Callable, Hashable, Iterable, Sequence
from pathlib import Path
from typing import Any, Protocol, Self

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core.errors import InputError
from mqe_jax.core.precision import single
from mqe_jax.core.settings import fail
from mqe_jax.core.types import (
    Memory,
    Observations,
    is_typed_key,
    rows_of,
    shapes_of,
    teams_of,
    where_rows,
)

Act = Callable[[Any, Memory, jax.Array], tuple[jax.Array, Memory]]
"""Traceable `act(obs (N, A, O), memory, key) -> (action (N, A, D), memory)`."""


class Policy(Protocol):
    """Whatever acts for a team of A agents in N environments.

    Its functions are pure, and usable inside compiled code. `initial_memory(num_envs)` returns the
    recurrent state at an episode's start, leading axis N. `act(obs, memory, key) -> (action,
    memory)` maps observations (N, A, O) to actions (N, A, D) in [-1, 1]. A policy with `groups`,
    the names of the observation groups that it sees, gets `Observations`.
    """

    @property
    def task(self) -> str:
        """Id of the task."""
        ...

    @property
    def agents(self) -> int:
        """Number of agents of the team, A."""
        ...

    def initial_memory(self, num_envs: int) -> Memory: ...
    def act(self, obs: Any, memory: Memory, key: jax.Array) -> tuple[jax.Array, Memory]: ...


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Fixed:
    """A policy that cannot be exchanged within a compiled program, which knows it by identity.

    A policy may have an `identity`, which is equal for policies that act alike.
    """

    policy: Any
    """The policy; one without `groups` gets the observations of the group `policy` as an array."""

    @property
    def _identity(self) -> Hashable:
        identity = getattr(self.policy, "identity", None)
        return id(self.policy) if identity is None else identity

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Fixed) and self._identity == other._identity

    def __hash__(self) -> int:
        return hash(self._identity)

    def __repr__(self) -> str:
        return repr(self.policy)

    @property
    def groups(self) -> tuple[str, ...]:
        """The groups of observations that it sees."""
        return tuple(getattr(self.policy, "groups", ("policy",)))

    def initial_memory(self, num_envs: int) -> Memory:
        """Returns the recurrent state at an episode's start, leading axis N."""
        return self.policy.initial_memory(num_envs)

    def act(self, seen: Observations, memory: Memory, key: jax.Array) -> tuple[jax.Array, Memory]:
        """Returns the actions (N, A, D) and the next recurrent state."""
        obs = seen if hasattr(self.policy, "groups") else seen.obs
        return self.policy.act(obs, memory, key)


def actor_of(policy: Policy) -> Any:
    """Returns the `actor` of a policy with a `form`, a trained one; of any other a `Fixed`."""
    either: Any = policy
    return either.actor if hasattr(either, "form") else Fixed(policy)


def groups_of(policies: Iterable[Policy]) -> frozenset[str]:
    """Returns the groups of observations that policies see, which `VectorEnv.with_groups` adds."""
    return frozenset(name for policy in policies for name in actor_of(policy).groups)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class OneOf:
    """One of several policies of different forms, which an index chooses."""

    policies: tuple[Any, ...]
    index: jax.Array  # () int32

    @property
    def groups(self) -> tuple[str, ...]:
        """The groups of observations that the policies see."""
        return tuple(name for policy in self.policies for name in policy.groups)

    def initial_memory(self, num_envs: int) -> tuple[Memory, ...]:
        """Returns the recurrent states of all policies."""
        return tuple(policy.initial_memory(num_envs) for policy in self.policies)

    def act(
        self, seen: Observations, memory: tuple[Memory, ...], key: jax.Array
    ) -> tuple[jax.Array, tuple[Memory, ...]]:
        """Returns the actions (N, A, D) of the chosen policy, and the recurrent states.

        These include the next state of the chosen policy.
        """

        def turn(place: int) -> tuple[jax.Array, tuple[Memory, ...]]:
            action, own = self.policies[place].act(seen, memory[place], key)
            return jnp.asarray(action, jnp.float32), (*memory[:place], own, *memory[place + 1 :])

        turns = [functools.partial(turn, place) for place in range(len(self.policies))]
        return jax.lax.switch(self.index, turns)


def exchangeable(policies: Sequence[Policy]) -> list[Any]:
    """Returns policies as pytrees of one structure, which compiled code can exchange and stack.

    Each is its actor, or `OneOf` if the policies have several forms.
    """
    actors = [actor_of(policy) for policy in policies]
    forms = [jax.tree.structure(actor) for actor in actors]
    kinds = dict(zip(forms, actors, strict=True))
    if len(kinds) == 1:
        return actors
    place = {form: index for index, form in enumerate(kinds)}
    return [
        OneOf(tuple((kinds | {form: actor}).values()), jnp.int32(place[form]))
        for form, actor in zip(forms, actors, strict=True)
    ]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Seat:
    """A policy, and the agents of a block of environments for which it acts."""

    policy: Any
    """A pytree with `groups`, `initial_memory` and `act`, such as an `Actor` or `Fixed`."""
    sees: tuple[int, ...] = dataclasses.field(metadata={"static": True})
    """Agents whose observations the policy gets: its team, in the policy's order."""
    acts: tuple[int, ...] = dataclasses.field(metadata={"static": True})
    """Those of them for which its actions count."""
    block: tuple[int, int] = dataclasses.field(default=(0, 1), metadata={"static": True})
    """The environments `first, first + step, ...`, as `(first, step)`."""

    def rows(self, num_envs: int) -> slice:
        """Returns the environments of the block among `num_envs`."""
        first, step = self.block
        return slice(first, num_envs, step)

    def count(self, num_envs: int) -> int:
        """Returns the number of the block's environments among `num_envs`."""
        return len(range(num_envs)[self.rows(num_envs)])

    def initial_memory(self, num_envs: int) -> Memory:
        """Returns the recurrent state of the block's environments at an episode's start."""
        return self.policy.initial_memory(self.count(num_envs))

    def act(
        self, seen: Observations, memory: Memory, key: jax.Array, action: jax.Array
    ) -> tuple[jax.Array, Memory]:
        """Returns all agents' actions with this policy's, and its next recurrent state.

        `action` (N, A, D) has the actions of all agents; see `Seats.act`.
        """
        rows = self.rows(len(action))
        own = jax.tree.map(lambda x: x[rows, rows_of(self.sees)], seen)
        shape = (self.count(len(action)), len(self.sees), action.shape[-1])
        chosen, memory = _check_act(self.policy.act(own, memory, key), shape, memory)
        chosen = chosen[:, rows_of(tuple(self.sees.index(agent) for agent in self.acts))]
        return action.at[rows, rows_of(self.acts)].set(chosen), memory


def action_and_memory(returned: Any) -> tuple[Any, Any]:
    """Returns the two values that a policy's `act` returned; InputError for anything else."""
    if not isinstance(returned, tuple | list) or len(returned) != 2:
        kind = "an array" if hasattr(returned, "shape") else type(returned).__name__
        fail("policy", f"a function that returns {kind}", "one that returns (action, memory)")
    return returned[0], returned[1]


def title(policy: Any) -> str:
    """Returns how messages and tables name a policy, which may be a name, a path or a function."""
    if isinstance(policy, Fixed):
        return title(policy.policy)
    own = getattr(policy, "__name__", "") or getattr(policy, "name", "")
    return str(policy) if isinstance(policy, Path) else str(own or policy)


def check_actions(action: Any, shape: tuple[int, ...], name: str = "a function") -> None:
    """Raises an InputError for actions of a policy that have another shape than the passed one."""
    expected = shapes_of(jax.ShapeDtypeStruct(shape, jnp.float32))
    if shapes_of(action) != expected or is_typed_key(action):
        given = getattr(action, "shape", type(action).__name__)
        fail("policy", f"{name} that returns actions {given}", f"one that returns {shape}")


def _check_act(returned: Any, shape: tuple[int, ...], memory: Memory) -> tuple[jax.Array, Memory]:
    """Returns what a policy's `act` returned: actions, and a recurrent state like its `memory`.

    Actions have the passed shape. InputError for anything else.
    """
    action, after = action_and_memory(returned)
    check_actions(action, shape)
    if shapes_of(after) != shapes_of(memory):
        fail("policy", "a function that changes its memory's structure", "one that keeps it")
    return action, after


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Seats:
    """Policies that together act for all agents of N environments.

    Trained policies of equal form have equal structures: compiled functions take seats as
    arguments, so that policies are exchanged and stacked without compiling again.

    Example:
        ```python
        from mqe_jax.acting.evaluate import evaluate_batch
        from mqe_jax.acting.seats import Seats

        batch = mqe_jax.VectorEnv(mqe_jax.make("go1tug", impl="c", episode_length=1.0), 4)
        teams = [mqe_jax.load_policy(name, batch.env) for name in ("forward", "idle")]
        print(evaluate_batch(batch, Seats.of_teams(batch, *teams), 4, jax.random.PRNGKey(0)).win)
        ```
    """

    seats: tuple[Seat, ...]

    @classmethod
    def of_teams(cls, env: Any, *policies: Policy) -> Self:
        """Returns the seats of a policy for each team of an environment."""
        teams = teams_of(env)
        if len(policies) != len(teams):
            fail("policy", f"{len(policies)} policies", f"one for each team of {env.name}")
        for policy in policies:
            check_policy(policy, env)
        return cls(
            tuple(
                Seat(actor_of(policy), team, team)
                for policy, team in zip(policies, teams, strict=True)
            )
        )

    @classmethod
    def of(cls, env: Any, policy: "Seats | Policy | Act", memory: Memory = ()) -> "Seats":
        """Returns seats as they are, or that of a policy of all agents.

        It may be a function like a policy's `act`, whose initial recurrent state is `memory`.

        Raises:
            InputError: for a policy of another task or of a part of the agents, and for a `memory`
                of a policy, which brings its own.
        """
        either: Any = policy
        agents = tuple(range(env.num_agents))
        if not isinstance(either, Seats) and not hasattr(either, "act"):
            return cls((Seat(Fixed(_Function(either, memory)), agents, agents),))
        if jax.tree.leaves(memory):
            fail("memory", "an array", "() for a policy, which brings its own")
        if isinstance(either, Seats):
            if {agent for seat in either.seats for agent in seat.acts} != {*agents}:
                fail("policy", either, f"seats of all {env.num_agents} agents of {env.name}")
            return either
        if (trained := getattr(either, "task", "")) and trained != env.name:
            fail("policy", f"one of {trained}", f"one of {env.name}; pass its `act` instead")
        if (own := getattr(either, "agents", env.num_agents)) != env.num_agents:
            allowed = f"one of all {env.num_agents}; `Seats.of_teams` takes one for each team"
            fail("policy", f"one of {own} agents", allowed)
        if hasattr(either, "unmet"):
            check_policy(either, env)
        return cls((Seat(actor_of(either), agents, agents),))

    def fixed(self) -> Self:
        """Returns seats without arrays, whose policies are constants of a compiled program."""
        fixed = [dataclasses.replace(seat, policy=Fixed(seat.policy)) for seat in self.seats]
        return dataclasses.replace(self, seats=tuple(fixed))

    @property
    def groups(self) -> frozenset[str]:
        """The groups of observations that the policies see, which `VectorEnv.with_groups` adds."""
        return frozenset(name for seat in self.seats for name in seat.policy.groups)

    def initial_memory(self, num_envs: int) -> tuple[Memory, ...]:
        """Returns the recurrent states at an episode's start, one for each seat."""
        return tuple(seat.initial_memory(num_envs) for seat in self.seats)

    @single
    def act(
        self, seen: Observations, memory: tuple[Memory, ...], key: Any, action: jax.Array
    ) -> tuple[jax.Array, tuple[Memory, ...]]:
        """Returns `action` (N, A, D) with the actions of all seats, and the next recurrent states.

        `key` is a tuple of random keys, one for each seat, or one key. A single seat uses that as
        it is, several split it.

        Raises:
            InputError: for actions of another shape, or another recurrent state.
        """
        keys = key
        if not isinstance(key, tuple):
            several = len(self.seats) > 1
            keys = jax.random.split(key, len(self.seats)) if several else (key,)
        after = []
        for seat, own, own_key in zip(self.seats, memory, keys, strict=True):
            action, own = seat.act(seen, own, own_key, action)
            after.append(own)
        return action, tuple(after)

    def restart(self, memory: tuple[Memory, ...], done: jax.Array) -> tuple[Memory, ...]:
        """Returns the recurrent states, those at an episode's start where one ended (N,) bool."""
        return tuple(
            where_rows(done[seat.rows(len(done))], first, own)
            for seat, first, own in zip(
                self.seats, self.initial_memory(len(done)), memory, strict=True
            )
        )


@dataclasses.dataclass(frozen=True)
class _Function:
    """A function like a policy's `act`, with its initial recurrent state, as a policy."""

    act: Act
    memory: Memory

    def initial_memory(self, num_envs: int) -> Memory:
        for leaf in jax.tree.leaves(self.memory):
            if np.shape(leaf)[:1] != (num_envs,):
                allowed = f"arrays with a leading axis of {num_envs}, the environments"
                fail("memory", self.memory, allowed)
        return self.memory


def check_policy(policy: Policy, env: Any, name: str = "policy", field: str = "policy") -> None:
    """Checks that a policy fits an environment, a task or a batch of it.

    It compares the task, the agents, and what the policy finds `unmet`, as a trained policy does.

    Raises:
        InputError: naming `field`, the policy and what differs, with the values of both.
    """
    pairs: dict[str, tuple[Any, Any]] = {
        "task": (policy.task, env.name),
        "agents": (policy.agents, len(teams_of(env)[0])),
    }
    unmet = getattr(policy, "unmet", None)
    if unmet is not None and all(own == found for own, found in pairs.values()):
        pairs = unmet(env)
    for need, (value, found) in pairs.items():
        if value != found:
            raise InputError(
                f"{field}: {name} needs {need} {value!r}; the environment has {found!r}"
            )
