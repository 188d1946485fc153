"""What a run begins with and keeps; edges: values exactly at a bound, floors of divisions, and
nothing to divide by.
"""

import dataclasses
import functools
import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax.core.settings import build, to_mapping
from mqe_jax.core.types import Cast, Outcome
from mqe_jax.envs import TASKS, Randomization, make
from mqe_jax.envs.randomization import Randomizer
from mqe_jax.envs.reward import crowding
from mqe_jax.envs.state import EnvironmentState
from mqe_jax.npc import defend, flock, slow_down
from mqe_jax.physics.robots.go1 import GO1
from mqe_jax.policies.simple import SimplePolicy
from mqe_jax.selfplay.league import league, pool, tournament
from mqe_jax.terrain import Gate, Track
from mqe_jax.train import learner as learning
from mqe_jax.train import monitor
from mqe_jax.train.checkpoint import save_checkpoint
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.learner import make_learner
from mqe_jax.train.logs import row_of
from mqe_jax.train.monitor import EvaluationLog, Monitor
from mqe_jax.train.normalize import RunningStatistics, running_normalize
from mqe_jax.train.optim import adam
from mqe_jax.train.policy import policy_of
from mqe_jax.train.rollout import _means, _sums
from mqe_jax.train.seeds import SeedBatch
from mqe_jax.train.start import first_state, own_learner, without_environments
from tests import training as probes
from tests.inputs import refuses
from tests.states import made
from tests.training import Probe, settings, updated

KEY = jax.random.PRNGKey(0)
N = 4
"""Environments."""


def test_first_episodes_begin_at_any_step_of_their_time() -> None:
    state = SimpleNamespace(step=jnp.zeros(8000, jnp.int32), replace=lambda step: step)
    env: Any = SimpleNamespace(max_episode_steps=8)
    counts = np.bincount(np.asarray(learning._stagger(env, state, KEY)), minlength=8)
    assert len(counts) == 8 and np.abs(counts / 1000 - 1).max() < 0.15


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Fields(EnvironmentState):
    """The state of an environment without physics."""


class Help:
    """One agent in four environments; its reward is its assistance; every step is an episode."""

    name = "help"
    num_envs = N
    num_agents = 1
    action_size = 1
    observation_size = 1
    privileged_observation_size = 1

    def reset(self, key: jax.Array) -> Fields:
        return self._state(jnp.zeros(N))

    def step(self, state: Fields, action: jax.Array) -> Fields:
        return self._state(state.assistance)

    def _state(self, assistance: jax.Array) -> Fields:
        obs = jnp.zeros((N, 1, 1))
        done = jnp.ones(N, bool)
        rest = Outcome(), {"pay": assistance}, jnp.zeros(N, jnp.int32), assistance, KEY
        groups = {"policy": obs}
        reward = assistance[:, None]
        return Fields(groups, obs[:, 0], groups, obs[:, 0], reward, done, ~done, *rest)


def test_environments_get_the_assistance_of_the_schedule() -> None:
    values: dict[str, Any] = {
        "num_envs": N,
        "rollout_steps": 2,
        "total_steps": 80,
        "ppo": {"epochs": 1},
    }
    values |= {"curriculum": {"assistance": 0.8, "assistance_until": 0.5}}
    config = build(TrainConfig, {**values, "network": {"recurrent": False}})
    rows = updated(Help(), config, 6)[1]
    # to 0 in 5 of 10 updates
    for row, assistance in zip(rows, (0.8, 0.64, 0.48, 0.32, 0.16, 0.0), strict=True):
        assert float(row["pay"]) == pytest.approx(assistance, abs=1e-6) == float(row["assistance"])


