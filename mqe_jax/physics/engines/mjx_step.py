"""MJX-JAX's physics step with the contacts of MuJoCo's C engine.

MJX-JAX detects no contact with a box before the surfaces meet, whatever the margin. Here collisions
are computed on spheres and capsules inflated by their margins; distances and positions are then
those of the original surfaces. Between a plane and a box MJX-JAX keeps only corners within 1 mm of
the deepest one; here all four lower corners count. It also misses or misplaces contacts between a
capsule and an edge of a box, which are corrected for moving boxes.
"""

import copy
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from mqe_jax.physics.engines import private

_BEFORE_COLLISION = (
    mjx.kinematics,
    mjx.com_pos,
    mjx.camlight,
    mjx.tendon,
    mjx.crb,
    mjx.tendon_armature,
    mjx.factor_m,
)
_CORNERS = np.array([(1, 1, 1), (1, 1, -1), (1, -1, 1), (1, -1, -1)], np.float32)
"""One of each opposite pair of a box's corners, in half extents."""
_ROUND = (int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_CAPSULE))


class MarginStep:
    """`mjx.step` of a model for MJX's JAX implementation (Euler integration)."""

    def __init__(self, model: mujoco.MjModel) -> None:
        inflation = np.where(np.isin(model.geom_type, _ROUND), model.geom_margin, 0.0)
        without_margins = copy.copy(model)  # `_collision` sets them
        without_margins.geom_margin[:] = 0.0
        without_margins.geom_rbound[:] += inflation
        self.model = mjx.put_model(without_margins, jax.local_devices()[0], impl="jax")
        self.max_contacts = -1  # of each dimension; -1: any number
        if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, "max_contact_points") >= 0:
            self.max_contacts = int(model.numeric("max_contact_points").data[0])
        self._inflation = inflation.astype(np.float32)
        self._size = model.geom_size.astype(np.float32)
        self._size[:, 0] += self._inflation
        self._margin = model.geom_margin.astype(np.float32) - self._inflation

    def __call__(self, model: mjx.Model, data: mjx.Data) -> mjx.Data:
        """Advances one environment by one physics step.

        `model` is `self.model`, possibly with other field values.
        """
        data = self._forward_position(model, data)
        data = mjx.sensor_pos(model, data)
        data = mjx.fwd_velocity(model, data)
        data = mjx.sensor_vel(model, data)
        data = mjx.fwd_actuation(model, data)
        data = mjx.fwd_acceleration(model, data)
        if private.is_constrained(data):
            data = mjx.sensor_acc(model, mjx.solve(model, data))
        else:
            data = data.replace(qacc=data.qacc_smooth)
        return mjx.euler(model, data)

    def _forward_position(self, model: mjx.Model, data: mjx.Data) -> mjx.Data:
        for compute in _BEFORE_COLLISION:
            data = compute(model, data)
        data = self._collision(model, data)
        return mjx.transmission(model, mjx.make_constraint(model, data))

    def _collision(self, model: mjx.Model, data: mjx.Data) -> mjx.Data:
        inflated = model.replace(
            geom_size=jnp.asarray(self._size), geom_margin=jnp.asarray(self._margin)
        )
        if not private.contact(data).dist.size:
            return data
        contact = _contacts(inflated, data, self.max_contacts)
        first, second = jnp.asarray(self._inflation)[jnp.asarray(contact.geom)].T
        normal = contact.frame[:, 0]  # from the first geom to the second
        contact = contact.replace(
            dist=contact.dist + first + second,
            pos=contact.pos - 0.5 * (first - second)[:, None] * normal,
            includemargin=contact.includemargin + first + second,
        )
        return private.with_contact(data, contact)


def _contacts(model: mjx.Model, data: mjx.Data, cap: int) -> mjx.Contact:
    """Contacts by dimension, of each the deepest `cap`.

    As `mjx.collision`, with `_plane_box`, and with `_capsule_box` for boxes that move: for all
    walls it would cost 7% of a physics step in Narrow Gate.
    """
    by_dimension: dict[int, list[Any]] = {}
    moves = model.body_weldid[model.geom_bodyid] != 0
    for pairs in private.geom_pairs(model, data):
        geom = pairs.contact.geom
        if pairs.types == (mjx.GeomType.PLANE, mjx.GeomType.BOX):
            dist, pos, frame = _plane_box(model, data, geom)
        else:
            dist, pos, frame = pairs.collide(model, data)
            rows = np.flatnonzero(moves[pairs.geoms[:, 1]])
            if pairs.types == (mjx.GeomType.CAPSULE, mjx.GeomType.BOX) and len(rows):
                both = np.stack([2 * rows, 2 * rows + 1], axis=1).ravel()
                nearest = _capsule_box(model, data, geom[rows])
                own_dist, own_pos, own_frame = _correct(
                    dist[both], pos[both], frame[both], *nearest
                )
                dist = dist.at[both].set(own_dist)
                pos = pos.at[both].set(own_pos)
                frame = frame.at[both].set(own_frame)
        count = len(dist) // len(geom)
        contact = jax.tree.map(lambda x, count=count: jnp.repeat(x, count, axis=0), pairs.contact)
        contact = contact.replace(dist=dist, pos=pos, frame=frame)
        by_dimension.setdefault(pairs.condim, []).append(contact)
    kept = []
    for _, parts in sorted(by_dimension.items()):
        contact = jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
        if 0 <= cap < len(contact.dist):
            deepest = jax.lax.top_k(-contact.dist, cap)[1]
            contact = jax.tree.map(lambda x, rows=deepest: x[rows], contact)
        kept.append(contact)
    return jax.tree.map(lambda *x: jnp.concatenate(x), *kept)


