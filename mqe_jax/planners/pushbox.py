"""Scripted policy of Push Box: both robots push the box side by side and correct its heading."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mqe_jax.planners.steering import Observation, go_to, pose

_BEHIND = 0.95  # m, from the box's centre to a robot before it pushes
_APART = 0.3  # m, lateral distance of each robot from the line of motion through the box
_LOOKAHEAD = 0.4  # m, of travel along the box's heading over which its lateral error is predicted; damps the steering


def plan_pushbox(obs: Observation) -> jax.Array:
    """Returns both robots' actions (2, 3)."""
    (position, yaw), gate, box = pose(obs["base"]), obs["gate"][0], obs["box"][0]
    w, x, y, z = obs["box_quaternion"][0]
    turned = jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    turned = (turned + jnp.pi / 4) % (jnp.pi / 2) - jnp.pi / 4  # the box is symmetric under quarter turns
    side = jnp.array([-1.0, 1.0])
    # Predicted lateral offset of the gate's centre from the box.
    offset = jnp.clip(gate[1] - box[1] - _LOOKAHEAD * jnp.sin(turned), -0.5, 0.5)
    along = jnp.array([jnp.cos(turned), jnp.sin(turned)])
    across = jnp.array([-jnp.sin(turned), jnp.cos(turned)])
    place = box - _BEHIND * along + (side * _APART)[:, None] * across
    apart = position - box
    behind = apart @ along < -0.55
    lined_up = behind & (jnp.abs(apart @ across - side * _APART) < 0.15)
    both = jnp.all(lined_up)
    # The robot on the side to which the box should turn pushes less.
    heading = jnp.clip(1.2 * offset, -0.35, 0.35)
    lead = jnp.clip(4.0 * (heading - turned), -0.7, 0.7) * -side
    walk = go_to(position, yaw, place, turned)
    push = walk.at[:, 0].set(jnp.clip(0.4 + 0.5 * lead, 0.1, 0.5))
    return jnp.where(both, push, walk)
