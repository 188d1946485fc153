"""Matches as environments of one team, against opponents that may change; leagues: the pool of
earlier policies, who plays whom in training, and runs with a pool that are resumed.
"""

import csv
import dataclasses
import functools
import json
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax import cli
from mqe_jax.acting.evaluate import evaluate_batch
from mqe_jax.acting.seats import Policy, Seats
from mqe_jax.core.settings import build, override, to_mapping
from mqe_jax.core.types import Cast, observations
from mqe_jax.envs import VectorEnv, make
from mqe_jax.envs.wrappers import Deadline
from mqe_jax.envs.wrestling import WrestlingRewards
from mqe_jax.names import load_policy, versus
from mqe_jax.presets import resolve
from mqe_jax.runs import cast, playing
from mqe_jax.selfplay.league import tournament
from mqe_jax.selfplay.league.games import analyse
from mqe_jax.selfplay.league.league import League
from mqe_jax.selfplay.league.sides import BothSides
from mqe_jax.selfplay.opponents import Mirror, Versus
from mqe_jax.train.checkpoint import list_checkpoints, save_checkpoint
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.learner import TrainState, make_learner
from mqe_jax.train.monitor import score
from mqe_jax.train.needs import needs_of
from mqe_jax.train.policy import TrainedPolicy, policy_of
from mqe_jax.train.seeds import SeedBatch
from mqe_jax.train.start import first_state, own_learner, without_environments
from tests.inputs import refuses
from tests.training import assert_same_run, content, untrained, updated

KEY = jax.random.PRNGKey(0)
MATCHES = (
    "go1revolvingdoor",
    "go1tug",
    "go1wrestling",
    "go1bridge",
    "go1football-1vs1",
    "go1football-2vs2",
)
SETTINGS: dict[str, Any] = {
    "num_envs": 4,
    "rollout_steps": 4,
    "total_steps": 32,
    "ppo": {"epochs": 1},
    "network": {"hidden_sizes": [8], "gru_size": 4, "action_gain": 1.0},
}


@functools.cache
def matches(task: str = "go1revolvingdoor", num_envs: int = 4, **params: Any) -> VectorEnv:
    """Matches with joint targets as actions, of ten steps; `reset` is compiled, also within that of
    `versus`.
    """
    params = {"control": "position", "episode_length": 0.2, **params}
    env = VectorEnv(make(task, impl="c", num_envs=num_envs, **params), num_envs)
    env.reset = jax.jit(env.reset)  # type: ignore[method-assign]
    return env


def new_policy(
    env: Any, seed: int = 0, params: Any = MappingProxyType({}), **settings: Any
) -> TrainedPolicy:
    own = {
        "task": env.name,
        "env": {"control": env.env.control, **params},
        "num_envs": env.num_envs,
    }
    return untrained(env, build(TrainConfig, {**SETTINGS, **own, **settings}), seed)


@pytest.mark.soak
def test_teams_may_see_different_groups_of_observations() -> None:
    task = matches("go1tug", 2).env
    plain = VectorEnv(task, 2)
    refuses(
        "group: 'smell' is not allowed; it must be one of go1tug: policy, proprio",
        plain.with_groups,
        ["smell"],
    )
    env = plain.with_groups(["proprioception"])
    seeing = new_policy(versus(env, ["idle"]), group="policy")
    blind = new_policy(versus(env, ["idle"]), group="proprioception")
    assert (seeing.dims.observation, blind.dims.observation) == (env.observation_size, 27)
    state = jax.jit(env.reset)(KEY)
    less = jax.jit(plain.reset)(KEY)
    robots = jax.jit(jax.vmap(task.read))(state.data)
    np.testing.assert_allclose(
        state.groups["proprioception"][..., :3], robots.projected_gravity, atol=1e-6
    )
    assert {*less.groups} == {"policy"}
    both = Seats.of_teams(env, seeing, blind)
    assert both.groups == {"policy", "proprioception"}
    memory = both.initial_memory(2)
    keys = jax.random.split(KEY)
    still = jnp.zeros((2, 2, 12))
    action, _ = both.act(observations(state), memory, KEY, still)
    own, _ = blind.act(state.groups["proprioception"][:, 1:], memory[1], keys[1])
    np.testing.assert_array_equal(action[:, 1:], own)
    missing = "group: 'proprioception' is missing in the state"
    refuses(missing, both.act, observations(less), memory, KEY, still)
    config = build(TrainConfig, {**SETTINGS, "num_envs": 2, "group": "proprioception"})
    config = override(config, {"network.critic_input": "own"})
    learner = make_learner(Versus(env, [seeing]), config)
    after, _ = jax.eval_shape(learner.update, jax.eval_shape(learner.init, KEY))
    assert after.obs_normalizer.obs.mean.shape == (27,)
    config = override(config, {"task": "go1gate", "evaluation.every": 1, "seed": 0})
    made = cast.environments(config, impl="c")
    assert made.env.groups == made.eval_env.groups == ("policy", "proprioception")


