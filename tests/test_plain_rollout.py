"""Rollouts, evaluations, leagues and opponents against plain implementations: loops over steps,
episodes and games.
"""

import dataclasses
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax.acting.evaluate import Evaluator
from mqe_jax.acting.seats import Seats
from mqe_jax.core.types import RESULTS, NetworkMemory, Observations, Outcome
from mqe_jax.names import load_policy
from mqe_jax.selfplay.league import league, pool
from mqe_jax.selfplay.opponents import Mirror, OpponentState, exchange
from mqe_jax.train.networks import Network
from mqe_jax.train.normalize import RunningStatistics
from mqe_jax.train.rollout import ObservationNormalizer, RolloutState, rollout
from tests import training as probes
from tests.acting import seats
from tests.states import made
from tests.test_opponents import matches
from tests.training import Probe

KEY = jax.random.PRNGKey(0)
N = 4
"""Environments."""


class Rich(Probe):
    """A probe with more outcomes, a term of the reward and divergences; it starts alike with every
    key.
    """

    def reset(self, key: jax.Array) -> probes.ProbeState:
        return self._more(super().reset(jax.random.PRNGKey(7)))

    def step(self, state: probes.ProbeState, action: jax.Array) -> probes.ProbeState:
        return self._more(super().step(state, action))

    def _more(self, state: probes.ProbeState) -> probes.ProbeState:
        number = jnp.arange(self.num_envs)
        step = state.step
        teams = {"draw": (step + number) % 3 == 0, "loss": number == 1}
        outcome = Outcome(
            state.outcome.success,
            state.outcome.success,
            **{name: x.astype(jnp.float32)[:, None] for name, x in teams.items()},
            further={"way": (state.hidden + number)[:, None]},
            ending={"fall": ((step + number) % 2 == 0).astype(jnp.float32)},
        )
        more = {
            "pace": state.reward[:, 1],
            "diverged": (number + 2 * step) % 3 == 1,
            "reward/way": state.reward[:, 0],
        }
        metrics = {**state.metrics, **{name: x.astype(jnp.float32) for name, x in more.items()}}
        return dataclasses.replace(state, outcome=outcome, metrics=metrics)


def pay_differently(hidden: jax.Array, action: jax.Array) -> jax.Array:
    return jnp.stack([action[:, 0, 0] + hidden, 2.0 * action[:, 1, 0] - 0.5], axis=-1)


def rich(**values: Any) -> Rich:
    def show(hidden, step):
        return jnp.stack([hidden, 0.5 * step], axis=-1)

    return Rich(
        show, pay_differently, N, features=2, max_episode_steps=2, odd_episode_steps=3, **values
    )


class Episode(NamedTuple):
    steps: int = 0
    total: float = 0.0


