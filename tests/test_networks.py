"""Algorithms and networks: their settings, the multi-agent transformer, every network in every use,
and encoders of observations by blocks: entities in any order and number, images.
"""

import functools
import math
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax.acting.evaluate import evaluate_batch
from mqe_jax.acting.seats import Seats
from mqe_jax.core.blocks import Block, entities, image
from mqe_jax.core.settings import build, override
from mqe_jax.core.types import Cast, NetworkMemory, Params
from mqe_jax.physics.robots.fleet import Fleet
from mqe_jax.physics.robots.go1 import GO1
from mqe_jax.presets import preset
from mqe_jax.sensors.pipeline import Pipeline
from mqe_jax.skills.agile import FRAME_SIZE, NOW_SIZE
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.encoder import by_block, convolve
from mqe_jax.train.mat import Mat, log_std_of
from mqe_jax.train.needs import Needs
from mqe_jax.train.networks import NETWORKS, Blocks, EnvDims, Network
from mqe_jax.train.normalize import features_of, running_init, running_normalize, running_update
from mqe_jax.train.policy import TrainedPolicy, read_policy
from mqe_jax.train.runner import train_seeds
from mqe_jax.view.session import Session
from mqe_jax.walk import network as walk_network  # registers it
from mqe_jax.walk_policy import OBSERVATION_SIZE
from tests.inputs import refuses
from tests.training import (
    FAST,
    Probe,
    assert_same,
    export_error,
    pay_meeting,
    pay_public_good,
    random_params,
    settings,
    show_hidden,
    updated,
)

ALGORITHMS = ("mappo", "jrpo", "mat", "ippo", "dual-clip")
PLAIN = {"network": FAST["network"]}


def learn(algorithm: str, pay: Any, updates: int, *changes: dict[str, Any]) -> np.ndarray:
    """Trains by an algorithm's preset and returns the mean rewards per step of all updates."""
    config = override(settings({**FAST, "network": {}}), preset(algorithm))
    for change in changes:
        config = override(config, change)
    metrics = updated(Probe(show_hidden, pay, num_envs=32), config, updates, seed=1)[1]
    return np.array([float(row["average_step_reward"]) for row in metrics])


@pytest.mark.parametrize(("algorithm", "cooperates"), [("jrpo", True), ("ippo", False)])
def test_only_the_joint_ratio_cooperates_for_a_public_good(
    algorithm: str, cooperates: bool
) -> None:
    """Individual ratios converge to the Nash equilibrium, -0.5 each; the joint ratio contributes
    all, +0.5 each.
    """
    reward = learn(algorithm, pay_public_good, 50, PLAIN)[-5:].mean()
    assert reward >= 0.45 if cooperates else reward <= -0.45


@pytest.mark.soak
def test_acting_one_after_the_other_halves_the_loss_of_a_meeting() -> None:
    log_std = -1.2
    fixed = {"network": {"log_std_init": log_std, "log_std_min": log_std, "log_std_max": log_std}}
    small = {"network": {"width": 16, "deviation": "free"}, "optimizer": {"learning_rate": 3e-3}}
    assert -learn("mat", pay_meeting, 100, small, fixed)[-20:].mean() / math.exp(2 * log_std) <= 1.2


KEY = jax.random.PRNGKey(0)
NO_MEMORY = NetworkMemory((), ())


def dims(agents: int) -> EnvDims:
    return EnvDims(agents=agents, observation=5, privileged=1, action=2, values=agents)


def made(agents: int, **settings: Any) -> tuple[Network, Params, jax.Array]:
    """A network with strong weights, so that every path counts, and observations (4, A, 5)."""
    network = Mat(gain=1.0, width=8, **settings).build(dims(agents))
    network = network._replace(
        init=jax.jit(network.init), act=jax.jit(network.act), evaluate=jax.jit(network.evaluate)
    )
    return network, network.init(KEY), jax.random.normal(KEY, (4, agents, 5))


def log_probs(network: Network, params: Params, obs: jax.Array, action: jax.Array) -> np.ndarray:
    first = jnp.zeros(obs.shape[:1], bool)
    return np.asarray(
        network.evaluate(params, NO_MEMORY, first, obs, obs[..., 0, :1], action).log_prob
    )


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


