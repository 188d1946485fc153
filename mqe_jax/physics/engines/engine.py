"""The protocol of physics engines.

The functions are written for one environment and batched by `jax.vmap`. Model parameters that
differ between environments (friction, masses, motor strength) are passed to `Engine.step` as arrays
named after `mjModel` fields.
"""

from __future__ import annotations

import abc
import dataclasses
import functools
from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar

import jax
import jax.numpy as jnp
import mujoco

from mqe_jax.core import threefry  # noqa: F401  (for programs on a CPU)
from mqe_jax.physics.engines.host_call import finish_at_exit
from mqe_jax.physics.robots.motors import Motors

if TYPE_CHECKING:
    from mujoco import mjx

STATE_FIELDS = tuple(
    "qpos qvel qacc_warmstart ctrl mocap_pos mocap_quat xfrc_applied time sensordata".split()
)
"""Fields of `mjx.Data` that carry the state; all others are recomputed from them in every step."""


@dataclasses.dataclass(eq=False)
class Engine(abc.ABC):
    """Steps one environment of a compiled model; batch with `jax.vmap`.

    An engine defines `impl`, `blank` and `advance`, and where it cannot always run, `preferred` and
    `obstacle`.
    """

    impl: ClassVar[str]  # name of the engine in the registry
    model: mujoco.MjModel  # compiled model
    _: dataclasses.KW_ONLY
    motors: Motors | None = None
    """Motors that drive the actuators; without them the actuators have no speed limit."""
    num_substeps: int = 4  # physics steps per call of `step`
    num_envs: int = 4096  # environments for which buffers are sized that environments share
    contacts_per_env: int = 32
    """Contacts per environment for which such buffers are sized, on average over environments."""
    max_constraints_per_env: int = 160
    """Maximum constraints of each environment, for engines with such a limit (Warp's njmax)."""
    sparse_solver: bool | None = None
    """Whether the solver skips the zeros between robots that do not touch, on Warp (`newton.py`);
    None: if it pays."""

    @classmethod
    def is_preferred(cls) -> bool:
        """Returns whether `auto` chooses this engine here, unless it chooses an earlier one.

        Engines are asked in the order of the registry.
        """
        return False

    @classmethod
    def obstacle(cls) -> str | None:
        """Returns why this machine cannot run the engine, or None.

        The text ends a line that begins with "impl 'NAME'".
        """
        return None

    def holds(self, num_envs: int) -> bool:
        """Returns whether the engine can step `num_envs` environments at once."""
        return True

    def own_bytes(self, num_envs: int) -> int:
        """Returns the bytes of device memory that the engine needs beside the state."""
        return 0

    @abc.abstractmethod
    def blank(self) -> mjx.Data:
        """Returns data of one environment with all arrays of the engine; `init` sets the state."""

    @abc.abstractmethod
    def advance(
        self, data: mjx.Data, fields: Mapping[str, jax.Array], forced: bool, num_substeps: int
    ) -> tuple[mjx.Data, jax.Array]:
        """Advances one environment by physics steps under the control `data.ctrl`, which stays.

        `fields` are as of `step`, whose overflow flag it also returns; `forced` says whether
        `data.xfrc_applied` may differ from zero.
        """

    def init(
        self, qpos: jax.Array, qvel: jax.Array, mocap_pos: jax.Array, ctrl: jax.Array
    ) -> mjx.Data:
        """Returns the initial state of one environment, without a forward pass.

        `mocap_pos` is (nmocap, 3), m.
        """

        def as_float(x):
            return jnp.asarray(x, jnp.float32)

        return self._template.replace(
            qpos=as_float(qpos),
            qvel=as_float(qvel),
            mocap_pos=as_float(mocap_pos),
            ctrl=as_float(ctrl),
            qacc_warmstart=jnp.zeros(self.model.nv),
            xfrc_applied=jnp.zeros((self.model.nbody, 6)),
            sensordata=jnp.zeros(self.model.nsensordata),
            time=jnp.zeros(()),
        )

    @jax.named_scope("physics")
    def step(
        self,
        data: mjx.Data,
        ctrl: jax.Array,
        *,
        fields: Mapping[str, jax.Array] | None = None,
        xfrc_applied: jax.Array | None = None,
        num_substeps: int | None = None,
    ) -> tuple[mjx.Data, jax.Array]:
        """Advances one environment by physics steps under a constant control (nu,).

        The control is joint targets, rad, or torques, N m.

        `fields` are the model fields that this environment overrides, by their `mjModel` names,
        `xfrc_applied` external forces and torques on the bodies (nbody, 6), N and N m, world frame.
        Returns the state, and whether contacts or constraints may have been dropped in any physics
        step () bool.
        """
        data = data.replace(ctrl=ctrl.astype(jnp.float32))
        if xfrc_applied is not None:
            data = data.replace(xfrc_applied=xfrc_applied.astype(jnp.float32))
        substeps = self.num_substeps if num_substeps is None else num_substeps
        with jax.numpy_dtype_promotion("standard"):  # MJX mixes dtypes
            return self.advance(data, dict(fields or {}), xfrc_applied is not None, substeps)

    def merge(self, choose: jax.Array, first: mjx.Data, second: mjx.Data) -> mjx.Data:
        """Returns `first` where `choose` () is true, else `second`; copies only state fields."""
        merged = {
            name: jnp.where(choose, getattr(first, name), getattr(second, name))
            for name in STATE_FIELDS
        }
        return second.replace(**merged)

    @functools.cached_property
    def _template(self) -> mjx.Data:
        """Template of `init`.

        It is created on first use: importing MJX takes a second, which `mqe tasks` avoids.
        """
        finish_at_exit()
        with jax.ensure_compile_time_eval(), jax.numpy_dtype_promotion("standard"):
            return self.blank()
