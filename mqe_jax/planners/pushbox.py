"""Push Box by hand: both robots walk behind the box and push it side by side, turning it straight on the way."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mqe_jax.planners.steering import go_to

_BEHIND = 0.95  # m, from the box's centre to a robot that is about to push
_APART = 0.3  # m, from the line through the box along which it shall move, to each robot


def plan_pushbox(obs: jax.Array) -> jax.Array:
    """Returns both robots' actions (2, 3) from their observations (2, 22)."""
    position, yaw, gate, box = obs[:, 2:4], obs[:, 7], obs[0, 14:16], obs[0, 16:18]
    w, x, y, z = obs[0, 18:]
    turned = jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    turned = (turned + jnp.pi / 4) % (jnp.pi / 2) - jnp.pi / 4  # a box looks the same after a quarter turn
    side = jnp.array([-1.0, 1.0])
    # Where the box is too far to one side, the robots stand and push further to that side.
    aside = jnp.clip(gate[1] - box[1], -0.5, 0.5)
    along = jnp.array([jnp.cos(turned), jnp.sin(turned)])
    across = jnp.array([-jnp.sin(turned), jnp.cos(turned)])
    place = box - _BEHIND * along + (side * _APART)[:, None] * across
    apart = position - box
    behind = apart @ along < -0.55
    lined_up = behind & (jnp.abs(apart @ across - side * _APART) < 0.15)
    both = jnp.all(lined_up)
    # The robot on the side to which the box shall turn pushes less.
    wish = jnp.clip(1.2 * aside, -0.35, 0.35)
    lead = jnp.clip(2.0 * (wish - turned), -0.4, 0.4) * -side
    walk = go_to(position, yaw, place, turned)
    push = walk.at[:, 0].set(jnp.clip(0.4 + 0.5 * lead, 0.1, 0.5))
    return jnp.where(both, push, walk)
