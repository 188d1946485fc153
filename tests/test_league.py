"""Leagues: the pool of earlier policies, who plays whom in training, and runs with a pool that are
resumed.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax import cli
from mqe_jax.acting.seats import Policy
from mqe_jax.core.settings import build, override, to_mapping
from mqe_jax.core.types import Cast
from mqe_jax.envs import make
from mqe_jax.envs.wrappers import Deadline
from mqe_jax.names import load_policy, versus
from mqe_jax.presets import resolve
from mqe_jax.runs import cast, playing
from mqe_jax.selfplay.league import tournament
from mqe_jax.selfplay.league.league import League
from mqe_jax.train.checkpoint import list_checkpoints, save_checkpoint
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.learner import TrainState
from mqe_jax.train.needs import needs_of
from mqe_jax.train.policy import policy_of
from mqe_jax.train.seeds import SeedBatch
from mqe_jax.train.start import first_state, own_learner, without_environments
from tests.inputs import refuses
from tests.test_opponents import KEY, MATCHES, SETTINGS, matches
from tests.training import assert_same_run, content, updated

SOURCES = ("newest", "older", "uniform", "idle")
SMALL = {"members": 4, "snapshot_steps": 32, "snapshot_win_rate": 1.0, "episodes": 1}


def fixed() -> dict[str, Policy]:
    """The opponents of `SOURCES` that no training changes."""
    return {"idle": load_policy("idle", matches(num_envs=8).env)}


def config_of(sources: tuple[str, ...] = SOURCES, **settings: Any) -> TrainConfig:
    whole = {**SETTINGS, "num_envs": 8, "total_steps": 512, "opponents": sources, "league": SMALL}
    return build(
        TrainConfig, {**whole, "network": {"recurrent": False, "hidden_sizes": [8]}, **settings}
    )


@pytest.fixture(scope="module")
def history() -> list[TrainState]:
    """States of a training after each update; episodes have ten steps, a rollout four, a snapshot
    is due every one.
    """
    config = config_of()
    league = League(matches(num_envs=8), config, fixed())
    return updated(league.env, config, 9, league=league)[0]


def test_the_policy_joins_the_pool_and_plays_against_itself(history: list[TrainState]) -> None:
    assert [int(jnp.sum(state.extra.pool.born >= 0)) for state in history[:5]] == [1, 2, 3, 4, 4]
    network = config_of().network.build(needs_of(versus(matches(), ["idle"]), config_of()).dims)
    for state in history:
        newest, older, uniform, idle = state.rollout.env_state.opponents
        jax.tree.map(
            np.testing.assert_array_equal, newest.arrays.params, network.policy_params(state.params)
        )
        assert not bool(newest.waiting.any()) and idle.arrays == ()
        for block, opponent in ((1, older), (2, uniform)):
            member = int(state.extra.member[block])
            assert int(state.extra.pool.born[member]) >= 0
            of_pool = jax.tree.map(lambda x: x[member], state.extra.pool.arrays)  # noqa: B023
            jax.tree.map(np.testing.assert_array_equal, opponent.arrays, of_pool)


@pytest.mark.parametrize("resumed", [False, True])
def test_a_league_begins_with_its_policies(
    resumed: bool, history: list[TrainState], tmp_path: Path
) -> None:
    """With that it starts from or, resumed without environments, with its members."""
    start: dict[str, Any] = {} if resumed else {"start": "history"}
    config = config_of(**start)
    state = history[9]
    file = None
    league = League(matches(num_envs=8), config, fixed())
    if resumed:
        metadata = {"task": league.env.name, "config": to_mapping(config), "environments": False}
        file = save_checkpoint(
            tmp_path, without_environments(state), 9 * config.steps_per_update, metadata, keep=1
        )
    policy = None if resumed else policy_of(state, league.env, config, env_steps=0)
    cast = Cast(league.env, league=league, start=policy)
    learner, processes = own_learner(cast, config)
    shared = SeedBatch(learner.init, 1).shared
    begun, _ = first_state(cast, learner, processes, config, file, shared)
    seats, before = (
        [seat.arrays for seat in each.rollout.env_state.opponents] for each in (begun, state)
    )
    mine = league._own(begun)
    jax.tree.map(np.testing.assert_array_equal, mine.params, league._own(state).params)
    jax.tree.map(
        np.testing.assert_array_equal, seats, before if resumed else [mine] * 3 + seats[3:]
    )
    if not resumed:
        jax.tree.map(
            lambda x, own: np.testing.assert_array_equal(x[0], own), begun.extra.pool.arrays, mine
        )


def test_a_block_plays_another_member_after_its_episodes(history: list[TrainState]) -> None:
    """All episodes end in steps 10, 20 and 30: in updates 3, 5 and 8."""
    waiting = [bool(state.rollout.env_state.opponents[1].waiting.any()) for state in history]
    assert waiting[3] and not waiting[2]
    assert not waiting[5]  # their episodes ended, and those against the new member have begun
    games = [float(jnp.sum(state.extra.pool.games)) for state in history]
    assert games[2] == 0 and games[3] == pytest.approx(4) and games[8] > games[5]
    assert all(
        not bool(o.outcomes.any())
        for state in history[1:]
        for o in state.rollout.env_state.opponents
    )


def test_outcomes_are_counted_once_and_a_draw_can_cost() -> None:
    env = versus(matches(), ["idle", "forward"], draw_reward=-2.0)
    step = jax.jit(env.step)
    still = jnp.zeros((4, 1, 12))
    state = env.reset(KEY)
    for i in range(10):
        state = step(state, still)
        np.testing.assert_allclose(state.reward - state.match.reward[:, :1], 0.0)
        assert float(state.reward.min()) < -1.0 if i == 9 else float(state.reward.min()) > -1.0
    assert [opponent.outcomes.tolist() for opponent in state.opponents] == [[0, 2, 0], [0, 2, 0]]
    waiting = dataclasses.replace(state.opponents[0], waiting=jnp.ones(2, bool))
    state = dataclasses.replace(state, opponents=(waiting, state.opponents[1]))
    for _ in range(10):
        state = step(state, still)
    assert [opponent.outcomes.tolist() for opponent in state.opponents] == [[0, 2, 0], [0, 4, 0]]


@pytest.mark.parametrize("task", ["go1revolvingdoor", "go1gate"])
def test_the_time_limit_may_end_episodes_for_the_learner(task: str) -> None:
    inner = matches(task)
    env = Deadline(inner) if task == "go1gate" else versus(Deadline(inner), ["idle"])
    step = jax.jit(env.step)
    still = jnp.zeros((4, env.num_agents, 12))
    state = jax.jit(env.reset)(KEY)
    assert state.privileged_obs.shape[1] == env.privileged_observation_size
    for i in range(10):
        np.testing.assert_allclose(state.privileged_obs[:, -1], 1.0 - 0.1 * i, atol=1e-6)
        state = step(state, still)
        np.testing.assert_allclose(state.final_privileged_obs[:, -1], 0.9 - 0.1 * i, atol=1e-6)
        assert not state.truncated.any() and bool(state.terminated.all()) == (i == 9)
    np.testing.assert_allclose(state.privileged_obs[:, -1], 1.0)


def test_a_league_has_more_members_than_blocks_and_environments_of_its_own_process() -> None:
    few = config_of(league={**SMALL, "members": 2})
    refuses(
        "league.members: 2 .*more than the blocks that play members, 2",
        League,
        matches(num_envs=8),
        few,
    )
    env = League(matches(num_envs=8), config_of(), fixed()).env.share(2)
    assert env.num_envs == env.inner.num_envs == 4


def training(steps: int, *more: str) -> list[str]:
    """Arguments of a training of `go1tug` in a league, with a snapshot every update of 16 steps."""
    words = (
        "train go1tug --impl c --set control=position --set episode_length=0.1 --num-envs 4"
        " --rollout-steps 4 --ppo.minibatches 1 --ppo.epochs 1 --network.hidden-sizes 8 --config"
        " paper/mappo --league.snapshot-steps 16 --league.episodes 1 --league.members 3"
        f" --total-steps {steps}"
    ).split()
    return [*words, *more, *(word for source in SOURCES for word in ("--opponent", source))]


@pytest.mark.soak
def test_a_resumed_league_equals_an_uninterrupted_one(tmp_path: Path) -> None:
    evaluations = ["--evaluation.every", "4", "--evaluation.episodes", "2"]
    arguments = training(96, "--checkpoint.every", "2", "--num-seeds", "2", *evaluations)
    whole = tmp_path / "whole"
    halves = tmp_path / "halves"
    assert cli.main([*arguments, "--run-dir", str(whole)]) == 0
    assert cli.main([*arguments, "--run-dir", str(halves)]) == 0
    for seed in ("seed0", "seed1"):
        max(list_checkpoints(halves / seed)).unlink()
    assert cli.main([*arguments, "--run-dir", str(halves), "--resume"]) == 0
    for seed in ("seed0", "seed1"):
        assert_same_run(whole / seed, halves / seed)
        assert "checkpoint/extra/pool/rating" in content(whole / seed)
    header = (whole / "seed0" / "metrics.csv").read_text().splitlines()[0].split(",")
    assert {"league/win/newest", "league/loss/idle", "league/rating", "league/members"} <= set(
        header
    )


@pytest.mark.parametrize("task", MATCHES)
def test_a_match_is_trained_in_a_league_unless_settings_are_named(task: str) -> None:
    config = resolve(task)
    assert {"newest", "older", "scripted"} <= set(config.opponents) and config.num_envs % len(
        config.opponents
    ) == 0
    assert make(task, impl="c", num_envs=1, **config.training_env).params.frozen_time == 0
    # its episodes are shared by the fixed opponents
    override(config, {"evaluation": {"every": 50}})
    if task == "go1wrestling":
        assert dict(config.train_env) == {
            "frozen_time": 0.0,
            "rewards": {"push": 3.0, "approach": 1.0},
        }
    assert resolve(task, "paper/mappo").opponents == () == resolve("go1gate").opponents


def test_ratings_recover_the_strengths_behind_many_games() -> None:
    """Odds of 3 are 191 points; a draw counts half."""
    games = np.zeros((3, 3, 3), int)
    games[0, 1] = games[0, 2] = [3000, 0, 1000]
    games[1, 0] = games[2, 0] = [1000, 0, 3000]
    games[1, 2] = games[2, 1] = [0, 4000, 0]
    ratings = tournament.rate(games, reference=1)
    np.testing.assert_allclose(ratings.value, [190.8, 0, 0], atol=1.0)
    assert ratings.low[0] < 190.8 < ratings.high[0] and ratings.high[0] - ratings.low[0] < 30
    np.testing.assert_allclose(tournament.scores(games)[0], [0, 6000, 6000])


@pytest.mark.parametrize("policies", [2, 8])
def test_few_games_that_all_end_alike_leave_a_wide_interval(policies: int) -> None:
    def interval(games: int) -> tuple[float, float]:
        results = np.full((policies, policies, 3), [0, games, 0])
        results[0, 1:] = [games, 0, 0]
        results[1:, 0] = [0, 0, games]
        value, low, high = (bound[0] for bound in tournament.rate(results, reference=1))
        assert low < value < high
        return low, high

    few = interval(4)
    many = interval(256)
    assert few[1] - few[0] > 200 and few[0] < many[0] and few[1] < many[1]


@pytest.mark.parametrize("params", [{"control": "position"}, {"commands": ["vx", "yaw_rate"]}])
def test_where_the_scripted_policy_does_not_fit_the_reference_is_an_idle_team(
    params: dict[str, Any],
) -> None:
    assert cast.reference_opponents(make("go1revolvingdoor", impl="c", num_envs=1, **params)) == [
        "idle",
        "random",
    ]
    changes = {"task": "go1revolvingdoor", "env": params, "num_envs": 2, "evaluation.every": 1}
    config = override(resolve("go1revolvingdoor", "paper/mappo"), changes)
    assert cast.environments(config, impl="c").eval_env is not None


def test_a_tournament_meets_every_pair_on_both_sides(
    tmp_path: Path, monkeypatch: Any, mqe: Any
) -> None:
    assert cast.reference_opponents(make("go1revolvingdoor", impl="c", num_envs=1)) == [
        "scripted",
        "idle",
        "random",
    ]
    monkeypatch.setattr(playing, "reference_opponents", lambda env: ["scripted", "idle"])
    words = "tournament go1revolvingdoor forward --impl c --set line_x=0.8 --episodes 4 -o"
    result = json.loads(mqe(words, tmp_path, "--json").out)
    assert result["policies"] == ["forward", "scripted", "idle"]
    won = np.array(result["results"])[..., 0]
    assert np.array(result["results"]).sum(axis=-1).tolist() == [[4] * 3] * 3
    assert won[0, 2] >= 3 and won[1, 2] >= 3
    assert result["results"][2][2] == [0, 4, 0], "idle robots draw with each other"
    assert result["results"][2][1][2] >= 3, "an idle robot loses as team 0 too"
    rated = {row["policy"]: row for row in result["ratings"]}
    assert rated["scripted"]["value"] == 0 and rated["idle"]["worst"]["value"] < -0.5
    payoff = np.array(result["payoff"]["value"])
    both = np.array(result["results"])
    np.testing.assert_allclose(
        payoff, (both[..., 0] - both[..., 2] + both[..., 2].T - both[..., 0].T) / 8
    )
    assert rated["idle"]["mean"]["value"] == pytest.approx(payoff[2, :2].mean())
    assert (tmp_path / "tournament.png").stat().st_size > 5000
    rows = (tmp_path / "tournament.csv").read_text().splitlines()
    assert len(rows) == 10 and rows[3].startswith(f"forward,idle,{won[0, 2]},")
    assert (
        (tmp_path / "policies.csv")
        .read_text()
        .startswith("policy,rating,rating_low,rating_high,mean,")
    )
    monkeypatch.setattr(tournament, "round_robin", lambda *arguments: pytest.fail("played"))
    assert "output: " in mqe(words, tmp_path / "tournament.csv", code=2).err
