"""The learner and evaluations on probe environments with known solutions."""

import functools
import runpy
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax.core.errors import InputError
from mqe_jax.core.types import Batch
from mqe_jax.policies import SimplePolicy
from mqe_jax.train.evaluate import Evaluator, evaluate_batch
from mqe_jax.train.learner import TrainState, make_learner
from mqe_jax.train.stages import Stages
from tests import training as probes
from tests.inputs import refuses
from tests.training import FAST, Probe, settings, updated

small = functools.partial(settings, FAST)


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
Happo: Any = runpy.run_path(str(Path(__file__).parents[1] / "examples" / "happo.py"))["Happo"]
TURNS: list[Any] = []
"""Advantages and active agents, then ratios, of every turn of `NotedHappo`."""


class Noted(Stages):
    def update(self, carry: Any, batch: Batch, now: Any, key: jax.Array) -> Any:
        jax.debug.callback(lambda *turn: TURNS.append(turn), batch.advantage, batch.active, ordered=True)
        return super().update(carry, batch, now, key)


class NotedHappo(Happo, Noted):
    def _ratio(self, *inputs: Any) -> jax.Array:
        jax.debug.callback(TURNS.append, ratio := super()._ratio(*inputs), ordered=True)
        return ratio


@pytest.mark.parametrize("variant", VARIANTS)
def test_two_agents_learn_to_split_a_sign(variant: str) -> None:
    env = Probe(probes.show_hidden, probes.pay_sum_and_difference, num_envs=32)
    stages = NotedHappo if variant == "happo" else Stages
    metrics = updated(env, small(**VARIANTS[variant]), 60, stages=stages)[1][-1]
    assert float(metrics["average_step_reward"]) > -0.06  # at first about -0.5
    assert float(metrics["ended"]["episode_length"]) == 4.0
    if variant == "happo":
        (advantage, active), ratio, (next_advantage, _), _ = TURNS[-4:]
        factor = ratio[..., active[0, 0].argmax(), None]
        np.testing.assert_allclose(next_advantage, advantage * factor, rtol=1e-5)
        assert np.abs(factor - 1).max() > 1e-3


def test_an_environment_of_two_teams_is_refused() -> None:
    env = Probe(probes.show_hidden, probes.pay_one, num_envs=32, teams=((1,), (0,)))
    refuses("probe has 2 teams", make_learner, env, small())


def test_memory_carries_a_sign_through_an_episode() -> None:
    env = Probe(probes.show_hidden_first, probes.pay_near_hidden, num_envs=32)
    config = small(network__recurrent=True, network__chunk_length=4, stagger_episodes=True)
    metrics = updated(env, config, 50)[1][-1]
    assert float(metrics["average_step_reward"]) > -0.06  # without a recurrent state at best -0.19


@pytest.fixture(scope="module")
def one_pass() -> tuple[list[TrainState], list[dict[str, jax.Array]]]:
    """Runs updates of one epoch over one batch, with a recurrent network; odd environments have longer episodes."""
    env = Probe(probes.show_hidden_first, probes.pay_one, num_envs=4, max_episode_steps=2, odd_episode_steps=4)
    once = {"epochs": 1, "minibatches": 1}
    return updated(env, small(num_envs=4, network={"recurrent": True, "chunk_length": 4}, ppo=once), 3)


def test_a_chunk_repeats_the_rollout(one_pass: Any) -> None:
    for metrics in one_pass[1]:
        assert abs(float(metrics["approx_kl"])) < 1e-6
        assert float(metrics["clip_fraction"]) == 0.0


def test_updates_are_counted_and_take_new_random_keys(one_pass: Any) -> None:
    assert [int(state.updates) for state in one_pass[0]] == [0, 1, 2, 3]
    assert len({tuple(state.key.tolist()) for state in one_pass[0]}) == 4


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


class Recurrent:
    act = None

    def initial_memory(self, num_envs: int) -> Any:
        return jnp.zeros(num_envs)


def test_settings_must_fit_the_environment() -> None:
    env = Probe(probes.show_hidden, probes.pay_one, num_envs=4)
    with pytest.raises(InputError, match=r"^imitation\.teacher: 'scripted' is not allowed; .* without recurrent state"):
        make_learner(env, small(num_envs=4, imitation__teacher="scripted"), teacher=Recurrent())
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
        refuses(f"^{message}", make_learner, env, small(**values))


class WrongSize(Probe):
    @property
    def observation_size(self) -> int:
        return 7


def test_a_wrong_observation_size_is_named() -> None:
    env = WrongSize(probes.show_hidden, probes.pay_one, num_envs=4)
    refuses(r"env: obs of probe has shape \(4, 2, 3\); expected \(4, 2, 7\)", make_learner, env, small(num_envs=4))


def test_a_policy_of_another_task_is_not_evaluated() -> None:
    env = Probe(probes.show_hidden, probes.pay_one, num_envs=4)
    with pytest.raises(InputError, match=f"policy: 'one of go1tug' is not allowed; it must be one of {env.name}"):
        evaluate_batch(env, SimplePolicy("go1tug", 2, lambda obs, key: obs[..., :1]), 4, jax.random.PRNGKey(0))


def test_every_step_of_an_evaluation_has_a_random_key_of_its_own() -> None:
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