def test_an_agent_that_takes_no_part_is_left_out_of_the_sequence() -> None:
    network, params, obs = made(4, heads=2)
    there = np.array([0, 2, 3])
    active = jnp.zeros((4, 4), bool).at[:, there].set(True)
    action, density, _ = network.act(network.policy_params(params), (), obs, None, active)
    fewer = made(3, heads=2)[0]
    alone, its_density, _ = fewer.act(fewer.policy_params(params), (), obs[:, there], None)
    np.testing.assert_allclose(action[:, there], alone, atol=1e-5)
    np.testing.assert_allclose(density[:, there], its_density, atol=1e-5)
    first = jnp.zeros(4, bool)
    taken = jax.random.normal(KEY, (4, 4, 2))
    one = network.evaluate(params, NO_MEMORY, first, obs, obs[..., 0, :1], taken, active)
    two = fewer.evaluate(params, NO_MEMORY, first, obs[:, there], obs[..., 0, :1], taken[:, there])
    np.testing.assert_allclose(one.log_prob[:, there], two.log_prob, atol=1e-5)
    np.testing.assert_allclose(one.value[:, there], two.value, atol=1e-5)


def test_a_free_deviation_beyond_its_bounds_gets_the_gradient_that_leads_back() -> None:
    settings = Mat(deviation="free", log_std_init=-2.0, log_std_max=-1.0, log_std_min=-3.0)

    def log_std(parameter: jax.Array) -> jax.Array:
        return jnp.sum(log_std_of({"deviation": parameter}, settings))

    beyond = jnp.array([0.0, -2.0, -4.0])
    np.testing.assert_allclose(log_std_of({"deviation": beyond}, settings), [-1.0, -2.0, -3.0])
    np.testing.assert_array_equal(jax.grad(log_std)(beyond), [1.0, 1.0, 0.0])
    np.testing.assert_array_equal(jax.grad(lambda x: -log_std(x))(beyond), [0.0, -1.0, -1.0])


def test_settings_that_do_not_fit_are_named() -> None:
    refuses("heads: 3", Mat, heads=3)
    said = "log_std_init: 0.0 is not allowed; it must be at most log_std_max"
    refuses(said, Mat, deviation="free", log_std_max=-1.0)
    refuses(r"ppo\.value", Mat().build, dims(3)._replace(values=1))


# -- every registered network in every use


VARIANTS: dict[str, list[dict[str, Any]]] = {
    "actor_critic": [
        {"recurrent": False, "hidden_sizes": (4, 4), "action_mean": "tanh", "activation": "elu"},
        {
            "recurrent": True,
            "gru_size": 4,
            "hidden_sizes": (4,),
            "openrl_layers": True,
            "share_policy": False,
        },
    ],
    "blocks": [{"gru_size": 4, "hidden_sizes": (4,), "entity_sizes": (4,), "chunk_length": 2}],
    "mat": [{"width": 8, "heads": 2, "blocks": 1}],
    "walk": [{"chunk_length": 2}],
    "agile": [{"chunk_length": 2}],
}
"""Settings of every registered network."""
CASES = [
    pytest.param(
        {"name": name, **settings},
        id=f"{name}{number}",
        marks=() if (name, number) == ("actor_critic", 0) else pytest.mark.soak,
    )
    for name in VARIANTS
    for number, settings in enumerate(VARIANTS[name])
]
"""The first settings of the feed-forward network; the others, MAT and the skills, in the soak."""


def pay_each(hidden: jax.Array, action: jax.Array) -> jax.Array:
    return -jnp.mean(jnp.square(action - 0.5 * hidden[:, None, None]), axis=-1)


