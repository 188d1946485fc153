"""The left-right symmetry of a quadruped, as a loss: a mirrored observation deserves the mirrored action.

Mirroring exchanges left and right legs and reverses y, roll, yaw and the hip joints. The parameters of the four gaits
stay: exchanging a gait's left and right feet shifts its phase, which the clock shows.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax import walk_policy
from mqe_jax.robots.robot import MIRRORED_JOINTS, MIRRORED_SIGNS
from mqe_jax.walk_policy import OBSERVATION_SIZE

_FEET = np.array([1, 0, 3, 2])


def _observation() -> tuple[np.ndarray, np.ndarray]:
    """Returns source (70,) and sign (70,) of each number of a mirrored observation."""
    signs = np.array([command.mirror for command in walk_policy.COMMANDS], np.float32)
    blocks: list[tuple[np.ndarray, np.ndarray]] = [
        (np.arange(3), np.array([1.0, -1.0, 1.0], np.float32)),  # gravity
        (np.arange(len(signs)), signs),
        *[(MIRRORED_JOINTS, MIRRORED_SIGNS)] * 4,  # position, velocity, last action, the one before
        (_FEET, np.ones(4, np.float32)),  # clock
    ]
    starts = np.cumsum([0, *(len(source) for source, _ in blocks)])
    source = np.concatenate([source + start for (source, _), start in zip(blocks, starts[:-1], strict=True)])
    return source, np.concatenate([sign for _, sign in blocks])


_SOURCE, _SIGN = _observation()


def mirror_history(flat: jax.Array) -> jax.Array:
    """Mirrors flattened histories (..., T x 70)."""
    return (flat.reshape(*flat.shape[:-1], -1, OBSERVATION_SIZE)[..., _SOURCE] * _SIGN).reshape(flat.shape)


def mirror_action(action: jax.Array) -> jax.Array:
    """Mirrors actions (..., 12)."""
    return action[..., MIRRORED_JOINTS] * MIRRORED_SIGNS


def symmetry_loss(
    params: walk_policy.Params, flat: jax.Array, mean: jax.Array, *, precision: str = "highest"
) -> jax.Array:
    """Returns the mean square difference () between the actions of mirrored histories and the mirrored actions.

    Args:
        params: weights of the walk policy.
        flat: histories (B, 2100).
        mean: actions (B, 12) of `flat`.
        precision: of matrix products.
    """
    mirrored = mirror_history(flat)
    latent = jax.lax.stop_gradient(walk_policy.infer_latent(params, mirrored, precision=precision))
    other = walk_policy.infer_action(params, mirrored, latent, precision=precision)
    return jnp.mean(jnp.square(other - mirror_action(mean)))
