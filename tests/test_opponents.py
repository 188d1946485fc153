"""Matches as environments of one team, against opponents that may change; policies by name;
training with opponents.
"""

import dataclasses
import functools
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax.acting.evaluate import evaluate_batch
from mqe_jax.acting.seats import Seats
from mqe_jax.core.settings import build, override
from mqe_jax.core.types import observations
from mqe_jax.envs import VectorEnv, make
from mqe_jax.envs.wrestling import WrestlingRewards
from mqe_jax.names import load_policy, versus
from mqe_jax.runs import cast
from mqe_jax.selfplay.league.sides import BothSides
from mqe_jax.selfplay.opponents import Mirror, Versus
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.learner import make_learner
from mqe_jax.train.monitor import score
from mqe_jax.train.needs import needs_of
from mqe_jax.train.policy import TrainedPolicy
from tests.inputs import refuses
from tests.training import untrained

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
    refuses("opponents: 3 is not allowed", versus, door, ["idle"] * 3)
    refuses(
        r"opponents: 4 is not allowed; it must be a divisor .* of a process, 2",
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


@pytest.mark.parametrize("kind", ["versus", "mirror"])
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