door = pytest.fixture(scope="module")(lambda: matches())
policies = pytest.fixture(scope="module")(
    lambda door: [new_policy(versus(door, ["idle"]), seed) for seed in (0, 1)]
)


def test_every_block_has_its_own_opponent(door: VectorEnv) -> None:
    env = versus(door, ["idle", "forward"])
    assert (env.num_envs, env.num_agents, env.teams, env.observation_size) == (4, 1, ((0,),), 12)
    state = jax.jit(env.step)(env.reset(KEY), jnp.full((4, 1, 12), 0.5))
    np.testing.assert_allclose(state.action[:, 0], 0.5)
    np.testing.assert_allclose(state.action[:, 1, 0], [0.0, 0.25, 0.0, 0.25])
    np.testing.assert_array_equal(state.obs, state.match.obs[:, :1])
    np.testing.assert_array_equal(state.reward, state.match.reward[:, :1])
    assert {"team0/win", "team0/loss", "success"} <= set(
        state.outcome.by_name()
    ) and state.outcome.win.shape == (4, 1)


def test_opponents_draw_from_a_key_of_their_own(door: VectorEnv) -> None:
    env = versus(door, ["random", "random"])
    step = jax.jit(env.step)
    action = jnp.zeros((4, 1, 12))
    state = env.reset(KEY)
    assert np.any(state.match.key != door.reset(state.key).key)

    def drawn(state: Any) -> np.ndarray:
        return np.asarray(step(state, action).action[:, 1])

    first = drawn(state)
    others = dataclasses.replace(state.match, key=jax.random.split(jax.random.PRNGKey(7), 4))
    np.testing.assert_array_equal(drawn(dataclasses.replace(state, match=others)), first)
    changed = [
        drawn(dataclasses.replace(state, key=jax.random.PRNGKey(7))),
        drawn(step(state, action)),
    ]
    assert all(np.all(np.any(other != first, axis=1)) for other in changed)
    assert np.all(np.any(first[::2] != first[1::2], axis=1))  # one opponent and the other


def test_opponents_change_at_resets(policies: list[TrainedPolicy], door: VectorEnv) -> None:
    """Old and new opponent differ by their actions, which are means."""
    old, new = (dataclasses.replace(policy, deterministic=True) for policy in policies)
    env = versus(door, [old, "idle"])
    step = jax.jit(env.step)
    action = jnp.zeros((4, 1, 12))
    state = env.reset(KEY)
    # Environment 0 is one step from its time limit.
    state = dataclasses.replace(state, step=state.step.at[0].set(door.max_episode_steps - 1))
    state = env.change(state, 0, new)
    played = []
    for _ in range(3):
        obs = state.match.obs[::2, 1:]
        opponent = state.opponents[0]
        by = [policy.act(obs, opponent.memory)[0] for policy in (old, new)]
        state = step(state, action)
        played.append(
            [
                [bool(jnp.allclose(state.action[2 * i, 1:], x[i], atol=1e-5)) for x in by]
                for i in range(2)
            ]
        )
    assert played[0] == [[True, False], [True, False]]
    assert played[1] == played[2] == [[False, True], [True, False]]
    assert state.opponents[0].waiting.tolist() == [False, True]
    np.testing.assert_allclose(state.action[1::2, 1], 0.0)


