"""Edges: values exactly at a bound, floors of divisions, and nothing to divide by."""

import math
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax.core.settings import build
from mqe_jax.envs import TASKS, Randomization
from mqe_jax.envs.randomization import Randomizer
from mqe_jax.envs.reward import crowding
from mqe_jax.npc import defend, flock, slow_down
from mqe_jax.physics.robots.go1 import GO1
from mqe_jax.selfplay.league import league, pool
from mqe_jax.terrain import Gate, Track
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.logs import row_of
from mqe_jax.train.normalize import RunningStatistics, running_normalize
from mqe_jax.train.optim import adam
from mqe_jax.train.rollout import _means, _sums
from tests import training as probes
from tests.inputs import refuses
from tests.states import made
from tests.training import Probe, settings, updated

KEY = jax.random.PRNGKey(0)

AT = {
    ("go1gate", "gate_width"): (3.0, 2.9),
    ("go1gate", "min_height"): (1.5, 1.4),
    ("go1pushbox", "gate_width"): (5.0, 4.9),
    ("go1sheep-easy", "gate_width"): (4.0, 3.9),
    ("go1football-1vs1", "goal_width"): (9.0, 8.9),
    ("go1revolvingdoor", "gap"): (1.95, 1.96),
    ("go1revolvingdoor", "door"): ({"position": (0.5, 0.0)}, {"position": (0.51, 0.0)}),
    ("go1bridge", "platform_x"): ((3.0, 4.3), (3.0, 4.31)),
    ("go1tug", "cylinder"): ({"x": 0.1}, {"x": 0.11}),
    ("go1seesaw", "plank_start"): (0.255, 0.254),
    ("go1wrestling", "spawn_height"): (0.699, 0.7),
    ("go1wrestling", "head_start"): (0.601, 0.6),
    ("go1pushbox", "head_start"): (0.951, 0.95),
    ("go1bridge", "spawn_height"): (1.319, 1.32),
}
"""Parameters: values that are just refused, and just accepted."""


@pytest.mark.parametrize(("task", "name"), AT)
def test_a_bound_itself_is_refused_or_accepted_as_documented(task: str, name: str) -> None:
    kind = TASKS[task].Params
    refused, accepted = AT[task, name]
    assert GO1.stand_height == 0.3
    refuses(name, build, kind, {name: refused})
    build(kind, {name: accepted})


def test_bounds_of_tracks_payloads_and_settings() -> None:
    for width in (3.0, 0.0):
        refuses("gate: width", Track((Gate(width=width),)).layout)
    plane = made("go1plane")
    mass = float(plane.compiled.model.body_mass[plane.index.trunk_body].min())
    random = lambda low: Randomizer(Randomization(payload=(low, 1.0)), plane.compiled.model, plane.index, 1.0)  # noqa: E731
    refuses("payload", random, -mass)
    random(-mass + 1e-3)
    base: dict[str, Any] = {"network": {"log_std_init": -1.0, "log_std_max": -1.0, "log_std_min": -1.0}}
    config = build(TrainConfig, {**base, "num_envs": 4, "rollout_steps": 5, "total_steps": 40})
    assert config.steps_per_update == 20 and config.num_updates == 2
    longer = [build(TrainConfig, {"num_envs": 4, "rollout_steps": 5, "total_steps": steps}) for steps in (41, 60)]
    assert [config.num_updates for config in longer] == [3, 3]


def test_one_agent_of_four_is_frozen() -> None:
    env = made("go1football-2vs2")
    draw = jax.jit(jax.vmap(env._sample_frozen_steps, (0, None)))
    keys = jax.random.split(KEY, 400)
    assert not np.asarray(draw(keys, jnp.float32(0.0))).any()
    frozen = np.asarray(draw(keys, jnp.float32(1.0))) > 0
    assert frozen.sum(axis=1).max() == 1 and np.all(np.abs(frozen.mean(axis=0) - 0.25) < 0.08)


def test_constant_observations_are_divided_by_a_hundredth() -> None:
    statistics = RunningStatistics(jnp.full(2, 3.0), jnp.array([0.0, 1e-5]), jnp.float32(9.0))
    np.testing.assert_allclose(running_normalize(statistics, jnp.array([3.05, 2.98])), [5.0, -2.0], rtol=1e-3)


def test_metrics_of_episodes_are_missing_without_any() -> None:
    """Zero in compiled code, where `jax_debug_nans` looks for NaN, and NaN in the row of metrics.csv."""
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
    start, none = pool.new_pool({"x": jnp.zeros(1)}, 2), jnp.zeros(2, jnp.int32)
    state = league.LeagueState(start, none, none, jnp.float32(100.0), jnp.int32(0), jnp.zeros((2, 3)), KEY)
    after = env._record(state, [SimpleNamespace(outcomes=jnp.zeros(3, jnp.int32))] * 2)
    jax.tree.map(np.testing.assert_array_equal, after, state)
    assert {float(x) for name, x in env._metrics(after).items() if name.count("/") == 2} == {0.0}


def test_points_that_coincide_give_finite_numbers() -> None:
    place, still = jnp.array([[1.0, 1.0], [1.0, 1.0]]), jnp.zeros((2, 2))
    law = lambda robots: flock(KEY, place, still, robots, restlessness=0.1, step=0.02)  # noqa: E731
    assert np.all(np.isfinite(law(jnp.ones((1, 2))))) and np.all(np.isfinite(slow_down(still, 0.1)))
    # Nearer than 0.032 m a robot repels as there.
    push = flock(KEY, place[:1], still[:1], jnp.array([[0.99, 1.0]]), restlessness=0.0, step=0.02, friction=0.0)
    np.testing.assert_allclose(push, [[2.0, 0.0]])
    close = flock(KEY, place[:1], still[:1], jnp.array([[0.9999, 1.0]]), restlessness=0.0, step=0.02, friction=0.0)
    np.testing.assert_allclose(close, [[0.2 * 1e-4 / 1e-3**1.4, 0.0]], rtol=1e-2)
    goal = jnp.array([12.0, 0.0])
    assert np.all(np.isfinite(defend(goal, jnp.float32(0.0), goal, goal)))
    assert float(crowding(jnp.zeros((2, 2)), jnp.ones(2, bool))) == pytest.approx(200.0)
    optimizer = adam(max_grad_norm=1.0)
    params, _, norm = optimizer.update({"x": jnp.zeros(2)}, optimizer.init({"x": jnp.ones(2)}), {"x": jnp.ones(2)}, 0.1)
    assert float(norm) == 0.0 and params["x"].tolist() == [1.0, 1.0]


def test_rewards_that_are_always_zero_leave_everything_finite() -> None:
    config = settings(ppo={"epochs": 1, "minibatches": 2}, network__recurrent=False)
    (_, state), (metrics,) = updated(Probe(probes.show_hidden, lambda hidden, action: 0.0 * hidden, 4), config, 1)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(state.params)) and float(metrics["value_mean"]) == 0.0
    assert np.isfinite(float(metrics["explained_variance"]))