def test_environments_made_anew_for_a_resumed_run_are_not_those_of_its_start(
    tmp_path: Path,
) -> None:
    env = Probe(probes.show_hidden, probes.pay_one, N)
    config = settings(checkpoint__environments=False, network__recurrent=False)
    cast = Cast(env)
    learner, processes = own_learner(cast, config)
    shared = SeedBatch(learner.init, 1).shared
    start, _ = first_state(cast, learner, processes, config, None, shared)
    keys = [start.rollout.env_state.key.tolist()]
    metadata = {
        "task": "probe",
        "config": to_mapping(config),
        "seconds": 1.0,
        "environments": False,
    }
    for updates in (1, 2):
        later = without_environments(start) | {"updates": jnp.int32(updates)}
        path = save_checkpoint(tmp_path, later, 16 * updates, metadata, keep=2)
        state, seconds = first_state(cast, learner, processes, config, path, shared)
        keys.append(state.rollout.env_state.key.tolist())
        assert (
            seconds == 1.0
            and int(state.updates) == updates
            and state.key.tolist() == start.key.tolist()
        )
    assert len({tuple(key) for key in keys}) == 3


def test_all_policies_are_evaluated_with_the_random_numbers_of_the_seed() -> None:
    env = Probe(probes.show_hidden, probes.pay_near_hidden, N)
    results = []
    for seed in (0, 1):
        config = settings(
            seed=seed, evaluation={"every": 1, "episodes": N}, network__recurrent=False
        )
        state = jax.jit(make_learner(env, config).init)(KEY)
        policy = policy_of(state, env, config)
        one, two = Monitor(env, config).evaluate([policy, policy], [3, 5], N)
        assert (one["env_steps"], two["env_steps"]) == (3, 5) and one["sampled"] == two["sampled"]
        assert one["deterministic"] == two["deterministic"] != one["sampled"]
        (absolute,) = Monitor(env, config).evaluate([policy], [3], N, absolute=True)
        assert absolute["sampled"] != one["sampled"]
        results.append(one["sampled"])
    assert results[0] != results[1]


def test_each_policy_is_evaluated_twice_in_a_row() -> None:
    assert monitor._twice([{"bias": 1.0}, {"bias": 2.0}])["bias"].tolist() == [1.0, 1.0, 2.0, 2.0]


def test_a_resumed_run_keeps_the_evaluations_up_to_its_step(tmp_path: Path) -> None:
    whole = [{"env_steps": steps, "sampled": {}, "deterministic": {}} for steps in (5, 10)]
    text = {
        "evaluations": whole,
        "absolute": {"env_steps": 5, "sampled": {}, "deterministic": {}},
        "ended_at": 10,
    }
    (tmp_path / "evaluations.json").write_text(json.dumps(text))
    for steps, count, absolute in (
        (4, 0, False),
        (5, 1, False),
        (9, 1, False),
        (10, 2, True),
        (15, 2, False),
    ):
        log = EvaluationLog(tmp_path, steps)
        assert log.evaluations == whole[:count] and (log.absolute is not None) == absolute
        assert log.last_steps() == ([None, 5, 10][count])


def test_a_member_joins_in_a_free_place_or_that_of_the_member_beaten_most() -> None:
    """Every fourth update, or the next one at a win rate; with the learner's rating and weights."""
    env: Any = object.__new__(league.League)
    env._roster = league.Roster(("older", "idle"))
    env._members = 3
    full = pool.new_pool({"x": jnp.zeros(1)}, 3)._replace(score=jnp.array([9.0, 5.0, 1.0]))
    full = full._replace(games=jnp.full(3, 9.0), rating=jnp.array([1.0, 2.0, 3.0]))
    for born, member, place in (
        ([0, 1, 2], [1, 0], 0),
        ([0, 1, 2], [0, 1], 1),
        ([0, 1, -1], [1, 0], 2),
    ):
        full = full._replace(born=jnp.array(born))
        blocks = jnp.array(member, jnp.int32)
        state = league.LeagueState(
            full, blocks, blocks, jnp.float32(55.0), jnp.int32(2), jnp.zeros((2, 3)), KEY
        )
        for win_rate, due in ((1.0, 6), (0.4, 3)):
            rules = SimpleNamespace(snapshot_steps=13, snapshot_win_rate=win_rate)
            env._config = SimpleNamespace(league=rules, steps_per_update=4)
            before = env._snapshot(state, {"x": jnp.ones(1)}, jnp.int32(due - 1))
            after = env._snapshot(state, {"x": jnp.ones(1)}, jnp.int32(due))
            assert before.pool.born.tolist() == born and int(before.snapshot) == 2
            assert int(after.snapshot) == int(after.pool.born[place]) == due
            assert (
                float(after.pool.rating[place]) == 55.0
                and float(after.pool.arrays["x"][place, 0]) == 1.0
            )
            assert float(after.pool.games[place]) == float(after.pool.score[place]) == 0.0
            for other in {0, 1, 2} - {place}:
                found = [
                    float(x[other])
                    for x in (after.pool.rating, after.pool.games, after.pool.arrays["x"][:, 0])
                ]
                assert (
                    found == [1.0 + other, 9.0, 0.0] and int(after.pool.born[other]) == born[other]
                )