def test_scale_and_statistics_belong_to_the_opponent(
    policies: list[TrainedPolicy], door: VectorEnv
) -> None:
    quiet = dataclasses.replace(
        policies[0], config=dataclasses.replace(policies[0].config, action_scale=1e-9)
    )
    env = versus(door, [policies[0]])
    state = env.change(env.reset(KEY), 0, quiet, at_once=True)
    state = jax.jit(env.step)(state, jnp.zeros((4, 1, 12)))
    assert float(jnp.abs(state.action[:, 1]).max()) < 1e-6


def test_an_opponents_memory_starts_anew_with_its_episode(
    policies: list[TrainedPolicy], door: VectorEnv
) -> None:
    env = versus(door, [policies[0]])
    state = env.reset(KEY)
    state = dataclasses.replace(state, step=state.step.at[1].set(door.max_episode_steps - 1))
    state = jax.jit(env.step)(state, jnp.zeros((4, 1, 12)))
    moved = jnp.abs(state.opponents[0].memory).max(axis=(1, 2)) > 0
    assert moved.tolist() == [True, False, True, True]


def test_what_does_not_fit_is_refused(policies: list[TrainedPolicy], door: VectorEnv) -> None:
    refuses("env: 'go1revolvingdoor' .* VectorEnv", versus, door.env, ["idle"])
    refuses("opponents: 4 environments .* do not divide among 3", versus, door, ["idle"] * 3)
    refuses(
        "opponents: 2 environments of a process do not divide among 4",
        versus(door, ["idle"] * 4).share,
        2,
    )
    refuses("go1plane is not a match", versus, matches("go1plane"), ["idle"])
    refuses(
        r"opponents: .* needs task 'go1revolvingdoor'; the environment has 'go1tug'",
        versus,
        matches("go1tug"),
        [policies[0]],
    )
    env = versus(door, ["idle", policies[0]])
    refuses("block 0 is fixed", env.change, env.reset(KEY), 0, policies[0])
    other = new_policy(versus(door, ["idle"]), network={"hidden_sizes": [16]})
    refuses("another form", env.change, env.reset(KEY), 1, other)


