"""Networks that encode observations by blocks: entities in any order and number, images, statistics
of features.
"""

import functools
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax.core.blocks import Block, entities, image
from mqe_jax.core.settings import build
from mqe_jax.sensors.pipeline import Pipeline
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.encoder import by_block, convolve
from mqe_jax.train.needs import Needs
from mqe_jax.train.networks import Blocks, EnvDims
from mqe_jax.train.normalize import features_of, running_init, running_normalize, running_update
from mqe_jax.train.policy import TrainedPolicy
from tests.inputs import refuses
from tests.training import export_error, random_params

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
def made() -> Any:
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
    (_, results) = made()
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
    params = made()[0]["actor"]["encoder"]
    encoders = [by_block(SETTINGS, dims_of(*b)) for b in (BLOCKS, more)]
    assert encoders[0].size == encoders[1].size == 2 + 3 * 10 + 1
    none = np.asarray(encoders[1].apply(params, jnp.zeros(dims_of(*more).observation)))
    # nobody is there but the sheep
    assert not none[2:12].any() and none[12:22].any() and not none[22:].any()
    assert features_of(BLOCKS).count == features_of(more).count == 2 + 3 + 2 + 1


def test_entities_are_those_of_plain_sums() -> None:
    obs = drawn(np.random.default_rng(1), 4)
    params = made()[0]["actor"]["encoder"]
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
        name="probe", control="torque", robot=SimpleNamespace(torque_limit=1.0)
    )
    env.moving = lambda action: action
    assert export_error(policy, env) < 1e-5


def test_an_environment_must_describe_its_observations() -> None:
    refuses(
        r"network\.name: 'blocks' .* does not describe",
        Blocks().build,
        dims_of()._replace(observation=3),
    )
