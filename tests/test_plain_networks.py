"""Networks, policies and the learner's parts against plain numpy and values computed by hand."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax.core.settings import build
from mqe_jax.core.types import NetworkMemory
from mqe_jax.train import nn
from mqe_jax.train.config import PPO, Curriculum, Imitation, OptimizerSettings, TrainConfig
from mqe_jax.train.loss import gae
from mqe_jax.train.needs import Needs
from mqe_jax.train.networks import ActorCritic, EnvDims, Mat
from mqe_jax.train.normalize import (
    RunningStatistics,
    running_init,
    running_normalize,
    running_update,
    value_denormalize,
    value_init,
    value_normalize,
    value_update,
)
from mqe_jax.train.optim import adam, restart
from mqe_jax.train.policy import TrainedPolicy
from mqe_jax.train.schedules import current_values
from tests.training import random_params, settings

KEY = jax.random.PRNGKey(0)


def dense(layer: Any, x: np.ndarray) -> np.ndarray:
    return x @ np.asarray(layer["weight"], float) + np.asarray(layer["bias"], float)


def norm(layer: Any, x: np.ndarray) -> np.ndarray:
    x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-5)
    return x * np.asarray(layer["scale"], float) + np.asarray(layer["shift"], float)


def gelu(x: np.ndarray) -> np.ndarray:
    return x * 0.5 * (1 + np.vectorize(math.erf)(x / math.sqrt(2)))


def attended(
    layers: Any, query: np.ndarray, context: np.ndarray, heads: int, causal: bool
) -> np.ndarray:
    """Attention (A, W) of every agent to all, or to those up to itself, head by head."""
    q, k, v = (
        dense(layers[name], x)
        for name, x in (("query", query), ("key", context), ("value", context))
    )
    agents, width = q.shape
    size = width // heads
    mixed = np.zeros((agents, width))
    for head in range(heads):
        part = slice(head * size, (head + 1) * size)
        for agent in range(agents):
            seen = agent + 1 if causal else agents
            weight = np.exp(
                np.array([q[agent, part] @ k[other, part] for other in range(seen)])
                / math.sqrt(size)
            )
            mixed[agent, part] = sum(
                w * v[other, part] for other, w in enumerate(weight / weight.sum())
            )
    return dense(layers["projection"], mixed)


def test_the_transformer_is_that_of_a_plain_implementation() -> None:
    settings = Mat(blocks=2, heads=2, width=8)
    agents = 3
    network = settings.build(
        EnvDims(agents=agents, observation=5, privileged=1, action=2, values=agents)
    )
    random = np.random.default_rng(0)
    params = random_params(network)
    obs = random.normal(size=(4, agents, 5))
    action = random.normal(size=(4, agents, 2))
    arrays = jnp.zeros(4, bool), jnp.asarray(obs), jnp.zeros((4, 1)), jnp.asarray(action)
    found = jax.jit(network.evaluate)(params, NetworkMemory((), ()), *arrays)
    value, _ = jax.jit(network.value)(params, (), *arrays[:3])
    np.testing.assert_allclose(value, found.value, atol=1e-5)
    deviation = 0.5 / (1 + np.exp(-np.asarray(params["deviation"], float)))
    encoder = params["encoder"]
    decoder = params["decoder"]
    for n in range(4):
        x = norm(encoder["norm"], gelu(dense(encoder["embed"], norm(encoder["norm_in"], obs[n]))))
        for block in encoder["blocks"]:
            x = norm(block["norm0"], x + attended(block["attention0"], x, x, 2, False))
            x = norm(
                block["norm1"], x + dense(block["mlp"]["1"], gelu(dense(block["mlp"]["0"], x)))
            )
        head = params["value_head"]
        own = dense(head["out"], norm(head["norm"], gelu(dense(head["hidden"], x))))[:, 0]
        np.testing.assert_allclose(found.value[n], own, atol=1e-4)
        features = x
        tokens = np.concatenate([np.zeros((1, 2)), action[n, :-1]])
        x = norm(decoder["norm"], gelu(dense(decoder["embed"], tokens)))
        for block in decoder["blocks"]:
            x = norm(block["norm0"], x + attended(block["attention0"], x, x, 2, True))
            x = norm(block["norm1"], features + attended(block["attention1"], features, x, 2, True))
            x = norm(
                block["norm2"], x + dense(block["mlp"]["1"], gelu(dense(block["mlp"]["0"], x)))
            )
        head = decoder["head"]
        mean = dense(head["out"], norm(head["norm"], gelu(dense(head["hidden"], x))))
        z = (action[n] - mean) / deviation
        expected = -0.5 * z**2 - np.log(deviation * math.sqrt(2 * math.pi))
        np.testing.assert_allclose(found.log_prob[n], expected, rtol=1e-3, atol=1e-3)
        entropy = np.sum(0.5 * np.log(2 * math.pi * math.e * deviation**2))
        together = found.entropy[n].sum(axis=-1)
        np.testing.assert_allclose(together, np.full(agents, entropy), rtol=1e-4)


def gain(matrix: Any) -> float:
    """The gain of a matrix with orthogonal rows or columns, whichever are fewer."""
    matrix = np.asarray(matrix)
    square = matrix.T @ matrix if matrix.shape[0] >= matrix.shape[1] else matrix @ matrix.T
    np.testing.assert_allclose(
        square, square[0, 0] * np.eye(len(square)), atol=1e-4 * square[0, 0] + 1e-7
    )
    return float(np.sqrt(square[0, 0]))


def test_layers_begin_with_their_gains_and_without_bias() -> None:
    dims = EnvDims(agents=2, observation=9, privileged=7, action=3, values=2)
    settings = ActorCritic(
        hidden_sizes=(8, 6), gru_size=5, openrl_layers=True, action_gain=0.05, log_std_init=-0.7
    )
    for share in (True, False):
        network = dataclasses.replace(settings, share_policy=share).build(dims)
        params = jax.jit(network.init)(KEY)
        actors = (
            [params["actor"]]
            if share
            else [jax.tree.map(lambda x, i=i: x[i], params["actor"]) for i in (0, 1)]
        )
        assert params["log_std"].shape == ((3,) if share else (2, 3)) and np.allclose(
            params["log_std"], -0.7
        )
        for part, head in (*((actor, 0.05) for actor in actors), (params["critic"], 1.0)):
            assert gain(part["head"]["weight"]) == pytest.approx(head, rel=1e-3)
            for layer in (part["hidden"]["0"], part["hidden"]["1"], part["linear"]):
                assert gain(layer["weight"]) == pytest.approx(math.sqrt(2), rel=1e-3)
            for name in ("input", "hidden"):
                for gate in np.split(np.asarray(part["gru"][name]["weight"]), 3, axis=1):
                    assert gain(gate) == pytest.approx(1.0, rel=1e-3)
            layers = [*part["hidden"].values(), part["linear"], part["head"], *part["gru"].values()]
            assert not any(np.asarray(layer["bias"]).any() for layer in layers)
        if not share:
            assert np.abs(actors[0]["head"]["weight"] - actors[1]["head"]["weight"]).max() > 1e-3
    params = jax.jit(Mat(width=8, gain=0.02, blocks=2).build(dims).init)(KEY)
    blocks = [*params["encoder"]["blocks"], *params["decoder"]["blocks"]]
    for block in blocks:
        assert gain(block["mlp"]["0"]["weight"]) == pytest.approx(math.sqrt(2), rel=1e-3)
        small = [
            block["mlp"]["1"],
            *(x for name in block if "attention" in name for x in block[name].values()),
        ]
        assert len(small) in (5, 9)
        assert all(gain(layer["weight"]) == pytest.approx(0.02, rel=1e-3) for layer in small)
    for head in (params["value_head"], params["decoder"]["head"]):
        assert gain(head["hidden"]["weight"]) == pytest.approx(math.sqrt(2), rel=1e-3)
        assert gain(head["out"]["weight"]) == pytest.approx(0.02, rel=1e-3)
    for part in ("encoder", "decoder"):
        assert gain(params[part]["embed"]["weight"]) == pytest.approx(math.sqrt(2), rel=1e-3)


@pytest.mark.parametrize("kind", ["actor_critic", "mat"])
def test_actions_are_drawn_from_the_distribution_they_are_weighed_by(kind: str) -> None:
    dims = EnvDims(agents=2, observation=4, privileged=1, action=3, values=2)
    count = 4096
    plain = ActorCritic(recurrent=False, hidden_sizes=(4,), log_std_init=-0.4, log_std_min=-0.5)
    network = plain.build(dims) if kind == "actor_critic" else Mat(width=4).build(dims)
    params = network.policy_params(jax.jit(network.init)(KEY))
    obs = jnp.tile(jax.random.normal(KEY, (2, 4)), (count, 1, 1))
    act = jax.jit(network.act)
    action, density, _ = act(params, (), obs, jax.random.PRNGKey(3))
    middle, top, _ = act(params, (), obs, None)
    deviation = np.exp(-0.4) if kind == "actor_critic" else 0.5 / (1 + np.exp(-1))
    np.testing.assert_allclose(top, -np.log(deviation * np.sqrt(2 * np.pi)), rtol=1e-4)
    z = (np.asarray(action) - np.asarray(middle)) / deviation
    np.testing.assert_allclose(density[:, 0], top[:, 0] - 0.5 * z[:, 0] ** 2, atol=1e-4)
    columns = z.reshape(count, 6)
    assert np.abs(columns.mean(0)).max() < 0.08 and np.abs(columns.std(0) - 1).max() < 0.05
    assert np.abs(np.corrcoef(columns.T) - np.eye(6)).max() < 0.08
    assert abs(np.corrcoef(columns[:-1, 0], columns[1:, 0])[0, 1]) < 0.08


def test_a_policy_normalises_scales_and_clips() -> None:
    dims = EnvDims(agents=2, observation=3, privileged=1, action=2, values=2)
    network = {"recurrent": False, "action_gain": 3.0, "log_std_init": -1.0}
    config = settings(action_scale=0.5, network=network)
    network = config.network.build(dims)
    params = network.policy_params(jax.jit(network.init)(KEY))
    statistics = RunningStatistics(jnp.full(3, 0.5), jnp.full(3, 4.0), jnp.float32(9.0))
    policy = TrainedPolicy(params, statistics, Needs(task="probe", dims=dims), config, {})
    obs = 4.0 * jax.random.normal(KEY, (50, 2, 3))
    raw, _, _ = network.act(params, (), (obs - 0.5) / 2.0, None)
    np.testing.assert_allclose(
        policy.act(obs, ())[0], np.clip(0.5 * np.asarray(raw), -1, 1), atol=1e-5
    )
    assert np.abs(raw).max() > 2.5
    drawn = policy.act(obs, (), KEY)[0]
    same = dataclasses.replace(policy, deterministic=True).act(obs, (), KEY)[0]
    np.testing.assert_allclose(same, policy.act(obs, ())[0])
    assert np.abs(np.asarray(drawn - same)).max() > 0.1


def test_gae_of_integer_rewards_keeps_fractions_of_the_bootstrap() -> None:
    ones = jnp.ones((1, 1), jnp.int32)
    advantage, _ = gae(
        ones,
        jnp.zeros((1, 1)),
        2.0 * ones,
        0.3 * ones,
        ones.astype(bool),
        gamma=1.0,
        gae_lambda=1.0,
    )
    np.testing.assert_allclose(advantage, [[1.0 + 0.7 * 2.0]], rtol=1e-6)


def test_schedules_by_hand() -> None:
    """Ten updates; the assistance falls to 0 in five, the learning rate in the last two, and so
    on.
    """
    config = TrainConfig(
        num_envs=1,
        rollout_steps=10,
        total_steps=100,
        ppo=PPO(entropy_coef=0.01, entropy_coef_final=0.0, critic_warmup=0.2),
        optimizer=OptimizerSettings(schedule="linear", anneal=0.2),
        curriculum=Curriculum(
            assistance=1.0, assistance_until=0.5, failure_bootstrap=0.8, failure_bootstrap_until=0.4
        ),
        imitation=Imitation(weight=3.0, until=0.6),
    )
    expected = {
        0: (1.0, 0.8, 0.01, 3.0, 0.0, 0.0, 1.0),
        2: (0.6, 0.4, 0.008, 2.0, 1.0, 1.0, 1.0),
        5: (0.0, 0.0, 0.005, 0.5, 1.0, 0.0, 1.0),
        9: (0.0, 0.0, 0.001, 0.0, 1.0, 0.0, 0.5),
    }
    for updates, values in expected.items():
        np.testing.assert_allclose(
            jnp.stack(current_values(config, jnp.int32(updates))), values, rtol=1e-5, atol=1e-7
        )


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
    np.testing.assert_array_equal(
        running_normalize(statistics, jnp.array([1e6, -1e6, 3.0]))[:2], [10.0, -10.0]
    )
    constant = running_update(running_init(1), jnp.full((10, 1), 7.0), jnp.ones(10, bool))
    np.testing.assert_allclose(running_normalize(constant, jnp.array([7.0])), [0.0], atol=1e-4)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_value_statistics_are_debiased_and_invertible_at_any_scale(scale: float) -> None:
    target = scale * jnp.array([1.0, 3.0])
    statistics = value_update(
        value_init(), jnp.append(target, 1e9), jnp.array([True, True, False]), 0.99
    )
    np.testing.assert_allclose(value_normalize(statistics, target), [-1.0, 1.0], rtol=1e-3)
    np.testing.assert_allclose(
        value_denormalize(statistics, value_normalize(statistics, target)), target, rtol=1e-6
    )


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
    config = build(
        TrainConfig,
        {"num_envs": 2, "rollout_steps": 1, "total_steps": 20, "ppo": {"critic_warmup": 0.3}},
    )
    begins = [bool(current_values(config, jnp.int32(i)).actor_begins) for i in range(10)]
    assert begins == [i == 3 for i in range(10)]
    optimizer = adam(eps=1e-8)
    params = {"a": jnp.zeros(())}
    state = optimizer.init(params)
    update = jax.jit(optimizer.update)
    for _ in range(500):
        params, state, _ = update({"a": jnp.zeros(())}, state, params, 0.1)
    gradient = {"a": jnp.float32(0.5)}
    assert float(update(gradient, restart(state, False), params, 0.1)[0]["a"]) < -0.15
    again = restart(state, jnp.bool_(True))
    assert float(update(gradient, again, params, 0.1)[0]["a"]) == pytest.approx(-0.1, rel=1e-4)


def test_gru_by_hand() -> None:
    params = nn.gru_init(KEY, 2, 3)
    h = jax.random.normal(KEY, (4, 3))
    x = jax.random.normal(KEY, (4, 2))

    def gates(name: str, value: jax.Array) -> list[np.ndarray]:
        return np.split(np.asarray(value @ params[name]["weight"]), 3, axis=-1)

    def sigmoid(z: np.ndarray) -> np.ndarray:
        return 1 / (1 + np.exp(-z))

    (rx, ux, cx) = gates("input", x)
    (rh, uh, ch) = gates("hidden", h)
    reset = sigmoid(rx + rh)
    update = sigmoid(ux + uh)
    expected = (1 - update) * np.tanh(cx + reset * ch) + update * np.asarray(h)
    np.testing.assert_allclose(nn.gru(params, h, x), expected, atol=1e-5)


def test_weights_are_drawn_without_lapack() -> None:
    # Its decompositions wait for each other in XLA's threads and can stop a program on two cores
    # for good.
    lowered = jax.jit(lambda key: nn.orthogonal(key, (8, 4), 1.0)).lower(jax.random.PRNGKey(0))
    assert "custom_call" not in lowered.as_text()


def test_a_bounded_parameter_comes_back_from_beyond_its_bounds() -> None:
    x = jnp.array([-2.0, -1.0, 0.0, 1.0, 2.0])

    def slope(direction: float) -> jax.Array:
        return jax.grad(lambda x: jnp.sum(direction * nn.clip_parameter(x, -1.5, 1.5)))(x)

    np.testing.assert_allclose(nn.clip_parameter(x, -1.5, 1.5), [-1.5, -1.0, 0.0, 1.0, 1.5])
    # descent lowers x: back from above, never farther down
    np.testing.assert_allclose(slope(1.0), [0, 1, 1, 1, 1])
    np.testing.assert_allclose(slope(-1.0), [-1, -1, -1, -1, 0])


@pytest.mark.parametrize("recurrent", [False, True])
def test_normalised_layers_by_hand(recurrent: bool) -> None:
    """OpenRL's order: dense, activation, norm; dense, norm; recurrent unit, norm; action layer."""
    settings = ActorCritic(
        openrl_layers=True,
        hidden_sizes=(5,),
        recurrent=recurrent,
        gru_size=4,
        critic_input="own",
        action_gain=1.0,
    )
    dims = EnvDims(agents=2, observation=3, privileged=0, action=2, values=2)
    network = settings.build(dims)
    obs = jax.random.normal(KEY, (6, 2, 3))
    params = random_params(network)
    memory = network.initial_memory(6)
    mean, _, after = jax.jit(network.act)(params, memory.actor, obs, None)

    actor = params["actor"]

    def norm(i, x):
        return nn.layer_norm(actor["norm"][str(i)], x)

    x = norm(0, jnp.maximum(nn.dense(actor["hidden"]["0"], obs), 0.0))
    x = norm(1, nn.dense(actor["linear"], x))
    if recurrent:
        state = nn.gru(actor["gru"], memory.actor, x)
        # the recurrent state itself is not normalised
        np.testing.assert_allclose(after, state, atol=1e-5)
        x = norm(2, state)
    np.testing.assert_allclose(mean, nn.dense(actor["head"], x), atol=1e-5)
