"""MuJoCo's C engine, called from JAX: all environments of a batch in one call."""

import dataclasses
import functools
import hashlib
import threading
import weakref
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.batch import Batch

from mqe_jax.core.devices import cores
from mqe_jax.physics.engines import private
from mqe_jax.physics.engines.engine import Engine
from mqe_jax.physics.engines.host_call import host_call
from mqe_jax.physics.robots.motors import CLAMP, Motors

if TYPE_CHECKING:
    from mujoco import mjx

_Rows = tuple[Motors, np.ndarray, np.ndarray]
SHARE = 0.5  # share of idle environments above which steps without limits are worth trying


class CEngine(Engine):
    """MuJoCo's C engine as a pure JAX function; no contact is ever dropped."""

    impl = "c"

    def __init__(self, model: mujoco.MjModel, **options: Any) -> None:
        super().__init__(model, **options)
        own = model.__copy__()
        # No silent reset: the task terminates environments whose state is not finite.
        own.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        content = np.zeros(mujoco.mj_sizeModel(own), np.uint8)
        mujoco.mj_saveModel(own, None, content)
        self._content = content.tobytes()
        self._sizes = (model.nq, model.nv, model.nv, model.nsensordata)
        self._stepper = _Stepper(own, self.motors)
        weakref.finalize(self, self._stepper.retire).atexit = False

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        weakref.finalize(self, self._stepper.retire).atexit = False

    @classmethod
    def is_preferred(cls) -> bool:
        return jax.default_backend() == "cpu"

    @classmethod
    def obstacle(cls) -> str | None:
        platform = jax.default_backend()
        if platform == "cpu":
            return None
        return (
            f"runs on a CPU but JAX runs on {platform}: set JAX_PLATFORMS=cpu, or choose impl "
            "'warp' or 'jax'"
        )

    def blank(self) -> "mjx.Data":
        return private.light_data(self.model)

    def advance(
        self, data: "mjx.Data", fields: Mapping[str, jax.Array], forced: bool, num_substeps: int
    ) -> "tuple[mjx.Data, jax.Array]":
        names = tuple(sorted(fields))
        out = jax.ShapeDtypeStruct((sum(self._sizes),), jnp.float32)
        forces = (data.xfrc_applied,) if forced else ()
        mocap = (data.mocap_pos, data.mocap_quat) if self.model.nmocap else ()

        call = functools.partial(self._stepper.call, names, forced, num_substeps)
        start = (data.qpos, data.qvel, data.qacc_warmstart, data.ctrl)
        arguments = (*start, *mocap, *forces, *(fields[name] for name in names))
        row = host_call(self._number(names, forced, num_substeps), self, call, out, arguments)
        qpos, qvel, warmstart, sensordata = jnp.split(row, np.cumsum(self._sizes)[:-1])
        data = data.replace(
            qpos=qpos,
            qvel=qvel,
            qacc_warmstart=warmstart,
            sensordata=sensordata,
            time=data.time + num_substeps * self.model.opt.timestep,
        )
        return data, jnp.zeros((), bool)

    def _number(self, *options: Any) -> int:
        """Returns a number that names the physics with these options.

        It depends on their content, not on this process.
        """
        motors = () if self.motors is None else dataclasses.astuple(self.motors)
        numbers = [np.asarray(value).tolist() for value in jax.tree.leaves(motors)]
        content = hashlib.sha256(self._content)
        content.update(repr((*options, numbers)).encode())
        return int.from_bytes(content.digest()[:8], "little", signed=True)


class _Stepper:
    """Steps environments of one model in batches, which it keeps until its engine is gone."""

    def __init__(self, model: mujoco.MjModel, motors: Motors | None) -> None:
        self._model = model
        self._motors = motors
        self._idle: dict[tuple[int, tuple[str, ...], bool], list[tuple[Batch, _Rows | None]]] = {}
        self._lock = threading.Lock()
        self._retired = False

    def __reduce__(self) -> tuple[Any, ...]:
        return _Stepper, (self._model, self._motors)  # a copy has its own batches

    def retire(self) -> None:
        """Frees its batches, and those of later calls when they end.

        It takes no lock: a finaliser may interrupt.
        """
        self._retired = True
        self._idle = {}

    def call(
        self, names: tuple[str, ...], forced: bool, substeps: int, *arrays: np.ndarray
    ) -> np.ndarray:
        """Returns positions, velocities, accelerations and sensors after `substeps` physics steps.

        They are rows (N, sum of the sizes).
        """
        qpos, *rest = arrays
        lead = qpos.shape[:-1]
        count = int(np.prod(lead)) if lead else 1
        flat = iter([array.reshape(count, *array.shape[len(lead) :]) for array in (qpos, *rest)])
        key = count, names, forced
        with self._lock:
            idle = self._idle.setdefault(key, [])
            if idle:
                batch, rows = idle.pop()
            else:
                batch = Batch(self._model, nsim=count, nthread=cores())
                rows = self._repeat(count)
        try:
            row = self._step_batch(batch, rows, names, forced, substeps, flat)
        finally:
            if not self._retired:
                idle.append((batch, rows))
        return row.reshape(*lead, -1)

    def _step_batch(
        self,
        batch: Batch,
        rows: _Rows | None,
        names: tuple[str, ...],
        forced: bool,
        substeps: int,
        flat: Iterator[np.ndarray],
    ) -> np.ndarray:
        """Returns the results of a batch (N, sum of the sizes).

        `flat` are the arguments of the call (N, ...).
        """
        start = {name: next(flat) for name in ("qpos", "qvel", "qacc_warmstart", "ctrl")}
        for name, values in start.items():
            batch.bind(name)[:] = values
        if self._model.nmocap:
            batch.bind("mocap_pos")[:] = next(flat)
            batch.bind("mocap_quat")[:] = next(flat)
        if forced:
            batch.bind("xfrc_applied")[:] = next(flat)
        batch.bind("time")[:] = 0.0
        for name in names:
            batch.expand(name)[:] = next(flat)
        sensordata = batch.bind("sensordata")
        if self._motors is None or rows is None:
            batch.step(nstep=substeps)
        else:
            _drive(batch, self._motors, rows, substeps, names, start)
        parts = [batch.bind("qpos"), batch.bind("qvel"), batch.bind("qacc_warmstart"), sensordata]
        return np.concatenate(parts, axis=1, dtype=np.float32)

    def _repeat(self, count: int) -> _Rows | None:
        """Returns motors, gain (count, J) and bias (count, J, 3), a row for each environment."""
        if self._motors is None:
            return None
        gain = np.tile(self._model.actuator_gainprm[:, 0].astype(np.float32), (count, 1))
        bias = _columns(np.tile(self._model.actuator_biasprm[:, :3], (count, 1, 1)))
        return self._motors.repeat(count), gain, bias