@pytest.mark.parametrize("kind", ["versus", pytest.param("mirror", marks=pytest.mark.soak)])
def test_the_trainer_sees_one_team(kind: str) -> None:
    inner = matches("go1football-2vs2", 2)
    env = versus(inner, ["random"]) if kind == "versus" else Mirror(inner)
    settings = {
        "ppo": {"epochs": 1, "ratio": "joint", "value": "joint"},
        "stagger_episodes": True,
        "rollout_steps": 12,
    }
    settings |= {"num_envs": env.num_envs, "network": {"recurrent": False, "hidden_sizes": [8]}}
    config = build(TrainConfig, {**SETTINGS, **settings})
    learner = make_learner(env, config)
    dims = needs_of(env, config).dims
    assert (dims.agents, dims.values) == (inner.num_agents // 2, 1)
    if kind == "versus":
        metrics = jax.eval_shape(learner.update, jax.eval_shape(learner.init, KEY))[1]
        assert {"team0/win", "team0/draw", "team0/loss"} <= metrics["ended"].keys()
        return
    _, metrics = jax.jit(learner.update)(jax.jit(learner.init)(KEY))
    assert float(metrics["ended"]["episodes"]) >= 2
    outcomes = [float(metrics["ended"][f"team0/{name}"]) for name in ("win", "draw", "loss")]
    assert sum(outcomes) == pytest.approx(1.0)
    assert np.isfinite(float(metrics["loss/policy"]))


def test_both_teams_act_in_a_mirrored_match() -> None:
    env = Mirror(matches("go1tug", 3))
    state = env.reset(KEY)
    assert state.privileged_obs.shape == (6, env.privileged_observation_size)
    action = jax.random.uniform(KEY, (6, 1, 12), minval=-1.0)
    state = jax.jit(env.step)(state, action)
    np.testing.assert_array_equal(
        state.action, jnp.stack([action[::2, 0], action[1::2, 0]], axis=1)
    )
    np.testing.assert_allclose(state.reward[::2], -state.reward[1::2], atol=1e-6)


def test_both_sides_are_the_same_matches_with_teams_exchanged_in_the_second_half() -> None:
    """The policy moves as it would as team 1; results and rewards are its own, even where they are
    not zero-sum.
    """
    inner = matches("go1wrestling", rewards=WrestlingRewards(push=3.0))
    env = BothSides(inner)
    action = jax.random.uniform(KEY, (4, 2, 12), minval=-1.0)
    exchanged = action.at[2:].set(action[2:, ::-1])
    plain = inner.reset(KEY)
    state = env.reset(KEY)
    step = jax.jit(env.step)
    plain_step = jax.jit(inner.step)

    def results(state):
        return (state.outcome.success, state.outcome.result)

    for _ in range(6):
        plain = plain_step(plain, exchanged)
        state = step(state, action)
        for name in ("obs", "final_obs", "reward"):
            own = getattr(state, name)
            theirs = getattr(plain, name)
            np.testing.assert_allclose(own[:2], theirs[:2], atol=1e-6)
            np.testing.assert_allclose(own[2:], theirs[2:, ::-1], atol=1e-6)
        np.testing.assert_array_equal(state.action, exchanged)
        np.testing.assert_array_equal(state.privileged_obs[:, -1], [0, 0, 1, 1])
        np.testing.assert_allclose(state.privileged_obs[:, :-1], plain.privileged_obs, atol=1e-6)
        np.testing.assert_allclose(
            state.metrics["average_step_reward"], state.reward[:, 0], atol=1e-7
        )
        terms = [value for name, value in state.metrics.items() if name.startswith("reward/")]
        np.testing.assert_allclose(sum(terms), state.reward[:, 0], atol=1e-6)
        for own, theirs in zip(
            jax.tree.leaves(results(state)), jax.tree.leaves(results(plain)), strict=True
        ):
            np.testing.assert_array_equal(own[:2], theirs[:2])
            np.testing.assert_array_equal(own[2:], theirs[2:, ::-1])
        assert bool(jnp.any(jnp.abs(jnp.sum(state.reward, axis=1)) > 1e-4))


def test_a_team_wins_from_both_sides() -> None:
    inner = matches("go1revolvingdoor", 4, control="command", episode_length=3.0, line_x=1.2)
    env = versus(BothSides(inner), ["idle"])
    result = evaluate_batch(env, load_policy("forward", inner.env), 4, KEY)
    assert (result.success_rate, result.match["win_rate"]) == (1.0, 1.0)
    assert result.episode_return > 0.0 and result.average_step_reward > 0.0


def test_the_best_policy_of_a_match_is_the_one_that_wins_most() -> None:
    def evaluation(**sampled: float | None) -> dict[str, Any]:
        return {"sampled": sampled}

    often = evaluation(win_rate=0.6, average_step_reward=-0.1)
    seldom = evaluation(win_rate=0.5, average_step_reward=0.2)
    assert score(often) > score(seldom) > score(evaluation(win_rate=0.5, average_step_reward=0.1))
    assert score(evaluation(average_step_reward=0.2)) > score(evaluation(average_step_reward=None))


# -- leagues


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
        assert low < value <= high
        return low, high

    def drawn(games: int) -> float:
        results = np.full((policies, policies, 3), [0, games, 0])
        found = analyse(results).payoff.at(0, 1)
        assert found.low < found.value == 0 < found.high
        return found.high - found.low

    assert 0.2 < drawn(4) < 1 and 0 < drawn(256) < 0.02
    few = interval(4)
    many = interval(256)
    assert few[1] - few[0] > 200 and few[0] < many[0] <= many[1] <= few[1]


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


def test_a_tournament_takes_policies_and_functions_by_name(monkeypatch: Any, capsys: Any) -> None:
    def ahead(obs: Any, memory: Any, key: Any) -> Any:
        return jnp.zeros((*obs.shape[:2], 3)).at[..., 0].set(1.0), memory

    played: dict[str, Any] = {}

    def count(batch: Any, teams: dict[str, Any], key: Any, report: Any) -> Any:
        played.update(teams)
        return np.ones((len(teams), len(teams), 3), int)

    monkeypatch.setattr(tournament, "round_robin", count)
    match = matches("go1tug", control="command").env
    ready = load_policy("forward", match)
    found: Any = playing.tournament(match, {"own": ahead, "ready": ready, "half": "forward"})
    assert found.policies == ("own", "ready", "half", "scripted", "idle", "random")
    obs = jnp.zeros((1, 1, match.observation_size))
    asked = {name: float(team.act(obs, (), KEY)[0][0, 0, 0]) for name, team in played.items()}
    assert (asked["own"], asked["ready"], asked["half"], asked["idle"]) == (1.0, 0.25, 0.25, 0.0)
    with pytest.warns(UserWarning, match="policies: 'forward' is there twice; it plays once"):
        found = playing.tournament(match, [ahead, "forward", "forward", "idle"])
    assert found.policies == ("ahead", "forward", "idle", "scripted", "random")
    found = playing.tournament("go1tug", {"own": ahead, "past": "population/1"}, impl="c")
    assert found.policies[:3] == ("own", "past/scripted", "past/late")
    assert "go1tug, 8 policies" in capsys.readouterr().err
    for wrong in ([ahead, lambda *given: ahead(*given), lambda *given: given], {"idle": ahead}):
        refuses("policies: .* the name of one policy; {'own'", playing.tournament, match, wrong)
    for wrong in ("forward", [], {}, 3, None):
        refuses("policies: .* a list of policies, or a map", playing.tournament, match, wrong)
    refuses("policies: 3 is not allowed; it must be a policy", playing.tournament, match, [3])
    refuses("policies: unknown 'forwar'.*register_scripted", playing.tournament, match, ["forwar"])


def test_a_tournament_meets_every_pair_on_both_sides(
    tmp_path: Path, monkeypatch: Any, mqe: Any
) -> None:
    assert cast.reference_opponents(make("go1revolvingdoor", impl="c", num_envs=1)) == [
        "scripted",
        "idle",
        "random",
    ]
    monkeypatch.setattr(playing, "reference_opponents", lambda env: ["scripted", "idle"])
    few = "--set line_x=0.8 --set episode_length=6 --episodes 4"
    words = f"tournament go1revolvingdoor forward --impl c {few} -o"
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
    (lead,) = (x for x in csv.DictReader(rows) if (x["team0"], x["team1"]) == ("forward", "idle"))
    assert float(lead["lead_both_sides"]) == pytest.approx(payoff[0, 2], abs=1e-4)
    assert float(lead["lead_low"]) == pytest.approx(result["payoff"]["low"][0][2], abs=1e-4)
    skill = "walk: vx -1 to 1, vy -0.5 to 0.5, yaw_rate -0.5 to 0.5"
    assert result["skill"] == skill and all(row.endswith(f',"{skill}"') for row in rows[1:])
    assert (
        (tmp_path / "policies.csv")
        .read_text()
        .startswith("policy,rating,rating_low,rating_high,mean,")
    )
    monkeypatch.setattr(
        tournament, "round_robin", lambda *arguments, **named: pytest.fail("played")
    )
    assert "output: " in mqe(words, tmp_path / "tournament.csv", code=2).err
