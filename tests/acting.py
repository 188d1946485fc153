"""Functions of parameters as policies, for tests of evaluations."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax

from mqe_jax.acting.seats import Seat, Seats
from mqe_jax.core.types import Memory, Observations


def no_memory(num_envs: int) -> Memory:
    """Returns the recurrent state of a policy without one."""
    return ()


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Acting:
    """The policy `function(params, seen, memory, key)`."""

    params: Any
    function: Callable[..., Any] = dataclasses.field(metadata={"static": True})
    initial_memory: Callable[[int], Any] = dataclasses.field(metadata={"static": True})
    groups = ("policy",)

    def act(self, seen: Observations, memory: Memory, key: jax.Array) -> Any:
        return self.function(self.params, seen, memory, key)


def seats(
    env: Any,
    function: Callable[..., Any],
    params: Any = None,
    memory: Callable[[int], Any] = no_memory,
) -> Seats:
    """Returns the seats of a function of parameters that acts for all agents of an environment."""
    agents = tuple(range(env.num_agents))
    return Seats((Seat(Acting(params, function, memory), agents, agents),))