def _drive(
    batch: Batch,
    motors: Motors,
    rows: _Rows,
    substeps: int,
    names: tuple[str, ...],
    start: dict[str, np.ndarray],
) -> None:
    """Steps a batch from `start`, with the motors' limits in every physics step.

    The limits seldom act on robots that walk. So the environments whose motors are idle
    (`Motors.idle`), unless they are few, make their physics steps in one call without limits. The
    states between these steps are then checked likewise. The environments that fail a check step
    from `start` with the limits evaluated in every physics step. The result is that of doing so in
    all environments, to the last bit.
    """
    every, gain, bias = rows
    if "actuator_gainprm" in names:
        gain = batch.expand("actuator_gainprm")[..., 0].astype(np.float32)
    if "actuator_biasprm" in names:
        bias = _columns(batch.expand("actuator_biasprm")[..., :3])
    asked = start["ctrl"]
    position = start["qpos"][:, motors.joint_qpos]
    velocity = start["qvel"][:, motors.joint_qvel]
    idle = every.idle(asked, position, velocity, gain, bias)
    if np.count_nonzero(idle) > SHARE * len(idle):
        ids = np.flatnonzero(idle)
        path = batch.rollout(substeps, record=("qpos", "qvel"), ids=ids)
        for step in range(substeps - 1):
            position[ids] = path["qpos"][:, step][:, motors.joint_qpos]
            velocity[ids] = path["qvel"][:, step][:, motors.joint_qvel]
            idle &= every.idle(asked, position, velocity, gain, bias)
        # Unlike steps, a rollout ends where the engine warns.
        idle &= batch.bind("time") > (substeps - 0.5) * motors.timestep
    else:
        idle[:] = False
    ids = np.flatnonzero(~idle)
    if ids.size:
        for name, values in start.items():
            batch.bind(name)[ids] = values[ids]
        batch.bind("time")[ids] = 0.0
        if len(ids) < batch.nsim:
            every = motors.repeat(len(ids))
            gain = gain[ids]
            bias = bias[ids]
        _step_limited(batch, every, substeps, ids, gain, bias)
    _clamp(batch, motors, slice(None))


def _step_limited(
    batch: Batch, motors: Motors, substeps: int, ids: np.ndarray, gain: np.ndarray, bias: np.ndarray
) -> None:
    """Steps the environments `ids`, with the motors' limits in every physics step.

    `motors`, `gain` and `bias` have a row for each of them.
    """
    rows = slice(None) if len(ids) == batch.nsim else ids[:, None]  # numpy is faster with a slice
    qpos = batch.bind("qpos")
    qvel = batch.bind("qvel")
    ctrl = batch.bind("ctrl")
    angles = motors.joint_qpos
    speeds = motors.joint_qvel
    asked = ctrl[ids].astype(np.float32)
    armature = batch.expand("dof_armature")
    base = armature[rows, speeds]
    try:
        for _ in range(substeps):
            position = qpos[rows, angles].astype(np.float32)
            velocity = qvel[rows, speeds].astype(np.float32)
            ctrl[ids], added = motors.limit(np, asked, position, velocity, gain, bias)
            armature[rows, speeds] = base + added if added.any() else base
            batch.step(ids=ids)
            _clamp(batch, motors, rows)
    finally:  # the batch is used again
        armature[rows, speeds] = base


def _clamp(batch: Batch, motors: Motors, rows: Any) -> None:
    """Clamps the joint speeds of environments after a physics step.

    `rows` is the column of their ids, or a slice.
    """
    qpos = batch.bind("qpos")
    qvel = batch.bind("qvel")
    angles = motors.joint_qpos
    speeds = motors.joint_qvel
    velocity = qvel[rows, speeds]
    if np.any(np.abs(velocity) > CLAMP * float(motors.speed.min())):
        qpos[rows, angles], qvel[rows, speeds] = motors.clamp(qpos[rows, angles], velocity)


def _columns(bias: np.ndarray) -> np.ndarray:
    """Returns coefficients (..., J, 3) in single precision, each column contiguous."""
    columns = np.ascontiguousarray(np.moveaxis(bias, -1, 0), np.float32)
    return np.moveaxis(columns, 0, -1)
