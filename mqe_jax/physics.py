"""Physics: one `step` for three engines; the state is always an `mjx.Data`.

| impl | engine | hardware |
|---|---|---|
| `jax` | MJX, JAX implementation | CPU, GPU, TPU |
| `warp` | MJX, Warp implementation | NVIDIA GPU (CPU for tests) |
| `c` | MuJoCo's own C engine on all cores, called through `jax.pure_callback` | CPU |

The functions are written for one environment and batched by `jax.vmap`. Model parameters that differ between
environments (friction, masses, motor strength) are passed to `Physics.step` as arrays named after `mjModel` fields.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import io
from collections.abc import Mapping
from types import ModuleType
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mqe_jax.errors import InputError, nearest
from mqe_jax.robots.motors import Motors

if TYPE_CHECKING:
    from mujoco import mjx

IMPLS = ("auto", "jax", "warp", "c")

# Fields of `mjx.Data` that carry the state; all others are recomputed from them in every step.
STATE_FIELDS = (
    "qpos",
    "qvel",
    "qacc_warmstart",
    "ctrl",
    "mocap_pos",
    "mocap_quat",
    "xfrc_applied",
    "time",
    "sensordata",
)


def resolve_impl(impl: str = "auto") -> str:
    """Resolves `auto`: warp with an NVIDIA GPU and warp-lang, c on a CPU, else jax.

    Raises:
        InputError: for an unknown engine, or one that this machine cannot run; names what is missing.
    """
    if impl not in IMPLS:
        raise InputError(f"impl: unknown engine {impl!r}{nearest(impl, IMPLS)}; allowed: {', '.join(IMPLS)}")
    platform = jax.default_backend()
    if impl == "auto":
        if platform == "gpu" and _has_warp() and _has_cuda():
            return "warp"
        return "c" if platform == "cpu" else "jax"
    if impl == "warp" and not _has_warp():
        raise InputError(
            "impl 'warp' needs the package warp-lang: pip install 'mqe-jax[warp]', or choose impl 'c' or 'jax'"
        )
    if impl == "c" and platform != "cpu":
        raise InputError(
            f"impl 'c' runs on a CPU but JAX runs on {platform}: set JAX_PLATFORMS=cpu, or choose impl 'warp' or 'jax'"
        )
    return impl


def load_mjx() -> ModuleType:
    """Imports MJX, without the lines that it prints where Warp, which only an NVIDIA GPU needs, is not installed."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        from mujoco import mjx
    for line in printed.getvalue().splitlines():
        if not line.endswith("No module named 'warp'"):
            print(line)
    return mjx


def _has_warp() -> bool:
    load_mjx()
    from mujoco.mjx import warp as mjx_warp

    return bool(mjx_warp.WARP_INSTALLED)


def _has_cuda() -> bool:
    return any(
        "cuda" in device.device_kind.lower() or "nvidia" in device.device_kind.lower() for device in jax.devices()
    )