def show_widely(width: int, hidden: jax.Array, step: jax.Array) -> jax.Array:
    shown = jnp.stack([hidden, step.astype(jnp.float32)], axis=-1)
    return jnp.tile(shown, (1, -(-width // 2)))[:, :width]


def probe(network: str) -> Any:
    """Environments of the sizes that a network needs, with the attributes that the viewer and the
    export read.
    """
    skilled = {"walk": OBSERVATION_SIZE, "agile": FRAME_SIZE + NOW_SIZE}
    agents = 1 if network in skilled else 2
    width = skilled[network] - agents if network in skilled else 5
    show = functools.partial(show_widely, width)
    teams = (tuple(range(agents)),)
    env = Probe(
        show, pay_each, 4, agents, action_size=12, features=width, max_episode_steps=3, teams=teams
    )
    blocks = (Block("one_hot", 2), entities("pair", "robot", 2, 1, masked=True), Block("rest", 1))
    described = {"describe": lambda group: {"blocks": blocks}} if network == "blocks" else {}
    given = {"dt": 0.02, "control": "torque", "robots": Fleet([GO1] * agents)}
    for name, value in {**given, **described}.items():
        object.__setattr__(env, name, value)
    return env


def test_every_registered_network_is_here() -> None:
    assert walk_network.WalkNetwork is NETWORKS["walk"]
    assert set(VARIANTS) == {
        name for name, kind in NETWORKS.items() if kind.__module__.startswith("mqe_jax")
    }


@pytest.mark.usefixtures("shared_programs")
@pytest.mark.parametrize("network", CASES)
def test_a_network_is_evaluated_resumed_trained_with_seeds_viewed_and_exported(
    network: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    once = {
        "checkpoint__every": 1,
        "evaluation": {"every": 2, "episodes": 4},
        "ppo__epochs": 1,
        "total_steps": 3 * 16,
    }
    env = probe(network["name"])
    config = settings(**once, loggers=(), network=network)
    configs = [config, override(config, {"seed": 1})]
    whole = tmp_path / "whole"
    stopped = tmp_path / "stopped"
    folders = [[parent / name for name in ("seed0", "seed1")] for parent in (whole, stopped)]

    def copy(state: Any, row: dict[str, float]) -> None:
        if row["updates"] == 2 and not stopped.exists():  # with the checkpoints of update 1
            shutil.copytree(whole, stopped)

    expected = train_seeds(Cast(env, env), configs, folders[0], on_update=copy)
    assert_same(train_seeds(Cast(env, env), configs, folders[1], resume=True), expected)
    one, other = (jax.tree.leaves(state.params) for state in expected)
    assert all(np.all(np.isfinite(leaf)) for leaf in one)
    assert any(not np.array_equal(a, b) for a, b in zip(one, other, strict=True))

    policy = read_policy(whole / "seed1")
    result = evaluate_batch(env, policy, 8, jax.random.PRNGKey(0), block=3)
    assert result.episode_length == 3.0 and -4.0 < result.average_step_reward < 0.0
    monkeypatch.setattr(Session, "moment", lambda self: None)  # the probe has no bodies
    session = Session(env, env, Seats.of(env, policy))
    for _ in range(4):
        session.advance()
    assert session.episodes.tolist() == [1] * 4 and np.all(np.isfinite(session.rewards))
    sizes = {"observation_size": policy.dims[1], "moving": lambda action: action}
    described: Any = SimpleNamespace(name="probe", control=env.control, robots=env.robots, **sizes)
    assert export_error(policy, described) < 2e-5


# -- encoders of entities and images, statistics of features


BLOCKS = (
    Block("own", 2),
    entities("mates", "robot", 2, 3, masked=True),
    entities("sheep", "sheep", 3, 2),
    entities("opponents", "robot", 3, 3, masked=True),
    Block("goal", 1),
)
SETTINGS = Blocks(
    entity_sizes=(6, 5), hidden_sizes=(8,), gru_size=4, critic_input="observations", chunk_length=2
)


def dims_of(*blocks: Block) -> EnvDims:
    return EnvDims(2, sum(block.width for block in blocks), 4, 3, 2, blocks)


def drawn(
    random: np.random.Generator, *shape: int, blocks: tuple[Block, ...] = BLOCKS
) -> np.ndarray:
    """Observations (*shape, O) whose masks are 0 or 1, and whose masked entities are not 0."""
    parts = []
    for block in blocks:
        part = random.normal(size=(*shape, block.width))
        if block.entities and block.entities.masked:
            rows = part.reshape(*shape, block.entities.count, -1)
            rows[..., -1] = random.random(rows.shape[:-1]) < 0.6
        parts.append(part)
    return np.concatenate(parts, axis=-1).astype(np.float32)


def changed(obs: np.ndarray, change: Any) -> np.ndarray:
    """Observations whose masked blocks, by entity (..., count, width), are changed in place."""
    obs = obs.copy()
    start = 0
    for block in BLOCKS:
        if block.entities and block.entities.masked:
            rows = (
                obs[..., start : start + block.width]
                .reshape(*obs.shape[:-1], block.entities.count, -1)
                .copy()
            )
            change(rows)
            obs[..., start : start + block.width] = rows.reshape(*obs.shape[:-1], -1)
        start += block.width
    return obs


@functools.cache
def encoded() -> Any:
    """Parameters of a network, and its compiled mean action, value and gradient of a chunk's
    loss.
    """
    network = SETTINGS.build(dims_of(*BLOCKS))
    params = random_params(network)
    privileged = jnp.zeros((2, 3, 4))
    memory = network.initial_memory(3)
    first = jnp.zeros((2, 3), bool)

    @jax.jit
    def results(obs: Any) -> Any:
        def loss(params: Any) -> Any:
            chunk = network.evaluate(params, memory, first, obs, privileged, jnp.ones((2, 3, 2, 3)))
            return jnp.sum(chunk.log_prob) + jnp.sum(chunk.value), chunk

        return jax.grad(loss, has_aux=True)(params)

    return params, results


def test_entities_have_no_order_and_masked_ones_no_effect() -> None:
    random = np.random.default_rng(0)
    obs = drawn(random, 2, 3, 2)
    (_, results) = encoded()
    gradient, chunk = results(obs)

    def exchange(rows: np.ndarray) -> None:
        rows[:] = rows[..., ::-1, :].copy()

    def forge(rows: np.ndarray) -> None:
        hidden = rows[..., -1] < 0.5
        rows[..., :-1][hidden] = random.normal(size=(hidden.sum(), rows.shape[-1] - 1)) * 100

    jax.tree.map(
        functools.partial(np.testing.assert_allclose, atol=1e-5),
        results(changed(obs, exchange))[1],
        chunk,
    )
    jax.tree.map(np.testing.assert_array_equal, results(changed(obs, forge)), (gradient, chunk))

    def reveal(rows: np.ndarray) -> None:
        rows[..., -1] = 1.0

    assert np.all(
        np.asarray(results(changed(obs, reveal))[1].log_prob != chunk.log_prob).any(axis=(0, 1))
    )
    assert all(np.any(np.asarray(x) != 0) for x in jax.tree.leaves(gradient["actor"]["encoder"]))


def test_an_actor_has_no_size_that_depends_on_the_number_of_entities() -> None:
    more = [Pipeline(history=2).block(block) if block.entities else block for block in BLOCKS]
    few = SETTINGS.build(dims_of(*BLOCKS))
    many = SETTINGS.build(dims_of(*more))
    shapes = [
        jax.tree.map(jnp.shape, jax.eval_shape(n.init, jax.random.PRNGKey(0))["actor"])
        for n in (few, many)
    ]
    assert shapes[0] == shapes[1]
    assert set(shapes[0]["encoder"]) == {"robot_3", "sheep_2"}  # mates and opponents share one
    params = encoded()[0]["actor"]["encoder"]
    encoders = [by_block(SETTINGS, dims_of(*b)) for b in (BLOCKS, more)]
    assert encoders[0].size == encoders[1].size == 2 + 3 * 10 + 1
    none = np.asarray(encoders[1].apply(params, jnp.zeros(dims_of(*more).observation)))
    # nobody is there but the sheep
    assert not none[2:12].any() and none[12:22].any() and not none[22:].any()
    assert features_of(BLOCKS).count == features_of(more).count == 2 + 3 + 2 + 1


def test_entities_are_those_of_plain_sums() -> None:
    obs = drawn(np.random.default_rng(1), 4)
    params = encoded()[0]["actor"]["encoder"]
    found = np.asarray(by_block(SETTINGS, dims_of(*BLOCKS)).apply(params, jnp.asarray(obs)))
    for row, got in zip(obs, found, strict=True):
        features = []
        for entity in row[2:10].reshape(2, 4):
            x = entity[:3]
            for i in "01":
                layer = params["robot_3"][i]
                x = np.maximum(x @ np.asarray(layer["weight"]) + np.asarray(layer["bias"]), 0)
            features += [x] if entity[3] else []
        expected = (
            [np.max(features, axis=0), np.mean(features, axis=0)] if features else np.zeros((2, 5))
        )
        np.testing.assert_allclose(got[2:12], np.ravel(expected), atol=1e-5)


def test_convolutions_are_those_of_loops() -> None:
    block = image("depth", 5, 4)
    settings = Blocks(image_channels=(3, 2), image_size=7)
    network = settings.build(dims_of(block))
    params = random_params(network)["actor"]["encoder"]["depth"]
    picture = np.random.default_rng(0).normal(size=(5, 4, 1))
    x = picture
    for i in "01":
        weight = np.asarray(params[i]["weight"], float)
        bias = np.asarray(params[i]["bias"], float)
        height, width, channels = x.shape
        padded = np.zeros((height + 2, width + 2, channels))
        padded[1:-1, 1:-1] = x
        x = np.array(
            [
                [padded[r : r + 3, c : c + 3].reshape(-1) for c in range(0, width, 2)]
                for r in range(0, height, 2)
            ]
        )
        x = np.maximum(x @ weight + bias, 0)
    out = np.maximum(
        x.reshape(-1) @ np.asarray(params["out"]["weight"]) + np.asarray(params["out"]["bias"]), 0
    )
    found = convolve(params, jnp.asarray(picture.reshape(1, -1), jnp.float32), (1, 5, 4))
    np.testing.assert_allclose(found, out[None], atol=1e-5)
    assert found.shape == (1, 7) and np.any(out)


def test_statistics_are_those_of_all_entities_of_a_kind_that_are_there() -> None:
    blocks = (*BLOCKS, image("depth", 2, 2))
    random = np.random.default_rng(0)
    features = features_of(blocks)
    obs = np.concatenate([drawn(random, 50, 2), random.random((50, 2, 4))], axis=-1).astype(
        np.float32
    )
    active = random.random((50, 2)) < 0.8
    statistics = running_init(obs.shape[-1], features)
    np.testing.assert_allclose(running_normalize(statistics, jnp.asarray(obs), features), obs)
    for part in (slice(0, 20), slice(20, 50)):
        statistics = jax.jit(running_update, static_argnums=3)(
            statistics, obs[part], active[part], features
        )
    rows = obs[active]
    robots = np.concatenate([rows[:, 2:10].reshape(-1, 4), rows[:, 16:28].reshape(-1, 4)])
    robots = robots[robots[:, 3] > 0.5, :3]
    sheep = rows[:, 10:16].reshape(-1, 2)
    columns = [*rows[:, :2].T, *robots.T, *sheep.T, rows[:, 28]]
    np.testing.assert_allclose(statistics.mean, [x.mean() for x in columns], atol=1e-5)
    np.testing.assert_allclose(statistics.variance, [x.var() for x in columns], rtol=1e-4)
    np.testing.assert_array_equal(statistics.samples, [len(x) for x in columns])
    normal = np.asarray(running_normalize(statistics, jnp.asarray(obs), features))
    # masks
    np.testing.assert_array_equal(normal[..., [5, 9, 19, 23, 27]], obs[..., [5, 9, 19, 23, 27]])
    np.testing.assert_array_equal(normal[..., 29:], obs[..., 29:])  # pixels
    np.testing.assert_allclose(
        normal[..., 10], (obs[..., 10] - sheep[:, 0].mean()) / sheep[:, 0].std(), atol=1e-4
    )


@pytest.mark.soak
@pytest.mark.parametrize("recurrent", [False, True])
def test_entities_and_images_are_exported(recurrent: bool) -> None:
    pytest.importorskip("jax2onnx")
    blocks = (*BLOCKS, image("depth", 5, 4))
    network = {
        "name": "blocks",
        "recurrent": recurrent,
        "hidden_sizes": (8,),
        "gru_size": 4,
        "entity_sizes": (6, 5),
    }
    config = build(TrainConfig, {"network": network, "normalization": {"observations": True}})
    needs = Needs(task="probe", dims=dims_of(*blocks))
    built = config.network.build(needs.dims)
    statistics = running_init(needs.dims.observation, features_of(blocks))
    statistics = statistics._replace(mean=statistics.mean + 0.3, variance=2.0 * statistics.variance)
    policy = TrainedPolicy(built.policy_params(random_params(built)), statistics, needs, config, {})
    env: Any = SimpleNamespace(
        name="probe", control="torque", robots=SimpleNamespace(table=lambda name: np.ones((2, 1)))
    )
    env.moving = lambda action: action
    assert export_error(policy, env) < 1e-5


def test_an_environment_must_describe_its_observations() -> None:
    refuses(
        r"network\.name: 'blocks' .* does not describe",
        Blocks().build,
        dims_of()._replace(observation=3),
    )
