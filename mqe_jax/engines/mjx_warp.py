"""MJX's Warp implementation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import mujoco

from mqe_jax.engines import private
from mqe_jax.engines.mjx import MjxEngine

if TYPE_CHECKING:
    from mujoco import mjx


class WarpEngine(MjxEngine):
    """MJX-Warp on an NVIDIA GPU; environments share a contact buffer of fixed size."""

    impl = "warp"

    def __init__(self, model: mujoco.MjModel, **options: Any) -> None:
        super().__init__(model, **options)
        self._mjx = private.load_mjx()
        self.mjx_model = private.without_warnings(self._mjx.put_model(model, impl="warp"))

    @classmethod
    def preferred(cls) -> bool:
        kinds = [device.device_kind.lower() for device in jax.devices()]
        nvidia = any("cuda" in kind or "nvidia" in kind for kind in kinds)
        return jax.default_backend() == "gpu" and nvidia and private.warp_is_installed()

    @classmethod
    def obstacle(cls) -> str | None:
        if private.warp_is_installed():
            return None
        return "needs the package warp-lang: pip install 'mqe-jax[warp]', or choose impl 'c' or 'jax'"

    def holds(self, num_envs: int) -> bool:
        return num_envs <= self.num_envs

    def blank(self) -> mjx.Data:
        naconmax = self.num_envs * self.contacts_per_env
        return self._mjx.make_data(self.model, impl="warp", naconmax=naconmax, njmax=self.max_constraints_per_env)

    def advance(
        self, data: mjx.Data, fields: Mapping[str, jax.Array], forced: bool, num_substeps: int
    ) -> tuple[mjx.Data, jax.Array]:
        """Advances by physics steps; the overflow flag is Warp's own, which it sets but never clears."""
        data, _ = super().advance(private.without_overflow(data), fields, forced, num_substeps)
        return data, private.overflow(data)

    def physics_step(self, model: mjx.Model, data: mjx.Data) -> tuple[mjx.Data, jax.Array]:
        return self._mjx.step(model, data), jnp.zeros((), bool)
