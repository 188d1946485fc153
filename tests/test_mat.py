"""The multi-agent transformer: sequential acting, parallel evaluation, deviation."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax.errors import InputError
from mqe_jax.train.mat import Mat, log_std_of
from mqe_jax.train.networks import EnvDims, Network
from mqe_jax.train.types import NetworkMemory, Params

KEY = jax.random.PRNGKey(0)
NO_MEMORY = NetworkMemory((), ())


def dims(agents: int) -> EnvDims:
    """Sizes with 5 observations and 2 actions per agent."""
    return EnvDims(agents=agents, observation=5, privileged=1, action=2, values=agents)


def made(agents: int, **settings: Any) -> tuple[Network, Params, jax.Array]:
    """A network with strong weights, so that every path counts, and observations (4, A, 5)."""
    network = Mat(gain=1.0, width=8, **settings).build(dims(agents))
    network = network._replace(init=jax.jit(network.init), act=jax.jit(network.act), evaluate=jax.jit(network.evaluate))
    return network, network.init(KEY), jax.random.normal(KEY, (4, agents, 5))


def log_probs(network: Network, params: Params, obs: jax.Array, action: jax.Array) -> np.ndarray:
    """Parallel log-probabilities (N, A, D)."""
    first = jnp.zeros(obs.shape[:1], bool)
    return np.asarray(network.evaluate(params, NO_MEMORY, first, obs, obs[..., 0, :1], action).log_prob)


@pytest.mark.parametrize(
    ("agents", "settings"), [(3, {}), (4, {"blocks": 2, "heads": 4, "deviation": "free"}), (1, {})]
)
def test_parallel_log_probabilities_equal_sequential_ones(agents: int, settings: dict) -> None:
    network, params, obs = made(agents, **settings)
    action, sequential, _ = network.act(network.policy_params(params), (), obs, KEY)
    np.testing.assert_allclose(log_probs(network, params, obs, action), sequential, atol=1e-5)
    assert float(jnp.std(action)) > 0.1
    mean, density, _ = network.act(network.policy_params(params), (), obs, None)
    np.testing.assert_allclose(log_probs(network, params, obs, mean), density, atol=1e-5)


def test_later_actions_change_no_earlier_log_probability() -> None:
    network, params, obs = made(3)
    action = jax.random.normal(KEY, (4, 3, 2))
    before = log_probs(network, params, obs, action)
    later = log_probs(network, params, obs, action.at[:, 2].set(action[::-1, 2]))
    np.testing.assert_allclose(later[:, :2], before[:, :2], atol=1e-6)
    earlier = log_probs(network, params, obs, action.at[:, 0].set(action[::-1, 0]))
    assert np.abs(earlier[:, 1:] - before[:, 1:]).max() > 1e-3


def test_the_deviation_starts_as_openrl_has_it_or_free() -> None:
    for settings, deviation in (
        ({}, 0.5 / (1 + np.exp(-1))),
        ({"deviation": "free", "log_std_init": -1.0}, np.exp(-1)),
    ):
        network, params, obs = made(3, **settings)
        mean, density, _ = network.act(network.policy_params(params), (), obs, None)
        np.testing.assert_allclose(density, -np.log(deviation * np.sqrt(2 * np.pi)), rtol=1e-5)
        assert mean.shape == (4, 3, 2)


def test_a_free_deviation_beyond_its_bounds_gets_the_gradient_that_leads_back() -> None:
    settings = Mat(deviation="free", log_std_init=-2.0, log_std_max=-1.0, log_std_min=-3.0)

    def log_std(parameter: jax.Array) -> jax.Array:
        return jnp.sum(log_std_of({"deviation": parameter}, settings))

    beyond = jnp.array([0.0, -2.0, -4.0])
    np.testing.assert_allclose(log_std_of({"deviation": beyond}, settings), [-1.0, -2.0, -3.0])
    np.testing.assert_array_equal(jax.grad(log_std)(beyond), [1.0, 1.0, 0.0])
    np.testing.assert_array_equal(jax.grad(lambda x: -log_std(x))(beyond), [0.0, -1.0, -1.0])
    with pytest.raises(InputError, match=r"log_std_init: 0.0 is not allowed; it must be at most log_std_max"):
        Mat(deviation="free", log_std_max=-1.0)


def test_actions_start_small_and_acting_needs_no_value_head() -> None:
    network = Mat().build(dims(3))
    params = jax.jit(network.init)(KEY)
    mean, _, _ = jax.jit(network.act)(network.policy_params(params), (), jax.random.normal(KEY, (4, 3, 5)), None)
    assert float(jnp.abs(mean).max()) < 0.1
    assert "value_head" not in network.policy_params(params)


def test_settings_that_do_not_fit_are_named() -> None:
    with pytest.raises(InputError, match="heads: 3"):
        Mat(heads=3)
    with pytest.raises(InputError, match=r"ppo\.value"):
        Mat().build(dims(3)._replace(values=1))
