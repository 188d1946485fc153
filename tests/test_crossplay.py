"""Mixed teams: each agent follows its own policy, and success is that of the policies' places."""

import dataclasses
import itertools
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax.acting.results import Rate
from mqe_jax.acting.seats import Seat, Seats, exchangeable
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


def test_tables_are_80_columns_wide_and_have_intervals(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(games, "_SAMPLES", 50)
    names = tuple(f"runs/{'x' * 60}{i}" for i in range(21))
    success = np.random.default_rng(0).integers(0, 17, size=(21, 21)) / 16
    results = np.zeros((21, 21, 3), int)
    results[np.triu_indices(21, 1)] = [8, 0, 0]
    shown = CrossPlay("go1gate", names[:19], ("scripted", "idle"), 16, success)
    standings = Standings("go1tug", names, results, rate(results, 20))
    for text in (repr(shown), repr(standings)):
        assert max(map(len, text.splitlines())) <= 80
    assert f"{Estimate(*Rate.of(success[3, 20], 16)).text()}" in repr(shown)
    found = shown.to_dict()
    pairs = list(itertools.permutations(range(19), 2))
    assert found["worst"]["value"] == min(success[pair] for pair in pairs)
    assert found["cross"] == pytest.approx(np.mean([success[pair] for pair in pairs]))
    assert "\n 1 +100 (+" in repr(standings)


def test_a_cooperative_task_is_played_by_mixed_teams(tmp_path: Path, mqe: Any) -> None:
    words = "go1gate random --impl c --set episode_length=0.1 --control position --episodes 2"
    found = json.loads(mqe(f"tournament {words} --json -o", tmp_path).out)
    assert found["policies"] == ["random"] and found["references"] == ["idle"]
    assert found["worst"] is None and np.shape(found["success"]["value"]) == (2, 2)
    rows = (tmp_path / "tournament.csv").read_text().splitlines()
    assert rows[2].startswith("random,idle,2,0.0000,0.0000,0.6") and len(rows) == 5
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
