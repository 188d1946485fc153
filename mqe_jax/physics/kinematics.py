"""Poses of bodies from generalised coordinates, equal on all engines.

The engines' states hold no poses (`engines.STATE_FIELDS`); MuJoCo's C engine returns none and MJX's
are those before the last physics step.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mqe_jax.physics.rotation import compose, rotate, rotation

if TYPE_CHECKING:
    from mujoco import mjx

_JOINT = mujoco.mjtJoint


class Poses(NamedTuple):
    """Poses of B bodies in the environment frame."""

    position: jax.Array  # origins of the bodies' frames (B, 3), m
    quaternion: jax.Array  # orientations, wxyz (B, 4)


def poses(model: mujoco.MjModel, data: "mjx.Data", bodies: Sequence[int] | np.ndarray) -> Poses:
    """Returns the poses of bodies, given by their ids.

    Quaternions in `data.qpos` must be normalised.
    """
    found: dict[int, tuple[Any, Any]] = {0: (jnp.zeros(3), jnp.array([1.0, 0.0, 0.0, 0.0]))}

    def place(body: int) -> tuple[Any, Any]:
        if body not in found:
            found[body] = _place(model, data, body, *place(int(model.body_parentid[body])))
        return found[body]

    positions, quaternions = zip(*(place(int(body)) for body in bodies), strict=True)
    return Poses(jnp.stack(positions), jnp.stack(quaternions))


def _place(
    model: mujoco.MjModel, data: "mjx.Data", body: int, position: Any, quaternion: Any
) -> tuple[Any, Any]:
    """Returns the pose of a body in the pose of its parent."""
    number = int(model.body_mocapid[body])
    if number >= 0:
        return data.mocap_pos[number], data.mocap_quat[number]
    position = position + rotate(quaternion, _single(model.body_pos[body]))
    quaternion = compose(quaternion, _single(model.body_quat[body]))
    first = model.body_jntadr[body]
    for joint in range(first, first + model.body_jntnum[body]):
        address = int(model.jnt_qposadr[joint])
        kind = int(model.jnt_type[joint])
        if kind == _JOINT.mjJNT_FREE:
            return data.qpos[address : address + 3], data.qpos[address + 3 : address + 7]
        axis = _single(model.jnt_axis[joint])
        anchor = _single(model.jnt_pos[joint])
        moved = data.qpos[address] - _single(model.qpos0[address])
        if kind == _JOINT.mjJNT_SLIDE:
            position = position + rotate(quaternion, axis) * moved
            continue
        if kind == _JOINT.mjJNT_BALL:
            turn = data.qpos[address : address + 4]
        else:
            turn = rotation(axis, moved)
        turned = compose(quaternion, turn)
        if anchor.any():
            position = position + rotate(quaternion, anchor) - rotate(turned, anchor)
        quaternion = turned
    return position, quaternion


def _single(x: np.ndarray) -> np.ndarray:
    return np.asarray(x, np.float32)
