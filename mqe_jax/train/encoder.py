"""Encoders, the first layers of a network: of an observation as it is, or of its blocks.

Sources: Deep Sets, Zaheer et al., arXiv 1703.06114 (entities); the maximum besides the mean, as in
PointNet, Qi et al., arXiv 1612.00593.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from mqe_jax.core.blocks import Block, Entities
from mqe_jax.core.settings import fail
from mqe_jax.core.types import Params
from mqe_jax.train import nn
from mqe_jax.train.networks import Blocks, EnvDims


class Encoder(NamedTuple):
    """Layers that turn observations into what the next layers read."""

    init: Callable[[jax.Array], Params]
    """Random key to parameters; none if the layers have none."""
    apply: Callable[[Params, jax.Array], jax.Array]
    """Parameters and observations (..., O) to (..., size)."""
    size: int
    """Number of entries that the next layers read."""


def plain(size: int) -> Encoder:
    """Returns the encoder that leaves observations of a size as they are."""
    return Encoder(lambda key: {}, lambda params, x: x, size)


def of_team(encoder: Encoder, agents: int) -> Encoder:
    """Returns an encoder that applies `encoder` to the observation of every agent.

    The input holds the observations one after another, the output their features.
    """

    def apply(params: Params, x: jax.Array) -> jax.Array:
        each = encoder.apply(params, x.reshape(*x.shape[:-1], agents, -1))
        return each.reshape(*x.shape[:-1], -1)

    return Encoder(encoder.init, apply, agents * encoder.size)


def by_block(settings: Blocks, dims: EnvDims) -> Encoder:
    """Returns the encoder that pools entities, convolves images and passes on all other blocks.

    Raises:
        InputError: if `dims` does not describe the blocks of the observation.
    """
    blocks = dims.blocks
    if sum(block.width for block in blocks) != dims.observation:
        fail(
            "network.name",
            settings.name,
            "another network: the environment does not describe its observations",
        )
    kinds = {_kind(block.entities): block.entities.width for block in blocks if block.entities}
    images = {block.name: block.image for block in blocks if block.image}

    def init(key: jax.Array) -> Params:
        keys = iter(
            jax.random.split(key, len(kinds) + len(images) * (1 + len(settings.image_channels)) + 1)
        )
        params: Params = {}
        for kind, width in kinds.items():
            params[kind] = nn.mlp_init(
                next(keys), (width, *settings.entity_sizes), final_scale=2.0**0.5
            )
        for name, (channels, height, width) in images.items():
            layers: Params = {}
            for i, size in enumerate(settings.image_channels):
                layers[str(i)] = nn.dense_init(next(keys), 9 * channels, size)
                channels = size
                height = -(-height // 2)
                width = -(-width // 2)
            layers["out"] = nn.dense_init(
                next(keys), channels * height * width, settings.image_size
            )
            params[name] = layers
        return params

    def encode(params: Params, block: Block, x: jax.Array) -> jax.Array:
        if block.entities is not None:
            return pool(params[_kind(block.entities)], x, block.entities)
        return convolve(params[block.name], x, block.image) if block.image else x

    def apply(params: Params, x: jax.Array) -> jax.Array:
        ends = [sum(block.width for block in blocks[: i + 1]) for i in range(len(blocks))]
        parts = [x[..., end - block.width : end] for block, end in zip(blocks, ends, strict=True)]
        return jnp.concatenate(
            [encode(params, *each) for each in zip(blocks, parts, strict=True)], axis=-1
        )

    sizes = (
        2 * settings.entity_sizes[-1]
        if block.entities
        else settings.image_size
        if block.image
        else block.width
        for block in blocks
    )
    return Encoder(init, apply, sum(sizes))


def _kind(entities: Entities) -> str:
    """Returns the name of the parameters that entities of one kind and width share."""
    return f"{entities.kind}_{entities.width}"


def pool(params: Params, x: jax.Array, entities: Entities) -> jax.Array:
    """Returns maxima and means of the features of the entities that are there.

    Shapes: (..., block) -> (..., 2 W). They are 0 if no entity is there. Masked entities have no
    effect. The order of entities has none beyond rounding.
    """
    rows = x.reshape(*x.shape[:-1], entities.count, -1)
    there = rows[..., -1:] > 0.5 if entities.masked else jnp.ones_like(rows[..., :1], bool)
    features = nn.mlp(params, rows[..., : entities.width], jax.nn.relu, activate_last=True)
    features = jnp.where(there, features, 0.0)  # which no maximum is below
    count = jnp.maximum(jnp.sum(there.astype(x.dtype), axis=-2), 1.0)
    return jnp.concatenate(
        [jnp.max(features, axis=-2), jnp.sum(features, axis=-2) / count], axis=-1
    )


def convolve(params: Params, x: jax.Array, image: tuple[int, int, int]) -> jax.Array:
    """Returns the features of an image (..., channels x height x width).

    The convolutions cover 3 x 3 pixels at stride 2.
    """
    x = jnp.moveaxis(x.reshape(*x.shape[:-1], *image), -3, -1)
    for i in range(len(params) - 1):
        x = jax.nn.relu(nn.dense(params[str(i)], _patches(x)))
    return jax.nn.relu(nn.dense(params["out"], x.reshape(*x.shape[:-3], -1)))


def _patches(x: jax.Array) -> jax.Array:
    """Returns the 3 x 3 neighbourhoods of every second pixel.

    Shapes: (..., H, W, C) -> (..., H / 2, W / 2, 9 C), rounded up. Beyond the edges are zeros.
    """
    height, width = x.shape[-3:-1]
    for axis in (-3, -2):  # jnp.pad has no translation to a graph
        edge = jnp.zeros_like(jax.lax.slice_in_dim(x, 0, 1, axis=axis))
        x = jnp.concatenate([edge, x, edge], axis=axis)
    rows = 2 * -(-height // 2) - 1
    columns = 2 * -(-width // 2) - 1
    near = [x[..., i : i + rows : 2, j : j + columns : 2, :] for i in range(3) for j in range(3)]
    return jnp.concatenate(near, axis=-1)