def test_a_rollout_is_that_of_a_plain_implementation() -> None:
    def act(params: Any, memory: Any, obs: Any, key: Any, active: Any) -> tuple[Any, Any, Any]:
        action = params["gain"] * obs[..., 2:3] + 0.1 * memory[:, None, None]
        return action, -action, memory + 1.0

    def value(
        params: Any, memory: Any, first: Any, obs: Any, privileged: Any, active: Any
    ) -> tuple[Any, Any]:
        assert first.shape[0] == obs.shape[0] == privileged.shape[0] == 1
        return None, memory + params["all"] * (
            jnp.sum(obs[0], axis=(1, 2)) + jnp.sum(privileged[0], axis=1)
        )

    nothing: Any = None

    def zero(count):
        return NetworkMemory(jnp.zeros(count), jnp.zeros(count))

    network = Network(
        nothing, lambda params: {"gain": params["gain"]}, zero, act, value, nothing, chunk_length=2
    )
    env = rich(even_truncate=True)
    params = {"gain": jnp.float32(0.7), "all": jnp.float32(0.3)}
    statistics = [
        RunningStatistics(jnp.full(n, 0.2), jnp.full(n, 4.0), jnp.float32(9.0)) for n in (4, 2)
    ]
    start = RolloutState(
        env.reset(KEY), zero(N), jnp.ones(N, bool), jnp.zeros(N, jnp.int32), jnp.zeros(N)
    )

    @jax.jit
    def both(state: RolloutState) -> Any:
        options = {"normalize": True, "action_scale": 0.25}
        found = []
        for _ in range(2):
            state, *rest = rollout(
                env, network, params, ObservationNormalizer(*statistics), state, KEY, 4, **options
            )
            found.append(rest)
        return state, found

    state, found = both(start)
    step = jax.jit(env.step)
    now = env.reset(KEY)
    actor = np.zeros(N)
    critic = np.zeros(N)
    first = np.ones(N, bool)
    episodes = [Episode()] * N
    for transitions, metrics in found:
        rows: dict[str, list[float]] = {}
        ends: dict[str, list[float]] = {}
        for t in range(4):
            actor = np.where(first, 0.0, actor)
            critic = np.where(first, 0.0, critic)
            got = jax.tree.map(lambda x: np.asarray(x[t]), transitions)  # noqa: B023
            np.testing.assert_allclose(got.memory.critic, critic, rtol=1e-5)
            np.testing.assert_allclose(got.memory.actor, actor, rtol=1e-5)
            np.testing.assert_array_equal(got.is_first, first)
            obs = (np.asarray(now.obs) - 0.2) / 2
            privileged = (np.asarray(now.privileged_obs) - 0.2) / 2
            action = 0.7 * obs[..., 2:3] + 0.1 * actor[:, None, None]
            np.testing.assert_allclose(got.action, action, rtol=1e-5)
            np.testing.assert_allclose(got.log_prob, -action, rtol=1e-5)
            for name in ("obs", "privileged_obs"):
                np.testing.assert_allclose(getattr(got, name), getattr(now, name))
            actor = actor + 1.0
            critic = critic + 0.3 * (obs.sum((1, 2)) + privileged.sum(1))
            now = step(now, jnp.asarray(0.25 * action, jnp.float32))
            for name in ("final_obs", "final_privileged_obs", "reward", "terminated"):
                np.testing.assert_allclose(getattr(got, name), getattr(now, name), rtol=1e-5)
            first = np.asarray(now.terminated | now.truncated)
            np.testing.assert_array_equal(got.done, first)
            for n in range(N):
                episodes[n] = Episode(
                    episodes[n].steps + 1, episodes[n].total + float(now.reward[n].mean())
                )
                for name, x in now.metrics.items():
                    rows.setdefault(name, []).append(float(x[n]))
                if first[n]:
                    for name, x in now.outcome.by_name().items():
                        ends.setdefault(name, []).append(float(x[n]))
                    ends.setdefault("episode_length", []).append(episodes[n].steps)
                    ends.setdefault("episode_return", []).append(episodes[n].total)
                    episodes[n] = Episode()
        expected = {name: np.mean(values) for name, values in rows.items()}
        expected |= {name: np.sum(rows[name]) for name in ("diverged", "overflow")}
        outcomes = {"success", "ending/fall", *(f"team0/{name}" for name in (*RESULTS, "way"))}
        assert set(ends) == {*outcomes, "episode_length", "episode_return"}
        metrics |= metrics.pop("ended")
        expected |= {name: np.mean(values) for name, values in ends.items()} | {
            "episodes": len(ends["success"])
        }
        assert set(metrics) == set(expected)
        for name, x in expected.items():
            np.testing.assert_allclose(metrics[name], x, rtol=1e-5, atol=1e-6, err_msg=name)
    np.testing.assert_allclose(state.memory.actor, actor)
    np.testing.assert_allclose(state.memory.critic, critic, rtol=1e-5)
    np.testing.assert_array_equal(state.episode_steps, [episode.steps for episode in episodes])
    np.testing.assert_allclose(
        state.episode_return, [episode.total for episode in episodes], rtol=1e-5, atol=1e-6
    )


