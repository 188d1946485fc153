"""The learner's parts against values computed by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax.core.settings import build
from mqe_jax.train import nn
from mqe_jax.train.config import PPO, Curriculum, Imitation, OptimizerSettings, TrainConfig
from mqe_jax.train.loss import gae
from mqe_jax.train.networks import ActorCritic, EnvDims
from mqe_jax.train.normalize import (
    running_init,
    running_normalize,
    running_update,
    value_denormalize,
    value_init,
    value_normalize,
    value_update,
)
from mqe_jax.train.optim import adam, begun_anew
from mqe_jax.train.schedules import current_values
from tests.training import random_params

KEY = jax.random.PRNGKey(0)


def test_gae_of_integer_rewards_keeps_fractions_of_the_bootstrap() -> None:
    ones = jnp.ones((1, 1), jnp.int32)
    advantage, _ = gae(ones, jnp.zeros((1, 1)), 2.0 * ones, 0.3 * ones, ones.astype(bool), gamma=1.0, gae_lambda=1.0)
    np.testing.assert_allclose(advantage, [[1.0 + 0.7 * 2.0]], rtol=1e-6)


def test_schedules_by_hand() -> None:
    """Ten updates; the assistance falls to 0 in five, the learning rate in the last two, and so on."""
    config = TrainConfig(
        num_envs=1,
        rollout_steps=10,
        total_steps=100,
        ppo=PPO(entropy_coef=0.01, entropy_coef_final=0.0, critic_warmup=0.2),
        optimizer=OptimizerSettings(schedule="linear", anneal=0.2),
        curriculum=Curriculum(assistance=1.0, assistance_until=0.5, failure_bootstrap=0.8, failure_bootstrap_until=0.4),
        imitation=Imitation(weight=3.0, until=0.6),
    )
    expected = {
        0: (1.0, 0.8, 0.01, 3.0, 0.0, 0.0, 1.0),
        2: (0.6, 0.4, 0.008, 2.0, 1.0, 1.0, 1.0),
        5: (0.0, 0.0, 0.005, 0.5, 1.0, 0.0, 1.0),
        9: (0.0, 0.0, 0.001, 0.0, 1.0, 0.0, 0.5),
    }
    for updates, values in expected.items():
        np.testing.assert_allclose(jnp.stack(current_values(config, jnp.int32(updates))), values, rtol=1e-5, atol=1e-7)


def test_running_statistics_merge_as_one_batch() -> None:
    data = 3.0 + 2.0 * jax.random.normal(KEY, (100, 3))
    statistics = running_init(3)
    np.testing.assert_array_equal(running_normalize(statistics, data), data)
    for part in (data[:10], data[10:35], data[35:]):
        both = jnp.stack([part, jnp.full_like(part, 1e6)], axis=1)  # the second agent takes no part
        active = jnp.tile(jnp.array([True, False]), (len(part), 1))
        statistics = jax.jit(running_update)(statistics, both, active)
    np.testing.assert_allclose(statistics.mean, data.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(statistics.variance, data.var(axis=0), rtol=1e-4)
    np.testing.assert_array_equal(running_normalize(statistics, jnp.array([1e6, -1e6, 3.0]))[:2], [10.0, -10.0])
    constant = running_update(running_init(1), jnp.full((10, 1), 7.0), jnp.ones(10, bool))
    np.testing.assert_allclose(running_normalize(constant, jnp.array([7.0])), [0.0], atol=1e-4)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_value_statistics_are_debiased_and_invertible_at_any_scale(scale: float) -> None:
    target = scale * jnp.array([1.0, 3.0])
    statistics = value_update(value_init(), jnp.append(target, 1e9), jnp.array([True, True, False]), 0.99)
    np.testing.assert_allclose(value_normalize(statistics, target), [-1.0, 1.0], rtol=1e-3)
    np.testing.assert_allclose(value_denormalize(statistics, value_normalize(statistics, target)), target, rtol=1e-6)


def test_value_statistics_at_their_limits() -> None:
    target = jnp.array([1.0, 3.0])
    np.testing.assert_array_equal(value_normalize(value_init(enabled=False), target), target)
    np.testing.assert_array_equal(value_denormalize(value_init(enabled=False), target), target)
    np.testing.assert_array_equal(value_denormalize(value_init(), target), 0.0)
    for constant in (0.0, 5.0):
        statistics = value_update(value_init(), jnp.full((3,), constant), jnp.ones(3, bool), 0.99)
        assert float(jnp.abs(value_normalize(statistics, jnp.float32(constant)))) < 0.1
    # The deviation of nearly constant targets is taken to be a thousandth of their size.
    statistics = value_update(value_init(), 5.0 + 1e-4 * target, jnp.ones(2, bool), 0.99)
    np.testing.assert_allclose(value_normalize(statistics, jnp.float32(5.5)), 100.0, rtol=2e-2)


def test_the_actor_begins_after_the_warm_up_with_steps_of_the_learning_rate() -> None:
    config = build(TrainConfig, {"num_envs": 2, "rollout_steps": 1, "total_steps": 20, "ppo": {"critic_warmup": 0.3}})
    begins = [bool(current_values(config, jnp.int32(i)).actor_begins) for i in range(10)]
    assert begins == [i == 3 for i in range(10)]
    optimizer, params = adam(eps=1e-8), {"a": jnp.zeros(())}
    state = optimizer.init(params)
    for _ in range(500):
        params, state, _ = optimizer.update({"a": jnp.zeros(())}, state, params, 0.1)
    gradient = {"a": jnp.float32(0.5)}
    assert float(optimizer.update(gradient, begun_anew(state, False), params, 0.1)[0]["a"]) < -0.15
    again = begun_anew(state, jnp.bool_(True))
    assert float(optimizer.update(gradient, again, params, 0.1)[0]["a"]) == pytest.approx(-0.1, rel=1e-4)


def test_gru_by_hand() -> None:
    params = nn.gru_init(KEY, 2, 3)
    h, x = jax.random.normal(KEY, (4, 3)), jax.random.normal(KEY, (4, 2))

    def gates(name: str, value: jax.Array) -> list[np.ndarray]:
        return np.split(np.asarray(value @ params[name]["weight"]), 3, axis=-1)

    def sigmoid(z: np.ndarray) -> np.ndarray:
        return 1 / (1 + np.exp(-z))

    (rx, ux, cx), (rh, uh, ch) = gates("input", x), gates("hidden", h)
    reset, update = sigmoid(rx + rh), sigmoid(ux + uh)
    expected = (1 - update) * np.tanh(cx + reset * ch) + update * np.asarray(h)
    np.testing.assert_allclose(nn.gru(params, h, x), expected, atol=1e-5)


def test_weights_are_drawn_without_lapack() -> None:
    # Its decompositions wait for each other in XLA's threads and can stop a program on two cores for good.
    lowered = jax.jit(lambda key: nn.orthogonal(key, (8, 4), 1.0)).lower(jax.random.PRNGKey(0))
    assert "custom_call" not in lowered.as_text()


def test_a_bounded_parameter_comes_back_from_beyond_its_bounds() -> None:
    x = jnp.array([-2.0, -1.0, 0.0, 1.0, 2.0])

    def slope(direction: float) -> jax.Array:
        return jax.grad(lambda x: jnp.sum(direction * nn.clip_parameter(x, -1.5, 1.5)))(x)

    np.testing.assert_allclose(nn.clip_parameter(x, -1.5, 1.5), [-1.5, -1.0, 0.0, 1.0, 1.5])
    np.testing.assert_allclose(slope(1.0), [0, 1, 1, 1, 1])  # descent lowers x: back from above, never farther down
    np.testing.assert_allclose(slope(-1.0), [-1, -1, -1, -1, 0])


@pytest.mark.parametrize("recurrent", [False, True])
def test_normalised_layers_by_hand(recurrent: bool) -> None:
    """OpenRL's order: dense, activation, norm; dense, norm; recurrent unit, norm; action layer."""
    settings = ActorCritic(
        openrl_layers=True, hidden_sizes=(5,), recurrent=recurrent, gru_size=4, critic_input="own", action_gain=1.0
    )
    dims = EnvDims(agents=2, observation=3, privileged=0, action=2, values=2)
    network = settings.build(dims)
    obs = jax.random.normal(KEY, (6, 2, 3))
    params = random_params(network)
    memory = network.initial_memory(6)
    mean, _, after = jax.jit(network.act)(params, memory.actor, obs, None)

    actor = params["actor"]
    norm = lambda i, x: nn.layer_norm(actor["norm"][str(i)], x)  # noqa: E731
    x = norm(0, jnp.maximum(nn.dense(actor["hidden"]["0"], obs), 0.0))
    x = norm(1, nn.dense(actor["linear"], x))
    if recurrent:
        state = nn.gru(actor["gru"], memory.actor, x)
        np.testing.assert_allclose(after, state, atol=1e-5)  # the recurrent state itself is not normalised
        x = norm(2, state)
    np.testing.assert_allclose(mean, nn.dense(actor["head"], x), atol=1e-5)