class Matches:
    """Twelve matches of episodes of two steps; match i ends its first in win, draw or loss by i
    modulo 3, then wins.
    """

    name = "match"
    num_envs = 12
    num_agents = 2
    action_size = 1
    teams = ((0,), (1,))
    max_episode_steps = 8
    observation_size = 1
    privileged_observation_size = 1
    env = None

    def reset(self, key: jax.Array) -> Fields:
        return self._state(jnp.zeros(12, jnp.int32))

    def step(self, state: Fields, action: jax.Array) -> Fields:
        return self._state(state.step + 1)

    def _state(self, step: jax.Array) -> Fields:
        done = step % 2 == 0
        result = jnp.where(step <= 2, jnp.arange(12) % 3, 0)
        win, draw, loss = (
            jnp.stack([(result == i) * 1.0, jnp.zeros(12)], axis=-1) for i in range(3)
        )
        outcome = Outcome(win=win, draw=draw, loss=loss)
        groups = {"policy": jnp.zeros((12, 2, 1))}
        none = jnp.zeros((12, 1))
        rest = jnp.zeros((12, 2)), done, jnp.zeros(12, bool), outcome, {}, step, none[:, 0], KEY
        return Fields(groups, none, groups, none, *rest)


def test_a_tournament_counts_the_first_episode_of_every_match() -> None:
    idle = SimplePolicy("match", 1, lambda obs, key: jnp.zeros((len(obs), 1, 1)))
    for count, expected in (
        (1, [[4, 4, 4]]),
        (2, [[2, 2, 2]] * 2),
        (3, [[4, 0, 0], [0, 4, 0], [0, 0, 4]]),
    ):
        matches: Any = Matches()
        assert tournament.play(matches, idle, [idle] * count, KEY).tolist() == expected


def test_one_program_serves_all_policies_of_a_tournament() -> None:
    traced = []

    class Counted(Matches):
        def step(self, state: Fields, action: jax.Array) -> Fields:
            traced.append(1)
            return super().step(state, action)

    policies = [
        SimplePolicy("match", 1, functools.partial(lambda x, obs, key: x * obs, x))
        for x in (0.0, 0.5, 1.0)
    ]
    matches: Any = Counted()
    tournament.play(matches, policies[0], policies, KEY)
    alone = len(traced)
    results = tournament.round_robin(matches, dict(zip("abc", policies, strict=True)), KEY)
    assert len(traced) == 2 * alone
    assert results.tolist() == [[[4, 0, 0], [0, 4, 0], [0, 0, 4]]] * 3


AT = {
    ("go1gate", "gate_width"): (3.0, 2.9),
    ("go1gate", "spawn_height"): (0.299, 0.3),
    ("go1gate", "min_height"): (0.42, 0.41),
    ("go1gate", "max_height"): (0.42, 0.43),
    ("go1pushbox", "gate_width"): (5.0, 4.9),
    ("go1sheep-easy", "gate_width"): (4.0, 3.9),
    ("go1football-1vs1", "goal_width"): (9.0, 8.9),
    ("go1revolvingdoor", "gap"): (1.95, 1.96),
    ("go1revolvingdoor", "door"): ({"position": (0.5, 0.0)}, {"position": (0.51, 0.0)}),
    ("go1tug", "cylinder"): ({"x": 0.1}, {"x": 0.11}),
    ("go1seesaw", "plank_start"): (0.255, 0.254),
    ("go1wrestling", "spawn_height"): (0.699, 0.7),
    ("go1wrestling", "head_start"): (0.601, 0.6),
    ("go1pushbox", "head_start"): (0.951, 0.95),
    ("go1bridge", "spawn_height"): (1.319, 1.32),
    ("go1wrestling", "spawn_noise"): (0.701, 0.69),
    ("go1bridge", "spawn_noise"): (0.501, 0.499),
}
"""Parameters: values that are just refused, and just accepted."""