class Physics:
    """Steps one environment of a compiled model on one engine; batch with `jax.vmap`."""

    model: mujoco.MjModel
    """Compiled model."""
    motors: Motors | None
    """Motors that drive its actuators; without them the actuators have no speed limit."""
    impl: str
    """Engine: 'jax', 'warp' or 'c'."""
    num_substeps: int
    """Physics steps per call of `step`."""
    num_envs: int
    """Environments for which Warp's contact buffer is sized."""
    contacts_per_env: int
    """Contacts per environment for which that buffer is sized, on average over environments."""
    max_constraints_per_env: int
    """Maximum constraints of each environment on Warp (njmax)."""

    def __init__(
        self,
        model: mujoco.MjModel,
        *,
        motors: Motors | None = None,
        impl: str = "auto",
        num_substeps: int = 4,
        num_envs: int = 4096,
        contacts_per_env: int = 32,
        max_constraints_per_env: int = 160,
    ) -> None:
        self.model = model
        self.motors = motors
        self.impl = resolve_impl(impl)
        self.num_substeps = num_substeps
        self.num_envs = num_envs
        self.contacts_per_env = contacts_per_env
        self.max_constraints_per_env = max_constraints_per_env
        if self.impl == "c":
            from mqe_jax.c_engine import CEngine

            self._engine = CEngine(model, motors)
            return
        mjx = load_mjx()
        if self.impl == "warp":
            self._mjx_step, self._mjx_model = mjx.step, _quiet(mjx.put_model(model, impl="warp"))
            self._template = mjx.make_data(
                model, impl="warp", naconmax=num_envs * contacts_per_env, njmax=max_constraints_per_env
            )
        else:
            from mqe_jax.mjx_step import MarginStep

            self._mjx_step = MarginStep(model)
            self._mjx_model = self._mjx_step.model
            self._template = mjx.make_data(model, impl="jax")

    @functools.cached_property
    def _template(self) -> mjx.Data:
        """Template of the C engine, created on first use: importing MJX takes a second, which `mqe tasks` avoids."""
        mjx = load_mjx()
        with jax.ensure_compile_time_eval():
            return _without_pointers(mjx.make_data(self.model, impl="cpp"))

    def init(self, qpos: jax.Array, qvel: jax.Array, mocap_pos: jax.Array, ctrl: jax.Array) -> mjx.Data:
        """Returns the initial state of one environment, without a forward pass.

        Args:
            qpos: (nq,).
            qvel: (nv,).
            mocap_pos: positions of the mocap bodies (nmocap, 3), m.
            ctrl: (nu,).
        """
        as_float = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
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

    def step(
        self,
        data: mjx.Data,
        ctrl: jax.Array,
        *,
        fields: Mapping[str, jax.Array] | None = None,
        xfrc_applied: jax.Array | None = None,
        num_substeps: int | None = None,
    ) -> mjx.Data:
        """Advances one environment by `num_substeps` physics steps under a constant control.

        Args:
            data: state of the environment.
            ctrl: (nu,), joint targets (rad) or torques (N m).
            fields: model fields that this environment overrides, by their `mjModel` names.
            xfrc_applied: external forces and torques on the bodies (nbody, 6), N and N m, world frame.
            num_substeps: physics steps; `self.num_substeps` if None.
        """
        options: Any = {"fields": fields, "xfrc_applied": xfrc_applied, "num_substeps": num_substeps}
        return self.step_with_overflow(data, ctrl, **options)[0]

    def step_with_overflow(
        self,
        data: mjx.Data,
        ctrl: jax.Array,
        *,
        fields: Mapping[str, jax.Array] | None = None,
        xfrc_applied: jax.Array | None = None,
        num_substeps: int | None = None,
    ) -> tuple[mjx.Data, jax.Array]:
        """As `step`; also returns whether contacts or constraints may have been dropped in any physics step () bool.

        Warp: from the engine's flags; MJX-JAX: true if the capped contact list is full; C: never, it has no cap.
        """
        substeps = self.num_substeps if num_substeps is None else num_substeps
        data = data.replace(ctrl=ctrl.astype(jnp.float32))
        if xfrc_applied is not None:
            data = data.replace(xfrc_applied=xfrc_applied.astype(jnp.float32))
        if self.impl == "c":
            return self._engine.step(data, dict(fields or {}), xfrc_applied is not None, substeps), jnp.zeros((), bool)

        model = self._mjx_model.replace(**fields) if fields else self._mjx_model

        def substep(carry: tuple[mjx.Data, jax.Array], _: None) -> tuple[tuple[mjx.Data, jax.Array], None]:
            data = self._mjx_step(*self._driven(model, self._clamped(carry[0]), ctrl))
            return (data, carry[1] | self._full(data)), None

        start = (self._without_flags(data), jnp.zeros((), bool))
        data, full = jax.lax.scan(substep, start, None, substeps)[0]
        data = self._clamped(data.replace(ctrl=ctrl.astype(jnp.float32)))
        return data, full | self._flagged(data)

    def _driven(self, model: mjx.Model, data: mjx.Data, ctrl: jax.Array) -> tuple[mjx.Model, mjx.Data]:
        """Returns model and data with the armature and the control of the motors for one physics step."""
        motors = self.motors
        if motors is None:
            return model, data
        position, velocity = data.qpos[motors.joint_qpos], data.qvel[motors.joint_qvel]
        gain, bias = model.actuator_gainprm[:, 0], model.actuator_biasprm[:, :3]
        ctrl, armature = motors.limit(jnp, ctrl.astype(jnp.float32), position, velocity, gain, bias)
        added = _spread(armature, motors.joint_qvel, self.model.nv)
        return model.replace(dof_armature=model.dof_armature + added), data.replace(ctrl=ctrl)

    def _clamped(self, data: mjx.Data) -> mjx.Data:
        """Returns data with the joint speeds that motors and contacts allow."""
        motors = self.motors
        if motors is None:
            return data
        old = data.qpos[motors.joint_qpos], data.qvel[motors.joint_qvel]
        position, velocity = motors.clamp(jnp, *old)
        return data.replace(
            qpos=data.qpos + _spread(position - old[0], motors.joint_qpos, self.model.nq),
            qvel=data.qvel + _spread(velocity - old[1], motors.joint_qvel, self.model.nv),
        )

    def merge(self, choose: jax.Array, first: mjx.Data, second: mjx.Data) -> mjx.Data:
        """Returns `first` where `choose` () is true, else `second`; copies only the state fields."""
        merged = {name: jnp.where(choose, getattr(first, name), getattr(second, name)) for name in STATE_FIELDS}
        return second.replace(**merged)

    def _without_flags(self, data: mjx.Data) -> mjx.Data:
        """Clears Warp's overflow flags, which the engine sets but never clears."""
        if self.impl != "warp":
            return data
        return data.replace(_impl=dataclasses.replace(data._impl, overflow=jnp.zeros_like(data._impl.overflow)))

    def _flagged(self, data: mjx.Data) -> jax.Array:
        """Returns whether Warp dropped contacts or constraints since its flags were cleared () bool."""
        if self.impl != "warp":
            return jnp.zeros((), bool)
        return jnp.any((data._impl.overflow & ~_ITERATIONS) != 0)

    def _full(self, data: mjx.Data) -> jax.Array:
        """Returns whether MJX-JAX's contact list was full in the last physics step () bool."""
        if self.impl == "jax" and len(data._impl.contact.dist) == _contact_cap(self.model):
            return jnp.all(data._impl.contact.dist < data._impl.contact.includemargin)
        return jnp.zeros((), bool)


