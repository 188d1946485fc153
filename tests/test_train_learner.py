"""The learner and evaluations on probe environments with known solutions."""

from __future__ import annotations

import dataclasses
import runpy
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax.core.errors import InputError
from mqe_jax.core.settings import build, override
from mqe_jax.core.types import Batch, NetworkMemory, Outcome, VectorEnv
from mqe_jax.policies import SimplePolicy
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.evaluate import Evaluator, evaluate_batch
from mqe_jax.train.learner import TrainState, env_dims, make_learner
from mqe_jax.train.normalize import value_denormalize
from mqe_jax.train.stages import Stages
from tests import training as probes
from tests.training import Probe, assert_same


def small(**values: Any) -> TrainConfig:
    """Returns settings that learn a probe in seconds; a double underscore is a dot: `ppo__clip=0.1`."""
    settings = {
        "num_envs": 32,
        "total_steps": 100_000,
        "rollout_steps": 8,
        "ppo": {"epochs": 4, "minibatches": 2, "entropy_coef": 0.0},
        "optimizer.learning_rate": 1e-2,
        "network": {"hidden_sizes": (16,), "gru_size": 8, "recurrent": False, "log_std_init": -1.0},
    }
    return override(build(TrainConfig, settings), {name.replace("__", "."): value for name, value in values.items()})


def learn(
    env: VectorEnv, config: TrainConfig, updates: int, stages: type[Stages] = Stages
) -> tuple[TrainState, dict[str, jax.Array]]:
    """Runs updates and returns the last state and metrics."""
    learner = make_learner(env, config, stages=stages)
    state = jax.jit(learner.init)(jax.random.PRNGKey(0))
    update = jax.jit(learner.update)
    metrics = {}
    for _ in range(updates):
        state, metrics = update(state)
    return state, metrics


def test_values_bootstrap_at_truncation_and_not_at_termination() -> None:
    env = Probe(probes.show_step_and_parity, probes.pay_one, num_envs=32, features=5, even_truncate=True)
    config = small(ppo__gamma=0.8, ppo__value_clip=None, normalization__value_decay=0.9)
    state, _ = learn(env, config, 60)
    network = config.network.build(env_dims(env, config))
    seen = jnp.stack([probes.show_step_and_parity(jnp.ones(2), jnp.full(2, s)) for s in range(4)])
    value, _ = network.value(state.params, (), jnp.zeros((4, 2), bool), jnp.zeros((4, 2, 2, 7)), seen)
    value = value_denormalize(state.value_normalizer, value)
    for agent in range(2):
        forever = np.full(4, 1 / (1 - 0.8))
        ending = [(1 - 0.8 ** (4 - s)) / (1 - 0.8) for s in range(4)]
        np.testing.assert_allclose(value[:, 0, agent], forever, atol=0.3)
        np.testing.assert_allclose(value[:, 1, agent], ending, atol=0.3)


