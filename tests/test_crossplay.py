"""Seats: which policies act for which agents of which environments. Mixed teams: each agent follows
its own policy, and success is that of the policies' places.
"""

import dataclasses
import itertools
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax.acting.results import Rate
from mqe_jax.acting.seats import Fixed, Seat, Seats, actor_of, exchangeable
from mqe_jax.core.types import Observations
from mqe_jax.envs import make
from mqe_jax.names import load_policy
from mqe_jax.policies.simple import SimplePolicy
from mqe_jax.selfplay.league import games
from mqe_jax.selfplay.league.crossplay import CrossPlay, cross_play
from mqe_jax.selfplay.league.games import Estimate
from mqe_jax.selfplay.league.tournament import Standings, rate
from tests import fake_env
from tests.inputs import refuses

KEY = jax.random.PRNGKey(0)
OTHER = Path(__file__).parents[1] / "results" / "cooperative" / "go1gate-seed10.safetensors"


def test_each_agent_does_what_its_own_policy_does_for_it() -> None:
    """Of policies that are exchanged as arrays, of another architecture, and scripted ones; with
    recurrent states.
    """
    env = make("go1gate", impl="c", num_envs=1)
    trained: Any = load_policy("go1gate", env, deterministic=True)
    changed = dataclasses.replace(
        trained, params=jax.tree.map(lambda x: 0.9 * jnp.asarray(x), trained.params)
    )
    policies = (
        trained,
        load_policy("scripted", env),
        changed,
        load_policy(OTHER, env, deterministic=True),
    )
    seen = Observations.at(jax.random.normal(KEY, (3, 2, 16)))
    memories = [policy.initial_memory(3) for policy in policies]
    actors = exchangeable(policies)
    pairs = [*itertools.product(range(4), repeat=2)]
    teams = [
        Seats((Seat(actors[i], (0, 1), (0,)), Seat(actors[j], (0, 1), (1,)))) for i, j in pairs
    ]
    traced = []

    @jax.jit
    @jax.vmap
    def act(seats: Seats, memory: Any) -> Any:
        traced.append(1)
        return seats.act(seen, memory, KEY, jnp.zeros((3, 2, 3)))

    memory = jax.tree.map(lambda *x: jnp.stack(x), *(team.initial_memory(3) for team in teams))
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *teams)
    actions = jnp.zeros(())
    for _ in range(2):
        own = [
            policy.act(seen if hasattr(policy, "groups") else seen.obs, now, KEY)
            for policy, now in zip(policies, memories, strict=True)
        ]
        memories = [now for _, now in own]
        actions, memory = act(stacked, memory)
        for (first, second), action in zip(pairs, actions, strict=True):
            expected = jnp.stack([own[first][0][:, 0], own[second][0][:, 1]], axis=1)
            np.testing.assert_allclose(action, expected, atol=1e-5)
    assert len({np.asarray(action).tobytes() for action in actions}) == 16
    assert len(traced) == 1


def simple(*forward: float) -> SimplePolicy:
    """A policy of the fake task, in which each robot moves by a tenth of a metre times its number a
    step.
    """
    action = jnp.array(forward)[:, None] * jnp.array([1.0, 0.0, 0.0])
    return SimplePolicy("fake", 2, lambda obs, key: jnp.tile(action, (len(obs), 1, 1)))


def test_success_is_that_of_the_places_and_one_program_serves_all_teams() -> None:
    """The fake task succeeds if both robots move; the program of a row is traced once."""
    traced = []

    def sometimes(obs: jax.Array, key: jax.Array) -> jax.Array:
        traced.append(1)
        return jnp.tile((jax.random.uniform(key, (len(obs), 1, 1)) < 0.24).astype(float), (1, 2, 3))

    batch: Any = fake_env.FakeVectorEnv(fake_env.FakeEnv(), 64)
    policies = {"both": simple(1, 1), "first": simple(1, 0), "none": simple(0, 0)}
    policies["sometimes"] = SimplePolicy("fake", 2, sometimes)
    rates = cross_play(batch, policies, 64, KEY)
    assert rates[:3, :3].tolist() == [[1, 0, 0], [1, 0, 0], [0, 0, 0]]
    chances = rates[[0, 1, 3], [3, 3, 0]]
    assert np.all((0.1 < chances) & (chances < 0.7)) and len(set(chances)) > 1
    assert len(traced) <= 4  # both seats, and a trace of shapes
    broken = {"own": simple(1, 1), "runs/broken": simple(np.nan, 1)}
    batch = fake_env.FakeVectorEnv(fake_env.FakeEnv(), 2)
    refuses("^policy: runs/broken returns actions with NaN", cross_play, batch, broken, 2, KEY)


def test_tables_are_80_columns_wide_and_have_intervals(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(games, "_SAMPLES", 50)
    names = tuple(f"runs/{'x' * 60}{i}" for i in range(21))
    success = np.random.default_rng(0).integers(0, 17, size=(21, 21)) / 16
    results = np.zeros((21, 21, 3), int)
    results[np.triu_indices(21, 1)] = [8, 0, 0]
    shown = CrossPlay("go1gate", names[:19], ("scripted", "idle"), 16, success, "walk: vx -1 to 1")
    standings = Standings("go1tug", names, results, rate(results, 20), "walk: vx -1 to 1")
    for text in (repr(shown), repr(standings)):
        assert max(map(len, text.splitlines())) <= 80
    assert f"{Estimate(*Rate.of(success[3, 20], 16)).text()}" in repr(shown)
    found = shown.to_dict()
    pairs = list(itertools.permutations(range(19), 2))
    assert found["worst"]["value"] == min(success[pair] for pair in pairs)
    assert found["cross"] == pytest.approx(np.mean([success[pair] for pair in pairs]))
    assert "0 +100 (+" in repr(standings) and " +100*" in repr(standings)


def test_a_cooperative_task_is_played_by_mixed_teams(tmp_path: Path, mqe: Any) -> None:
    words = "go1gate random --impl c --set episode_length=0.1 --control position --episodes 2"
    found = json.loads(mqe(f"tournament {words} --json -o", tmp_path).out)
    assert found["policies"] == ["random"] and found["references"] == ["idle"]
    assert found["worst"] is None and np.shape(found["success"]["value"]) == (2, 2)
    rows = (tmp_path / "tournament.csv").read_text().splitlines()
    assert rows[2].startswith("random,idle,2,0.0000,0.0000,0.6") and len(rows) == 5
    assert found["skill"] == "none, control position" and f'"{found["skill"]}"' in rows[2]
    assert (tmp_path / "tournament.png").stat().st_size > 3000


def test_a_task_of_one_agent_has_no_mates() -> None:
    batch: Any = fake_env.FakeVectorEnv(fake_env.FakeEnv(), 2)
    batch.num_agents = 1
    refuses(
        r"task: 'fake' .* one of a team of several agents",
        cross_play,
        batch,
        {"a": dataclasses.replace(simple(1), agents=1)},
        2,
        KEY,
    )


# -- seats


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
        (
            lambda memory: jnp.zeros((5, 3, 2)),
            r"returns an array' is not allowed.*\(action, memory\)",
        ),
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