def test_evaluations_are_those_of_a_plain_implementation() -> None:
    env = rich(teams=((1,), (0,)))

    def act(params: Any, obs: Any, memory: Any, key: Any) -> tuple[Any, Any]:
        return params * obs.obs[..., 2:3] + memory[:, None, None], memory + 0.5

    both = jnp.array([0.3, -0.8])
    acting = seats(env, act, both, lambda num_envs: jnp.full(num_envs, 0.1))
    found = Evaluator(env, block=4)(acting, 9, jax.random.split(KEY, 2))
    step = jax.jit(env.step)
    for gain, result in zip((0.3, -0.8), found, strict=True):
        now = env.reset(KEY)
        memory = np.full(N, 0.1)
        left = np.array([3, 2, 2, 2])
        rows = []
        ends = []
        rewards = []
        while left.any():
            action = gain * np.asarray(now.obs)[..., 2:3] + memory[:, None, None]
            now = step(now, jnp.asarray(action, jnp.float32))
            memory = memory + 0.5
            done = np.asarray(now.terminated | now.truncated)
            for n in np.flatnonzero(left):
                rows.append(
                    {name: float(x[n]) for name, x in (now.metrics | now.outcome.by_name()).items()}
                )
                rewards.append(float(now.reward[n, 1]))
                if done[n]:
                    ends.append(rows[-1])
            memory[done] = 0.1
            left = left - (done & (left > 0))

        def mean(name, of):
            return np.mean([row[name] for row in of])

        expected = {
            "success_rate": mean("success", ends),
            "average_step_reward": mean("average_step_reward", rows),
        }
        expected |= {"episode_return": np.sum(rewards) / 9, "episode_length": len(rows) / 9}
        expected |= {
            "overflow": sum(row["overflow"] for row in rows),
            "diverged": sum(row["diverged"] for row in ends),
        }
        expected |= {
            "success/way": mean("team0/way", ends),
            "ending/fall": mean("ending/fall", ends),
        }
        expected |= {
            f"{name}_rate": mean(f"team0/{name}", ends) for name in ("win", "draw", "loss")
        }
        values = result.to_dict()
        terms = values.pop("terms")
        intervals = values.pop("intervals")
        assert (
            intervals["win_rate"] == [*result.win[1:]]
            and intervals["ending/fall"][0] <= values["ending/fall"]
        )
        assert (values.pop("task"), values.pop("episodes")) == ("probe", 9)
        assert values == pytest.approx(expected, rel=1e-5)
        assert terms == pytest.approx(
            {name: mean(f"reward/{name}", rows) for name in ("pay", "way")}, rel=1e-5
        )


class Half(Rich):
    def _more(self, state: probes.ProbeState) -> probes.ProbeState:
        active = jnp.zeros(state.reward.shape, bool).at[:, 0].set(True)
        return dataclasses.replace(super()._more(state), active=active)


def test_results_are_those_of_the_agents_that_take_part() -> None:
    values: dict[str, Any] = {
        "num_envs": N,
        "features": 2,
        "max_episode_steps": 2,
        "odd_episode_steps": 2,
    }
    env = Half(
        lambda hidden, step: jnp.stack([hidden, 0.5 * step], axis=-1), pay_differently, **values
    )

    def act(params, seen, memory, key):
        return (seen.obs[..., 2:3], memory)

    (result,) = Evaluator(env, block=2)(seats(env, act), N, KEY[None])
    hidden = np.asarray(env.reset(KEY).hidden)
    assert result.episode_return == pytest.approx(4 * hidden.mean())
    nothing: Any = None

    def copy(params, memory, obs, key, active):
        return (obs[..., 2:3], obs[..., 2:3], memory)

    def value(*_: Any) -> Any:
        return None, ()

    network = Network(nothing, lambda p: p, nothing, copy, value, nothing)
    zero = jnp.zeros(N)
    start = RolloutState(
        env.reset(KEY), NetworkMemory((), ()), zero == 0, zero.astype(jnp.int32), zero
    )
    _, transitions, metrics = rollout(
        env, network, {}, nothing, start, KEY, 2, normalize=False, action_scale=1.0
    )
    assert float(metrics["ended"]["episode_return"]) == pytest.approx(4 * hidden.mean())
    assert transitions.active.tolist() == [[[True, False]] * N] * 2