def test_small_rewards_are_learnt_as_large_ones() -> None:
    """Training with rewards of 1 and of 0.001: equal values up to the scale."""

    @jax.jit
    def trained(scale: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The values of both signs in units of the scale, and the explained variance."""
        env = Probe(probes.show_hidden, lambda hidden, action: scale * hidden, num_envs=16)
        config = small(num_envs=16, ppo__epochs=1)
        learner = make_learner(env, config)
        state, metrics = jax.lax.scan(
            lambda state, _: learner.update(state), learner.init(jax.random.PRNGKey(0)), None, 30
        )
        seen = jnp.zeros((1, 2), bool), jnp.zeros((1, 2, 2, 3)), jnp.array([[[1.0], [-1.0]]])
        value, _ = config.network.build(env_dims(env, config)).value(state.params, (), *seen)
        return value_denormalize(state.value_normalizer, value[0]) / scale, metrics["explained_variance"][-1]

    values, explained = zip(*map(trained, (1.0, 1e-3)), strict=True)
    assert min(explained) > 0.5
    np.testing.assert_allclose(values[0], values[1], rtol=0.02)


VARIANTS = {
    "mappo": {},
    "jrpo": {"ppo": {"ratio": "joint", "value": "joint"}, "network__critic_input": "observations"},
    "ippo": {
        "network": {"share_policy": False, "critic_input": "own", "action_mean": "tanh"},
        "ppo": {"ratio": "dimension", "dual_clip": 3.0},
        "optimizer__target_kl": 0.02,
        "normalization__observations": True,
    },
    "happo": {"network__share_policy": False, "ppo__value": "joint", "ppo__epochs": 2},
}
Happo: type[Stages] = runpy.run_path(str(Path(__file__).parents[1] / "examples" / "happo.py"))["Happo"]


@pytest.mark.parametrize("variant", VARIANTS)
def test_two_agents_learn_to_split_a_sign(variant: str) -> None:
    env = Probe(probes.show_hidden, probes.pay_sum_and_difference, num_envs=32)
    _, metrics = learn(env, small(**VARIANTS[variant]), 60, Happo if variant == "happo" else Stages)
    assert float(metrics["average_step_reward"]) > -0.06  # at first about -0.5
    assert float(metrics["ended"]["episode_length"]) == 4.0


def test_in_happo_an_actor_learns_in_its_turn_from_the_ratios_of_those_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """A turn in which gradient steps would add 0.1 to all parameters."""
    env = Probe(probes.show_hidden, probes.pay_sum_and_difference, num_envs=8)
    config = small(**VARIANTS["happo"])
    network = config.network.build(env_dims(env, config))
    params, stages, turns = probes.random_params(network), Happo(network, config), []
    draw = iter(jax.random.split(jax.random.PRNGKey(0), 4))
    normal = lambda *shape: jax.random.normal(next(draw), shape)  # noqa: E731
    seen = NetworkMemory((), ()), jnp.zeros((1, 8), bool), normal(1, 8, 2, 3), normal(1, 8, 1)
    action, active, zero = normal(1, 8, 2, 1), jnp.ones((1, 8, 2), bool), jnp.zeros((1, 8, 1))
    density = lambda params: network.evaluate(params, *seen, action, active).log_prob[..., 0]  # noqa: E731
    batch = Batch(*seen, action, density(params)[..., None], normal(1, 8, 1), zero, zero, active)

    def update(self: Stages, carry: Any, batch: Batch, *_: Any) -> Any:
        turns.append(batch)
        return (jax.tree.map(lambda x: x + 0.1, carry[0]), *carry[1:]), {}

    monkeypatch.setattr(Stages, "update", update)
    with jax.disable_jit():
        now: Any = None
        start = params, stages.optimizer.init(params), jnp.float32(0.1)
        (after, *_), _ = stages.update(start, batch, now, jax.random.PRNGKey(1))
    first = int(turns[0].active[0, 0].argmax())
    for turn, agent in zip(turns, (first, 1 - first), strict=True):
        np.testing.assert_array_equal(turn.active, jnp.broadcast_to(jnp.arange(2) == agent, (1, 8, 2)))
    np.testing.assert_array_equal(turns[0].advantage, batch.advantage)
    moved = {**params, **jax.tree.map(lambda x: x.at[first].add(0.1), network.policy_params(params))}
    ratio = jnp.exp(density(moved) - density(params))[..., first]
    np.testing.assert_allclose(turns[1].advantage[..., 0], batch.advantage[..., 0] * ratio, rtol=1e-5)
    for new, old in zip(*map(jax.tree.leaves, map(network.policy_params, (after, params))), strict=True):
        np.testing.assert_allclose(new, old + 0.1, rtol=1e-6)  # once


def test_an_environment_of_two_teams_is_refused() -> None:
    env = Probe(probes.show_hidden, probes.pay_one, num_envs=32, teams=((1,), (0,)))
    with pytest.raises(ValueError, match="probe has 2 teams"):
        make_learner(env, small())


def test_memory_carries_a_sign_through_an_episode() -> None:
    env = Probe(probes.show_hidden_first, probes.pay_near_hidden, num_envs=32)
    config = small(network__recurrent=True, network__chunk_length=4, stagger_episodes=True)
    _, metrics = learn(env, config, 50)
    assert float(metrics["average_step_reward"]) > -0.06  # without a recurrent state at best -0.19


class CountingProbe(Probe):
    """A probe that counts how often its step is traced."""

    traces = 0

    def step(self, state: probes.ProbeState, action: jax.Array) -> probes.ProbeState:
        CountingProbe.traces += 1
        return super().step(state, action)


class OnePass(NamedTuple):
    """What updates of a single gradient step gave."""

    traces: list[int]
    states: list[TrainState]
    metrics: list[dict[str, jax.Array]]
    first_again: dict[str, jax.Array]


@pytest.fixture(scope="module")
def one_pass() -> OnePass:
    """Runs updates of one epoch over one batch, with a recurrent network; odd environments have longer episodes."""
    env = CountingProbe(probes.show_hidden_first, probes.pay_one, num_envs=4, max_episode_steps=2, odd_episode_steps=4)
    learner = make_learner(
        env, small(num_envs=4, network={"recurrent": True, "chunk_length": 4}, ppo={"epochs": 1, "minibatches": 1})
    )
    update = jax.jit(learner.update)
    states, all_metrics, traces = [jax.jit(learner.init)(jax.random.PRNGKey(0))], [], []
    for _ in range(3):
        state, metrics = update(states[-1])
        states.append(state)
        all_metrics.append(metrics)
        traces.append(CountingProbe.traces)
    return OnePass(traces, states, all_metrics, update(states[0])[1])


def test_a_chunk_repeats_the_rollout(one_pass: OnePass) -> None:
    """The first gradient step reproduces the rollout's log-densities, recurrent states and resets included."""
    for metrics in one_pass.metrics:
        assert abs(float(metrics["approx_kl"])) < 1e-6
        assert float(metrics["clip_fraction"]) == 0.0


def test_update_is_traced_once_and_pure(one_pass: OnePass) -> None:
    assert len(set(one_pass.traces)) == 1
    assert [int(state.updates) for state in one_pass.states] == [0, 1, 2, 3]
    assert len({tuple(state.key.tolist()) for state in one_pass.states}) == 4, "a random key is used again"
    assert_same(one_pass.metrics[0], one_pass.first_again)


def test_every_epoch_has_its_own_minibatches(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn, permutation = [], jax.random.permutation

    def noted(key: jax.Array, count: int) -> jax.Array:
        order = permutation(key, count)
        jax.debug.callback(lambda order: drawn.append(order.tolist()), order)
        return order

    env = Probe(probes.show_hidden, probes.pay_one, num_envs=4)
    learner = make_learner(env, small(num_envs=4, rollout_steps=2, ppo={"epochs": 3, "minibatches": 2}))
    state = jax.jit(learner.init)(jax.random.PRNGKey(0))
    monkeypatch.setattr(jax.random, "permutation", noted)
    jax.block_until_ready(jax.jit(learner.update)(state))
    jax.effects_barrier()
    assert len({tuple(order) for order in drawn}) == len(drawn) == 3
    assert all(sorted(order) == list(range(8)) for order in drawn)


class Opposite:
    """Acts against the hidden sign, which agents observe."""

    def initial_memory(self, num_envs: int) -> tuple[()]:
        return ()

    def act(self, obs: jax.Array, memory: Any, key: jax.Array) -> tuple[jax.Array, Any]:
        return -0.5 * obs[..., -1:], memory


class Recurrent(Opposite):
    def initial_memory(self, num_envs: int) -> Any:
        return jnp.zeros(num_envs)


def test_a_teacher_is_imitated_while_its_weight_lasts() -> None:
    """The reward asks for the sign, the teacher shows the opposite: imitated at first, given up for the reward."""
    env = Probe(probes.show_hidden, lambda hidden, action: hidden * jnp.mean(jnp.clip(action[..., 0], -1, 1), -1))
    env = dataclasses.replace(env, num_envs=32)
    config = small(total_steps=32 * 8 * 120, network__log_std_min=-1.0)
    config = override(config, {"imitation": {"teacher": "scripted", "weight": 20.0, "until": 0.5}})
    learner = make_learner(env, config, teacher=Opposite())
    state, update = jax.jit(learner.init)(jax.random.PRNGKey(0)), jax.jit(learner.update)
    rewards = []
    for _ in range(120):
        state, _ = update(state)
        rewards.append(float(jnp.mean(state.rollout.env_state.reward)))
    assert np.mean(rewards[20:40]) < -0.3
    assert np.mean(rewards[-10:]) > 0.6
    with pytest.raises(InputError, match=r"^imitation\.teacher: 'scripted' is not allowed; .* without recurrent state"):
        make_learner(env, config, teacher=Recurrent())


def test_settings_must_fit_the_environment() -> None:
    env = Probe(probes.show_hidden, probes.pay_one, num_envs=4)
    for values, message in (
        ({}, "num_envs: 32 is not allowed; it must be equal to the environment's num_envs, 4"),
        ({"num_envs": 4, "ppo__minibatches": 7}, "ppo.minibatches: 7 is not allowed; it must be a divisor"),
        ({"num_envs": 4, "network": {"recurrent": True, "chunk_length": 3}}, "rollout_steps: 8 .* chunk_length"),
        ({"num_envs": 4, "curriculum__assistance": 1.0}, "curriculum.assistance: 1.0 is not allowed"),
        (
            {"num_envs": 4, "imitation__teacher": "scripted"},
            "imitation.teacher: 'scripted' is not allowed; .* recurrent",
        ),
        ({"num_envs": 4, "network__critic_input": "own", "ppo__value": "joint"}, "network.critic_input: 'own'"),
    ):
        with pytest.raises(InputError, match=f"^{message}"):
            make_learner(env, small(**values))


class WrongSize(Probe):
    @property
    def observation_size(self) -> int:
        return 7


def test_a_wrong_observation_size_is_named() -> None:
    env = WrongSize(probes.show_hidden, probes.pay_one, num_envs=4)
    with pytest.raises(InputError, match=r"env: obs of probe has shape \(4, 2, 3\); expected \(4, 2, 7\)"):
        make_learner(env, small(num_envs=4))


class Tuple(NamedTuple):
    """A state that is a NamedTuple, without anything privileged; integer rewards, and a term of the score."""

    obs: jax.Array
    privileged_obs: jax.Array
    final_obs: jax.Array
    final_privileged_obs: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    outcome: Outcome
    metrics: dict[str, jax.Array]
    step: jax.Array


class Foreign:
    """One agent; ends after 4 steps; nothing but its clock is observed."""

    name, num_envs, num_agents, action_size = "foreign", 4, 1, 1
    observation_size, privileged_observation_size, max_episode_steps = 1, 0, 4

    def _state(self, step: jax.Array, done: jax.Array) -> Tuple:
        obs, nothing = step[:, None, None].astype(jnp.float32), jnp.zeros((4, 0))
        reward = jnp.ones((4, 1), jnp.int32)
        return Tuple(obs, nothing, obs, nothing, reward, done, jnp.zeros(4, bool), Outcome(), {}, step)

    def reset(self, key: jax.Array) -> Tuple:
        return self._state(jnp.zeros(4, jnp.int32), jnp.zeros(4, bool))

    def step(self, state: Tuple, action: jax.Array) -> Tuple:
        step = state.step + 1
        return self._state(jnp.where(step >= 4, 0, step), step >= 4)


def test_a_foreign_state_without_privileged_observation_is_trained_and_staggered() -> None:
    config = small(num_envs=4, stagger_episodes=True, network__critic_input="observations", ppo__epochs=1)
    config = override(config, {"normalization.observations": True})
    config = override(config, {"curriculum.failure_bootstrap": 0.5})
    learner = make_learner(Foreign(), config)
    state = jax.jit(learner.init)(jax.random.PRNGKey(1))
    assert len(np.unique(state.rollout.env_state.step)) > 1
    _, metrics = jax.jit(learner.update)(state)
    assert all(np.isfinite(float(value)) for value in jax.tree.leaves(metrics))
    with pytest.raises(InputError, match=r"network.critic_input: 'privileged'"):
        make_learner(Foreign(), small(num_envs=4))


def test_a_policy_of_another_task_is_not_evaluated() -> None:
    env = Probe(probes.show_hidden, probes.pay_one, num_envs=4)
    with pytest.raises(InputError, match=f"policy: 'one of go1tug' is not allowed; it must be one of {env.name}"):
        evaluate_batch(env, SimplePolicy("go1tug", 2, lambda obs, key: obs[..., :1]), 4, jax.random.PRNGKey(0))


def test_every_step_of_an_evaluation_has_a_random_key_of_its_own() -> None:
    """Also those of different blocks, and of different evaluations in one program."""
    env, seen = Probe(probes.show_hidden, probes.pay_one, num_envs=4, max_episode_steps=6), []

    def see(action: Any) -> Any:
        seen.append(np.array(action))
        return action

    def act(params: Any, obs: Any, memory: Any, key: jax.Array) -> tuple[jax.Array, Any]:
        action = jax.random.uniform(key, (4, 2, 1))
        shown = jax.pure_callback(see, action, action, vmap_method="broadcast_all")
        return action, jnp.sum(shown, axis=(1, 2))  # so that the call is not left out

    evaluator = Evaluator(env, act, jnp.zeros(4), block=2)
    evaluator(None, 4, jax.random.split(jax.random.PRNGKey(0), 2))
    actions = np.concatenate([np.ravel(action) for action in seen])
    assert len(seen) == 6 and len(np.unique(actions)) == actions.size == 6 * 2 * 4 * 2
