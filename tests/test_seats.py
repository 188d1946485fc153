"""Seats: which policies act for which agents of which environments."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax.acting.seats import Fixed, Seat, Seats, actor_of
from mqe_jax.core.types import Observations
from tests.inputs import refuses

KEY = jax.random.PRNGKey(0)
ENV = SimpleNamespace(name="fake", num_agents=3, action_size=2, teams=((0, 2), (1,)))
SEEN = Observations.at(jnp.arange(5 * 3.0).reshape(5, 3, 1))


class Adding:
    """Acts by the sum of a number, its observation and its recurrent state, which counts steps."""

    task = "fake"

    def __init__(self, number: float, agents: int = 1, actor: Any = None) -> None:
        self.number = number
        self.agents = agents
        self.actor = actor

    def initial_memory(self, num_envs: int) -> jax.Array:
        return jnp.zeros(num_envs)

    def act(self, obs: Any, memory: Any, key: Any) -> Any:
        return jnp.tile(self.number + obs + memory[:, None, None], 2), memory + 1


def test_policies_act_for_their_agents_of_their_environments() -> None:
    """Agents need not be neighbours; actions of others stay, also those of mates."""
    seats = Seats(
        (
            Seat(Fixed(Adding(100.0)), (0, 2), (2,), (0, 2)),
            Seat(Fixed(Adding(200.0)), (1, 2), (1, 2), (1, 2)),
        )
    )
    memory = seats.initial_memory(5)
    assert [len(own) for own in memory] == [3, 2]
    expected = np.full((5, 3), -1.0)
    expected[::2, 2] = 100.0 + np.arange(5)[::2] * 3 + 2
    expected[1::2, 1:] = 200.0 + np.arange(15).reshape(5, 3)[1::2, 1:]
    before = jnp.full((5, 3, 2), -1.0)
    action, memory = jax.jit(seats.act)(SEEN, memory, KEY, before)
    np.testing.assert_array_equal(action[..., 0], expected)
    done = jnp.array([True, True, False, False, False])
    restarted = seats.restart(memory, done)
    np.testing.assert_array_equal(restarted[0], [0, 1, 1])
    np.testing.assert_array_equal(restarted[1], [0, 1])


def test_a_seat_alone_uses_the_key_and_several_split_it() -> None:
    def draw(obs: Any, memory: Any, key: jax.Array) -> Any:
        return jax.random.uniform(key, (len(obs), obs.shape[1], 2)), memory

    agents = (0, 1, 2)
    alone = Seats.of(ENV, draw)
    several = Seats(tuple(Seat(alone.seats[0].policy, agents, (agent,)) for agent in agents))
    keys = tuple(jax.random.split(KEY, 3))
    still = jnp.zeros((5, 3, 2))
    own = [draw(SEEN.obs, (), key)[0] for key in (KEY, *keys)]
    np.testing.assert_array_equal(alone.act(SEEN, ((),), KEY, still)[0], own[0])
    expected = jnp.stack([own[1][:, 0], own[2][:, 1], own[3][:, 2]], axis=1)
    for key in (KEY, keys):
        np.testing.assert_array_equal(several.act(SEEN, ((),) * 3, key, still)[0], expected)


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (lambda memory: jnp.zeros((5, 3, 2)), r"returns \w+' is not allowed.*\(action, memory\)"),
        (lambda memory: (jnp.zeros((5, 2, 2)), memory), r"actions \(5, 2, 2\)'.*\(5, 3, 2\)"),
        (lambda memory: (jnp.zeros((5, 3, 2)), (memory, memory)), "memory's structure"),
    ],
)
def test_what_a_policy_returns_is_checked(returned: Any, message: str) -> None:
    seats = Seats.of(ENV, lambda obs, memory, key: returned(memory))
    refuses(f"policy: .*{message}", seats.act, SEEN, ((),), KEY, jnp.zeros((5, 3, 2)))


def test_seats_are_of_all_teams() -> None:
    pair = Adding(1.0, 2)
    refuses("policy: '1 policies' .* one for each team of fake", Seats.of_teams, ENV, pair)
    refuses("policy: 'one of 2 agents' .* one of all 3", Seats.of, ENV, pair)
    part = Seats((Seat(Fixed(pair), (0, 2), (0, 2)),))
    refuses("policy: .* seats of all 3 agents of fake", Seats.of, ENV, part)


def test_a_policy_with_an_attribute_of_its_own_acts_itself() -> None:
    policy = Adding(1.0, actor="a network of another library")
    assert actor_of(policy) == Fixed(policy)