@pytest.mark.parametrize(("task", "name"), AT)
def test_a_bound_itself_is_refused_or_accepted_as_documented(task: str, name: str) -> None:
    kind = TASKS[task].Params
    refused, accepted = AT[task, name]
    assert GO1.stand_height == 0.3
    refuses(name, build, kind, {name: refused})
    build(kind, {name: accepted})


@pytest.mark.parametrize(
    ("task", "name", "room"),
    [
        ("go1gate", "spawn_noise", 0.75),
        ("go1tug", "spawn_x", 1.5),
        ("go1pushbox", "box_noise", 2.5),
        ("go1football-1vs1", "ball_noise", 4.5),
        ("go1sheep-easy", "flock_noise", 2.0),
    ],
)
def test_nothing_starts_outside_of_the_walls(task: str, name: str, room: float) -> None:
    options: Any = {"impl": "c", "num_envs": 1, name: room}
    make(task, **options)
    refuses(f"{name}: .* at most {room:.2f}", make, task, **{**options, name: room + 0.01})


def test_bounds_of_tracks_payloads_and_settings() -> None:
    apart: Any = {"spawn_x": (3.0, 4.31), "platform_x": (3.0, 4.31)}
    bridge = TASKS["go1bridge"].Params
    refuses("platform_x", build, bridge, {**apart, "platform_x": (3.0, 4.3)})
    build(bridge, apart)
    for width in (3.0, 0.0):
        refuses("gate: width", Track((Gate(width=width),)).layout)
    plane = made("go1plane")
    mass = float(plane.compiled.model.body_mass[plane.index.trunk_body].min())

    def random(low):
        return Randomizer(Randomization(payload=(low, 1.0)), plane.compiled.model, plane.index, 1.0)

    for name, value, accepted in (
        ("friction", (0.0, 1.0), (0.01, 100.0)),
        ("payload", (0.0, 101.0), (-1.0, 100.0)),
        ("center_of_mass", (-1.1, 0.0), (-1.0, 1.0)),
        ("motor_strength", (1.0, 101.0), (0.1, 100.0)),
        ("joint_mechanics", (0.0, 1.0), (0.1, 1.0)),
        ("motor_offset", 3.2, 3.1),
        ("push", 101.0, 100.0),
        ("observation_noise", 1001.0, 1000.0),
    ):
        refuses(name, build, Randomization, {name: value})
        build(Randomization, {name: accepted})
    refuses("payload", random, -mass)
    random(-mass + 1e-3)
    base: dict[str, Any] = {
        "network": {"log_std_init": -1.0, "log_std_max": -1.0, "log_std_min": -1.0}
    }
    config = build(TrainConfig, {**base, "num_envs": 4, "rollout_steps": 5, "total_steps": 40})
    assert config.steps_per_update == 20 and config.num_updates == 2
    longer = [
        build(TrainConfig, {"num_envs": 4, "rollout_steps": 5, "total_steps": steps})
        for steps in (41, 60)
    ]
    assert [config.num_updates for config in longer] == [3, 3]


def test_one_agent_of_four_is_frozen() -> None:
    env = made("go1football-2vs2")
    draw = jax.jit(jax.vmap(env._sample_frozen_steps, (0, None, None)))
    keys = jax.random.split(KEY, 400)
    active = jnp.ones(4, bool)
    assert not np.asarray(draw(keys, jnp.float32(0.0), active)).any()
    frozen = np.asarray(draw(keys, jnp.float32(1.0), active)) > 0
    assert frozen.sum(axis=1).max() == 1 and np.all(np.abs(frozen.mean(axis=0) - 0.25) < 0.08)
    some = np.asarray(draw(keys, jnp.float32(1.0), active.at[1].set(False))) > 0
    assert some.sum(axis=1).max() == 1 and some.any(axis=0).tolist() == [True, False, True, True]