def test_a_league_counts_as_a_plain_implementation() -> None:
    sources = ("newest", "older", "scripted", "uniform", "idle")
    members = 4
    moving = np.isin(sources, ("older", "uniform"))
    scripted = np.isin(sources, ("scripted",))
    env: Any = object.__new__(league.League)
    env._roster = league.Roster(sources)
    env._members = members
    random = np.random.default_rng(0)
    ratings = random.normal(0, 200, members).astype(np.float32)
    fields = {"born": jnp.array([0, 3, 5, -1]), "rating": jnp.asarray(ratings)}
    start = pool.new_pool({"x": jnp.zeros(1)}, members)._replace(**fields)
    zeros = jnp.zeros(5, jnp.int32)
    state = league.LeagueState(
        start, zeros, zeros, jnp.zeros(()), jnp.int32(0), jnp.zeros((5, 3)), KEY
    )
    score = np.zeros(members)
    games = np.zeros(members)
    rating = 0.0
    played = np.zeros(5)
    recent = np.zeros((5, 3))
    for number in range(30):
        member = random.integers(0, 3, 5)
        outcomes = random.integers(0, 400 if number % 7 == 0 else 4, (5, 3)) * (
            random.random((5, 1)) < 0.7
        )
        state = state._replace(member=jnp.asarray(member, jnp.int32))
        state = env._record(state, [SimpleNamespace(outcomes=jnp.asarray(row)) for row in outcomes])
        gained = 0.0
        met = set()
        for i, (wins, draws, losses) in enumerate(outcomes):
            count = wins + draws + losses
            points = wins + 0.5 * draws
            played[i] += count
            if moving[i] or scripted[i]:
                theirs = 0.0 if scripted[i] else ratings[member[i]]
                gained += points - count / (1 + 10 ** ((theirs - rating) / 400))
            if moving[i] and count and member[i] not in met:
                met.add(member[i])
                score[member[i]] *= 0.98
                games[member[i]] *= 0.98
        for i, (wins, draws, losses) in enumerate(outcomes):
            if moving[i]:
                score[member[i]] += wins + 0.5 * draws
                games[member[i]] += wins + draws + losses
        rating += np.clip(gained, -30, 30)
        recent = 0.95 * recent + outcomes
    np.testing.assert_allclose(state.pool.score, score, rtol=1e-4)
    np.testing.assert_allclose(state.pool.games, games, rtol=1e-4)
    np.testing.assert_allclose(state.rating, rating, rtol=1e-3)
    np.testing.assert_array_equal(state.played, played)
    np.testing.assert_allclose(state.recent, recent, rtol=1e-4)
    metrics = env._metrics(state)
    rates = (score + 2) / (games + 4)
    expected = {"league/rating": rating, "league/members": 3, "league/win_rate": rates[:3].mean()}
    for i, source in enumerate(sources):
        for name, share in zip(("win", "draw", "loss"), recent[i] / recent[i].sum(), strict=True):
            expected[f"league/{name}/{source}"] = share
    assert {name: float(value) for name, value in metrics.items()} == pytest.approx(
        expected, rel=1e-3
    )
    older = np.asarray(jax.nn.softmax(pool.chances(state.pool, False)))
    any_ = np.asarray(jax.nn.softmax(pool.chances(state.pool, True)))
    weight = (1 - rates[:3]) ** 2 + 1e-4
    np.testing.assert_allclose(older, [*(weight / weight.sum()), 0.0], rtol=1e-3)
    np.testing.assert_allclose(any_, [1 / 3, 1 / 3, 1 / 3, 0.0], rtol=1e-5)


def test_blocks_draw_the_members_that_their_source_says() -> None:
    """After five episodes, unless some against the last one still run."""
    env: Any = object.__new__(league.League)
    env._roster = league.Roster(("older", "uniform", "older", "idle", "older"))
    env._config = SimpleNamespace(league=SimpleNamespace(episodes=5))
    now = pool.new_pool({"x": jnp.zeros(1)}, 3)._replace(
        born=jnp.array([0, 3, -1]), games=jnp.full(3, 1e6)
    )
    now = now._replace(score=jnp.array([1e6, 0.0, 0.0]))
    none = jnp.zeros(5, jnp.int32)
    opponents = [SimpleNamespace(waiting=jnp.array([False, block == 4])) for block in range(5)]

    def drawn(key: jax.Array) -> Any:
        played = jnp.array([5, 6, 4, 9, 9], jnp.int32)
        state = league.LeagueState(
            now, none, played, jnp.zeros(()), jnp.int32(0), jnp.zeros((5, 3)), key
        )
        after, redrawn = env._draw(state, opponents)
        return after.member, after.played, redrawn

    member, played, redrawn = jax.jit(jax.vmap(drawn))(jax.random.split(KEY, 512))
    share = np.asarray(member).mean(axis=0)
    assert share[0] > 0.99 and 0.42 < share[1] < 0.58 and not share[2:].any()
    assert played.tolist() == [[0, 0, 4, 9, 9]] * 512
    assert redrawn.tolist() == [[True, True, False, False, False]] * 512


