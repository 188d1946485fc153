"""MJX's JAX implementation, with the contacts of the C engine (`mjx_step.py`)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import mujoco

from mqe_jax.engines import private
from mqe_jax.engines.mjx import MjxEngine

if TYPE_CHECKING:
    from mujoco import mjx


class JaxEngine(MjxEngine):
    """MJX-JAX on CPU, GPU or TPU."""

    impl = "jax"

    def __init__(self, model: mujoco.MjModel, **options: Any) -> None:
        super().__init__(model, **options)
        private.load_mjx()
        from mqe_jax.engines.mjx_step import MarginStep

        self._step = MarginStep(model)
        self.mjx_model = self._step.model

    @classmethod
    def preferred(cls) -> bool:
        return True

    def blank(self) -> mjx.Data:
        return private.load_mjx().make_data(self.model, impl="jax")

    def physics_step(self, model: mjx.Model, data: mjx.Data) -> tuple[mjx.Data, jax.Array]:
        """Advances by one physics step; contacts may have been dropped if the capped contact list is full."""
        data = self._step(model, data)
        contact = private.contact(data)
        if len(contact.dist) == self._step.max_contacts:
            return data, jnp.all(contact.dist < contact.includemargin)
        return data, jnp.zeros((), bool)