def _plane_box(
    model: mjx.Model, data: mjx.Data, geom: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Returns the contacts of the four lower corners of N boxes with planes.

    They are distances (4 N,), m, positions (4 N, 3), m, and frames (4 N, 3, 3).
    """
    plane, box = geom.T
    normal = data.geom_xmat[plane][:, None, :, 2]
    own = _CORNERS * model.geom_size[box][:, None]  # in the box's frame
    corners = jnp.sum(own[..., None, :] * data.geom_xmat[box][:, None], axis=-1)
    corners = jnp.where(jnp.sum(corners * normal, axis=-1, keepdims=True) > 0.0, -corners, corners)
    corners = corners + data.geom_xpos[box][:, None]
    dist = jnp.sum((corners - data.geom_xpos[plane][:, None]) * normal, axis=-1, keepdims=True)
    pos = corners - 0.5 * dist * normal
    frame = private.make_frames(normal[:, 0])
    return dist.ravel(), pos.reshape(-1, 3), jnp.repeat(frame, 4, axis=0)


def _capsule_box(
    model: mjx.Model, data: mjx.Data, geom: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Returns the contacts of N capsules with boxes, where they are nearest.

    They are distances (N,), m, positions (N, 3), m, and normals (N, 3).

    The squared distance to the box is a convex, piecewise quadratic function of the position t in
    [-1, 1] on the capsule's axis. Its minimum is between the two breakpoints of its derivative at
    which the sign changes.
    """
    capsule, box = geom.T
    turn = data.geom_xmat[box]
    half = model.geom_size[box]
    radius = model.geom_size[capsule][:, :1]
    length = model.geom_size[capsule][:, 1:2]
    # middle and half of the capsule's axis, in the box's frame
    center = jnp.sum(turn * (data.geom_xpos[capsule] - data.geom_xpos[box])[..., None], axis=1)
    axis = jnp.sum(turn * data.geom_xmat[capsule][:, :, 2][..., None], axis=1) * length

    def outside(t: jax.Array) -> jax.Array:
        """From the nearest point of the box to the point t (N, T) of the axis: (N, T, 3)."""
        point = center[:, None] + t[..., None] * axis[:, None]
        return point - jnp.clip(point, -half[:, None], half[:, None])

    slow = jnp.where(jnp.abs(axis) < 1e-9, 1e-9, axis)
    faces = jnp.concatenate([(half - center) / slow, (-half - center) / slow], axis=1)
    ends = jnp.broadcast_to(jnp.array([-1.0, 1.0]), (len(geom), 2))
    t = jnp.concatenate([ends, jnp.clip(faces, -1.0, 1.0)], axis=1)
    slope = jnp.sum(outside(t) * axis[:, None], axis=-1)
    low = jnp.max(jnp.where(slope <= 0.0, t, -1.0), axis=1, keepdims=True)
    high = jnp.min(jnp.where(slope >= 0.0, t, 1.0), axis=1, keepdims=True)
    slope_low = jnp.sum(outside(low) * axis[:, None], axis=-1)
    slope_high = jnp.sum(outside(high) * axis[:, None], axis=-1)
    rise = slope_high - slope_low
    part = jnp.clip(-slope_low / jnp.where(rise > 0.0, rise, 1.0), 0.0, 1.0)
    way = jnp.where(rise > 0.0, part, 0.0)
    t = low + way * (high - low)
    gap = outside(t)[:, 0]
    size = jnp.linalg.norm(gap, axis=-1, keepdims=True)
    normal = -gap / jnp.maximum(size, 1e-9)
    point = center + t * axis + 0.5 * (radius + size) * normal

    def to_world(x):
        return jnp.sum(turn * x[:, None], axis=-1)

    dist = jnp.where(size > 1e-6, size - radius, -jnp.inf)[:, 0]
    return dist, data.geom_xpos[box] + to_world(point), to_world(normal)


def _correct(
    dist: jax.Array,
    pos: jax.Array,
    frame: jax.Array,
    true_dist: jax.Array,
    true_pos: jax.Array,
    normal: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Returns MJX-JAX's contacts of capsules with boxes, corrected.

    Both of a pair are replaced if the deeper one is not at the true distance.

    They are kept where the capsule's axis enters the box (`true_dist` -inf).
    """
    count = len(true_dist)
    found = jnp.min(dist.reshape(count, 2), axis=1)
    wrong = jnp.abs(found - true_dist) > 1e-5
    wrong &= jnp.minimum(found, true_dist) < 0.0
    wrong &= jnp.isfinite(true_dist)
    none = jnp.ones(count)
    dist = jnp.where(wrong[:, None], jnp.stack([true_dist, none], axis=1), dist.reshape(count, 2))
    pos = jnp.where(wrong[:, None, None], true_pos[:, None], pos.reshape(count, 2, 3))
    frames = private.make_frames(normal)
    frame = jnp.where(wrong[:, None, None, None], frames[:, None], frame.reshape(count, 2, 3, 3))
    return dist.ravel(), pos.reshape(-1, 3), frame.reshape(-1, 3, 3)