def test_a_second_change_replaces_only_the_opponent_that_is_waited_for() -> None:
    waiting = jnp.array([True, False])
    one = OpponentState(jnp.float32(1.0), jnp.float32(0.0), waiting, (), jnp.zeros(3, jnp.int32))
    two = exchange(one, jnp.float32(2.0))
    assert (float(two.arrays), float(two.before), two.waiting.tolist()) == (2.0, 0.0, [True, False])
    free = exchange(dataclasses.replace(two, waiting=~jnp.ones(2, bool)), jnp.float32(3.0))
    assert (float(free.arrays), float(free.before), free.waiting.tolist()) == (
        3.0,
        2.0,
        [True, True],
    )
    now = exchange(two, jnp.float32(4.0), at_once=True)
    assert (float(now.arrays), float(now.before), now.waiting.tolist()) == (
        4.0,
        4.0,
        [False, False],
    )


def test_both_teams_of_a_mirrored_match_get_what_is_theirs() -> None:
    env = Mirror(matches("go1tug", 3))
    state = env.reset(KEY).match
    numbers = jnp.arange(3.0)
    metrics = {name: numbers + 1 for name in state.metrics}
    obs = {"groups": state.obs + 1, "final_groups": state.final_obs + 2}
    rows = {
        "reward": jnp.arange(6.0).reshape(3, 2),
    }
    rows |= {
        "privileged_obs": state.privileged_obs + 3,
        "final_privileged_obs": state.final_privileged_obs + 4,
    }
    flags = {
        "terminated": jnp.array([True, False, False]),
        "truncated": jnp.array([False, True, False]),
    }
    more = {"step": jnp.array([3, 1, 2], jnp.int32), "assistance": numbers / 4, "metrics": metrics}
    groups = {name: {"policy": value} for name, value in obs.items()}
    seen = env._team_state(
        dataclasses.replace(state, **groups, **rows, **flags, **more), jnp.zeros((3, 2, 12))
    )
    for i in range(6):
        match, team = divmod(i, 2)
        for name, expected in obs.items():
            found = getattr(seen, name)["policy"]
            np.testing.assert_array_equal(found[i, 0], expected[match, team])
        np.testing.assert_array_equal(seen.reward[i, 0], rows["reward"][match, team])
        for name in ("privileged_obs", "final_privileged_obs"):
            np.testing.assert_array_equal(
                getattr(seen, name)[i], [*np.asarray(rows[name][match]), team]
            )
        for name in ("terminated", "truncated"):
            assert bool(getattr(seen, name)[i]) == bool(flags[name][match])
        for name in ("step", "assistance"):
            assert float(getattr(seen, name)[i]) == float(more[name][match])
        for name, values in seen.metrics.items():
            counted = name not in ("diverged", "overflow") or team == 0
            assert float(values[i]) == (match + 1 if counted else 0)
    assert not any(name.startswith("team1/") for name in seen.metrics)


def test_policies_without_files_act_as_named() -> None:
    env = made("go1football-2vs2")
    obs = jnp.zeros((2000, 2, env.observation_size))
    random = load_policy("random", env)
    idle = load_policy("idle", env)
    forward = load_policy("forward", env)
    columns = np.asarray(random.act(obs, (), KEY)[0]).reshape(2000, -1)
    assert columns.shape[1] == 24 and columns.min() < -0.99 and columns.max() > 0.99
    assert np.abs(columns.mean(0)).max() < 0.08 and np.abs(columns.std(0) - 3**-0.5).max() < 0.03
    assert np.abs(np.corrcoef(columns.T) - np.eye(24)).max() < 0.13
    both = Seats.of_teams(env, random, random)
    seen = Observations.at(jnp.zeros((2000, 4, env.observation_size)))
    teams = both.act(seen, ((), ()), KEY, jnp.zeros((2000, 4, env.action_size)))[0]
    assert np.abs(np.corrcoef(np.asarray(teams).reshape(2000, -1).T) - np.eye(48)).max() < 0.13
    assert not np.asarray(idle.act(obs, (), KEY)[0]).any()
    ahead = np.asarray(forward.act(obs, (), KEY)[0])
    assert np.all(ahead[..., 0] == 0.25) and not ahead[..., 1:].any()