def test_constant_observations_are_divided_by_a_hundredth() -> None:
    statistics = RunningStatistics(jnp.full(2, 3.0), jnp.array([0.0, 1e-5]), jnp.float32(9.0))
    np.testing.assert_allclose(
        running_normalize(statistics, jnp.array([3.05, 2.98])), [5.0, -2.0], rtol=1e-3
    )


def test_metrics_of_episodes_are_missing_without_any() -> None:
    """Zero in compiled code, where `jax_debug_nans` looks for NaN, and NaN in the row of
    metrics.csv.
    """
    none = jnp.zeros(3, bool)
    ended = _sums({"success": jnp.zeros(3), "episodes": none})
    found = _means(_sums({"pace": jnp.arange(3.0), "diverged": jnp.ones(3)}), ended, 3)
    assert found == {"pace": 1.0, "diverged": 3.0, "ended": {"success": 0.0, "episodes": 0.0}}
    row = row_of(1, found, TrainConfig(), 0.0, -1.0)
    assert math.isnan(row["success"]) and row["pace"] == 1.0 and row["episodes"] == 0.0
    found["ended"] |= {"episodes": 1.0}
    assert row_of(1, found, TrainConfig(), 0.0, -1.0)["success"] == 0.0


def test_a_league_without_games_has_metrics_and_no_change() -> None:
    env: Any = object.__new__(league.League)
    env._roster = league.Roster(("older", "scripted"))
    start = pool.new_pool({"x": jnp.zeros(1)}, 2)
    none = jnp.zeros(2, jnp.int32)
    state = league.LeagueState(
        start, none, none, jnp.float32(100.0), jnp.int32(0), jnp.zeros((2, 3)), KEY
    )
    after = env._record(state, [SimpleNamespace(outcomes=jnp.zeros(3, jnp.int32))] * 2)
    jax.tree.map(np.testing.assert_array_equal, after, state)
    assert {float(x) for name, x in env._metrics(after).items() if name.count("/") == 2} == {0.0}


def test_points_that_coincide_give_finite_numbers() -> None:
    place = jnp.array([[1.0, 1.0], [1.0, 1.0]])
    still = jnp.zeros((2, 2))

    def law(robots):
        return flock(KEY, place, still, robots, restlessness=0.1, step=0.02)

    assert np.all(np.isfinite(law(jnp.ones((1, 2))))) and np.all(np.isfinite(slow_down(still, 0.1)))
    # Nearer than 0.032 m a robot repels as there.
    push = flock(
        KEY,
        place[:1],
        still[:1],
        jnp.array([[0.99, 1.0]]),
        restlessness=0.0,
        step=0.02,
        friction=0.0,
    )
    np.testing.assert_allclose(push, [[2.0, 0.0]])
    close = flock(
        KEY,
        place[:1],
        still[:1],
        jnp.array([[0.9999, 1.0]]),
        restlessness=0.0,
        step=0.02,
        friction=0.0,
    )
    np.testing.assert_allclose(close, [[0.2 * 1e-4 / 1e-3**1.4, 0.0]], rtol=1e-2)
    goal = jnp.array([12.0, 0.0])
    assert np.all(np.isfinite(defend(goal, jnp.float32(0.0), goal, goal)))
    assert float(crowding(jnp.zeros((2, 2)), jnp.ones(2, bool))) == pytest.approx(200.0)
    optimizer = adam(max_grad_norm=1.0)
    params, _, norm = optimizer.update(
        {"x": jnp.zeros(2)}, optimizer.init({"x": jnp.ones(2)}), {"x": jnp.ones(2)}, 0.1
    )
    assert float(norm) == 0.0 and params["x"].tolist() == [1.0, 1.0]


def test_rewards_that_are_always_zero_leave_everything_finite() -> None:
    config = settings(ppo={"epochs": 1, "minibatches": 2}, network__recurrent=False)
    (_, state), (metrics,) = updated(
        Probe(probes.show_hidden, lambda hidden, action: 0.0 * hidden, 4), config, 1
    )
    assert (
        all(np.all(np.isfinite(x)) for x in jax.tree.leaves(state.params))
        and float(metrics["value_mean"]) == 0.0
    )
    assert np.isfinite(float(metrics["explained_variance"]))
