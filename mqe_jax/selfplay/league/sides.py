"""Matches whose teams change sides, so that the learner, always team 0, is trained from both."""

from typing import Any

import jax
import jax.numpy as jnp

from mqe_jax.core import devices
from mqe_jax.core.types import where_rows
from mqe_jax.envs.wrappers import Wrapper


class BothSides(Wrapper):
    """Matches; in the second half of them team 0 is the task's team 1.

    Outcomes and rewards are the new teams'.

    The privileged observation has one more number: 1 if the teams have changed places, else 0. It
    makes a difference even if a match is symmetric under a reflection: mirrored robots do not walk
    exactly alike.
    """

    def __init__(self, inner: Any) -> None:
        super().__init__(inner)
        self.privileged_observation_size += 1

    def pass_on(self, action: jax.Array) -> jax.Array:
        return self._swap(action)

    def view(self, inner: Any, reached: jax.Array) -> dict[str, Any]:
        changed = self._swaps()
        metrics = dict(inner.metrics)
        for theirs in [name for name in metrics if name.startswith("team1/")]:
            own = theirs.removeprefix("team1/")
            for name, other in ((own, theirs), (theirs, own)):
                metrics[name] = jnp.where(changed, inner.metrics[other], inner.metrics[name])

        def add_side(privileged: jax.Array) -> jax.Array:
            return jnp.concatenate([privileged, changed[:, None].astype(privileged.dtype)], axis=1)

        return {
            "privileged_obs": add_side(inner.privileged_obs),
            "final_privileged_obs": jax.tree.map(add_side, inner.final_privileged_obs),
            "reward": self._swap(inner.reward),
            "active": jax.tree.map(self._swap, inner.active),
            "used": jax.tree.map(self._swap, inner.used),
            "groups": jax.tree.map(self._swap, inner.groups),
            "final_groups": jax.tree.map(self._swap, inner.final_groups),
            "outcome": inner.outcome.by_team(lambda x: jnp.where(changed[:, None], x[:, ::-1], x)),
            "metrics": metrics,
        }

    def _swaps(self) -> jax.Array:
        """Returns where the teams have changed places (N,) bool."""
        return devices.rows(lambda n: jnp.arange(n) >= n // 2, self.num_envs)

    def _swap(self, x: jax.Array) -> jax.Array:
        """Exchanges the teams along axis 1 of (N, A, ...) where they have changed places."""
        other = jnp.roll(x, self.num_agents // 2, axis=1)
        return where_rows(self._swaps(), other, x)