def _spread(values: jax.Array, addresses: np.ndarray, size: int) -> jax.Array:
    """Returns an array (size,) with the values (J,) at their addresses and zeros elsewhere, by a gather."""
    source = np.full(size, len(addresses))
    source[addresses] = np.arange(len(addresses))
    return jnp.concatenate([values, jnp.zeros(1)])[source]


def _contact_cap(model: mujoco.MjModel) -> int:
    """Returns the maximum number of contacts that MJX-JAX keeps, -1 without a cap."""
    names = [model.numeric(i).name for i in range(model.nnumeric)]
    return int(model.numeric("max_contact_points").data[0]) if "max_contact_points" in names else -1


# Warp's flags for a solver at its iteration limit: expected with few iterations, and not an overflow.
_ITERATIONS = 1 << 9 | 1 << 10


def _quiet(model: mjx.Model) -> mjx.Model:
    """Disables Warp's printed warnings; `Physics.step_with_overflow` reports overflows."""
    return model.replace(opt=model.opt.replace(_impl=model.opt._impl.replace(warn_overflow=0)))


def _without_pointers(data: mjx.Data) -> mjx.Data:
    """Zeroes MJX's memory addresses in this kind of data: they are invalid in another process."""
    zeros = {name: jnp.zeros_like(getattr(data._impl, name)) for name in ("pointer_lo", "pointer_hi")}
    return data.replace(_impl=dataclasses.replace(data._impl, **zeros))
