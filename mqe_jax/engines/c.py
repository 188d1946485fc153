"""MuJoCo's C engine, called from JAX: all environments of a batch in one call."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.batch import Batch

from mqe_jax.engines import private
from mqe_jax.engines.engine import Engine
from mqe_jax.robots.motors import CLAMP, Motors

if TYPE_CHECKING:
    from mujoco import mjx


class CEngine(Engine):
    """MuJoCo's C engine as a pure JAX function; no contact is ever dropped."""

    impl = "c"

    def __init__(self, model: mujoco.MjModel, **options: Any) -> None:
        super().__init__(model, **options)
        self._model = model.__copy__()
        # No silent reset: a diverged environment keeps its non-finite state, so that the task can terminate it.
        self._model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self._batches: dict[tuple[int, tuple[str, ...]], Batch] = {}
        self._rows: dict[int, Motors | None] = {}
        self._lock = threading.Lock()
        self._sizes = (model.nq, model.nv, model.nv, model.nsensordata)

    @classmethod
    def preferred(cls) -> bool:
        return jax.default_backend() == "cpu"

    @classmethod
    def obstacle(cls) -> str | None:
        platform = jax.default_backend()
        if platform == "cpu":
            return None
        return f"runs on a CPU but JAX runs on {platform}: set JAX_PLATFORMS=cpu, or choose impl 'warp' or 'jax'"

    def blank(self) -> mjx.Data:
        return private.without_pointers(private.load_mjx().make_data(self.model, impl="cpp"))

    def advance(
        self, data: mjx.Data, fields: Mapping[str, jax.Array], forced: bool, num_substeps: int
    ) -> tuple[mjx.Data, jax.Array]:
        names = tuple(sorted(fields))
        out = jax.ShapeDtypeStruct((sum(self._sizes),), jnp.float32)
        forces = (data.xfrc_applied,) if forced else ()
        mocap = (data.mocap_pos, data.mocap_quat) if self.model.nmocap else ()

        def call(qpos: Any, *rest: Any) -> np.ndarray:
            return self._call(names, forced, num_substeps, qpos, *rest)

        row = jax.pure_callback(
            call,
            out,
            data.qpos,
            data.qvel,
            data.qacc_warmstart,
            data.ctrl,
            *mocap,
            *forces,
            *(fields[name] for name in names),
            vmap_method="broadcast_all",
        )
        qpos, qvel, warmstart, sensordata = jnp.split(row, np.cumsum(self._sizes)[:-1])
        data = data.replace(
            qpos=qpos,
            qvel=qvel,
            qacc_warmstart=warmstart,
            sensordata=sensordata,
            time=data.time + num_substeps * self._model.opt.timestep,
        )
        return data, jnp.zeros((), bool)

    def _call(self, names: tuple[str, ...], forced: bool, substeps: int, *arrays: Any) -> np.ndarray:
        qpos, *rest = (np.asarray(array) for array in arrays)
        lead = qpos.shape[:-1]
        count = int(np.prod(lead)) if lead else 1
        flat = iter([array.reshape(count, *array.shape[len(lead) :]) for array in (qpos, *rest)])
        with self._lock:
            batch = self._batches.get((count, names))
            if batch is None:
                batch = self._batches[count, names] = Batch(self._model, nsim=count)
                self._rows[count] = None if self.motors is None else self.motors.repeated(count)
            for name in ("qpos", "qvel", "qacc_warmstart", "ctrl"):
                batch.bind(name)[:] = next(flat)
            if self._model.nmocap:
                batch.bind("mocap_pos")[:] = next(flat)
                batch.bind("mocap_quat")[:] = next(flat)
            batch.bind("xfrc_applied")[:] = next(flat) if forced else 0.0
            batch.bind("time")[:] = 0.0
            for name in names:
                batch.expand(name)[:] = next(flat)
            sensordata = batch.bind("sensordata")
            motors = self._rows[count]
            if motors is None:
                batch.step(nstep=substeps)
            else:
                self._drive(batch, motors, substeps, names)
            parts = [batch.bind("qpos"), batch.bind("qvel"), batch.bind("qacc_warmstart"), sensordata]
            row = np.concatenate(parts, axis=1).astype(np.float32)
        return row.reshape(*lead, -1)

    def _drive(self, batch: Batch, motors: Motors, substeps: int, names: tuple[str, ...]) -> None:
        """Steps a batch, with the motors' limits in every physics step; `motors` has a row per environment."""
        model = self._model
        gain = batch.expand("actuator_gainprm") if "actuator_gainprm" in names else model.actuator_gainprm
        bias = batch.expand("actuator_biasprm") if "actuator_biasprm" in names else model.actuator_biasprm
        gain, bias = gain[..., 0].astype(np.float32), _columns(bias[..., :3])
        qpos, qvel, ctrl = (batch.bind(name) for name in ("qpos", "qvel", "ctrl"))
        asked, armature = ctrl.astype(np.float32), batch.expand("dof_armature")
        angles, speeds = motors.joint_qpos, motors.joint_qvel
        base = armature[:, speeds].copy() if "dof_armature" in names else model.dof_armature[speeds]
        greatest = CLAMP * float(motors.speed.min())
        for _ in range(substeps):
            joints = qpos[:, angles].astype(np.float32), qvel[:, speeds].astype(np.float32)
            ctrl[:], added = motors.limit(np, asked, *joints, gain, bias)
            armature[:, speeds] = base + added if added.any() else base
            batch.step(nstep=1)
            velocity = qvel[:, speeds]
            if max(velocity.max(), -velocity.min()) > greatest and np.any(np.abs(velocity) > CLAMP * motors.speed):
                qpos[:, angles], qvel[:, speeds] = motors.clamp(np, qpos[:, angles], velocity)


def _columns(bias: np.ndarray) -> np.ndarray:
    """Returns coefficients (..., J, 3) in single precision, each column contiguous."""
    return np.moveaxis(np.ascontiguousarray(np.moveaxis(bias, -1, 0), np.float32), 0, -1)
