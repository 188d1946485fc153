"""MuJoCo Warp: all physics steps of an environment step, with the motors, in one call.

Model and data are structures of arrays that this module keeps on the device. JAX hands over the
state and the model fields that environments override, and gets the next state.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import importlib
import inspect
import math
import weakref
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import batching, mlir

from mqe_jax.physics.engines import private, warp_model
from mqe_jax.physics.engines.engine import Engine
from mqe_jax.physics.robots.motors import Motors

if TYPE_CHECKING:
    from mujoco import mjx

_KERNELS = "mqe_jax.physics.engines.warp_kernels"  # imports Warp
_SOLVER = "mqe_jax.physics.engines.warp_solver"
_CHANGED = "qpos", "qvel", "qacc_warmstart", "time"
_RESULTS = *_CHANGED, "sensordata", "overflow"


class WarpEngine(Engine):
    """MuJoCo Warp on an NVIDIA GPU; environments share a contact buffer of fixed size.

    It launches each kernel also where it adds zero, so terms that are zero for the whole model are
    disabled.
    """

    impl = "warp"
    graph_mode: ClassVar[str] = "WARP_STAGED"
    """How a GPU repeats the kernels of a call, a name of Warp's `JaxCallableGraphMode`."""

    def __init__(self, model: mujoco.MjModel, **options: Any) -> None:
        super().__init__(model, **options)
        private.keep_streams()
        own = warp_model.with_jacobian(model)
        self.skips_zeros = warp_model.skips_zeros(own, self.sparse_solver)
        """Whether the solver skips the zeros between robots that do not touch."""
        limits = self.num_envs * self.contacts_per_env, self.max_constraints_per_env
        self._stepper = _Stepper(own, self.motors, self.skips_zeros, limits, self.graph_mode)
        weakref.finalize(self, self._stepper.retire).atexit = False

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._stepper = copy.copy(self._stepper)
        weakref.finalize(self, self._stepper.retire).atexit = False

    @classmethod
    def is_preferred(cls) -> bool:
        return warp_model.is_preferred()

    @classmethod
    def obstacle(cls) -> str | None:
        return warp_model.obstacle()

    def holds(self, num_envs: int) -> bool:
        return num_envs <= self.num_envs

    def own_bytes(self, num_envs: int) -> int:
        return self._stepper.bytes(num_envs)

    def blank(self) -> mjx.Data:
        return private.light_data(self.model)

    def advance(
        self, data: mjx.Data, fields: Mapping[str, jax.Array], forced: bool, num_substeps: int
    ) -> tuple[mjx.Data, jax.Array]:
        mocap = ("mocap_pos", "mocap_quat") if self.model.nmocap else ()
        read = (*_CHANGED, "ctrl", *mocap, *(("xfrc_applied",) if forced else ()))
        call = _Call(self._stepper, read, tuple(sorted(fields)), num_substeps)
        arrays = [getattr(data, name) for name in read] + [fields[name] for name in call.fields]
        found = _steps.bind(*(jnp.asarray(array)[None] for array in arrays), call=call)
        *state, overflow = (array[0] for array in found)
        data = data.replace(**dict(zip(_RESULTS[:-1], state, strict=True)))
        return data, private.overflowed(overflow)


@dataclasses.dataclass(frozen=True)
class _Call:
    """What a call of Warp does."""

    stepper: _Stepper
    read: tuple[str, ...]  # fields of the data that it reads
    fields: tuple[str, ...]  # fields of the model that environments override
    num_substeps: int


class _Stepper:
    """Arrays and callables of an engine on Warp, until the engine is gone.

    Warp and XLA keep callables for longer, and JAX programs; without arrays they are small. Calls
    share the arrays, since each writes all that it reads.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        motors: Motors | None,
        sparse: bool,
        limits: tuple[int, int],
        graph_mode: str,
    ) -> None:
        self.model = model
        self.motors = motors
        self._made = model, motors, sparse, limits, graph_mode
        self._arrays: _Arrays | None = None
        self._calls: dict[Any, tuple[Any, ClosedJaxpr]] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return _Stepper, self._made  # a copy has its own arrays

    def bytes(self, count: int) -> int:
        """Returns the bytes of the data and the solver of `count` environments."""
        limits = self._made[3]
        found = private.warp_bytes(self.model, count, *limits)
        if warp_model.is_small(self.model):
            shapes = importlib.import_module(_SOLVER).scratch(self.model.nv, limits[1])
            found += 4 * count * sum(map(math.prod, shapes))
        return found

    def retire(self) -> None:
        """Frees the arrays and the graphs that use them.

        Programs that still run keep them until the next engine allocates its own. It may interrupt
        the capture of a graph, during which nothing can wait for the device.
        """
        if self._arrays is None:
            return
        if not all(array.is_ready() for array in jax.live_arrays() if not array.is_deleted()):
            _running.append(self)
            return
        if not self._arrays.device.is_capturing:
            _warp().synchronize_device(self._arrays.device)
        for callable, _ in self._calls.values():
            private.forget_graphs(callable)
        self._calls = {}
        self._arrays = None

    def call(self, call: _Call, arrays: Sequence[jax.Array]) -> list[jax.Array]:
        """Returns the results of a call, for a program that is being lowered; allocates its arrays.

        `arrays` are the fields of the data, then those of the model.
        """
        key = call.read, call.fields, call.num_substeps, *(array.shape for array in arrays)
        if key not in self._calls:
            for _ in range(len(_running)):
                _running.pop().retire()
            count = len(arrays[0])
            model, motors, sparse, limits, _ = self._made
            if self._arrays is None:
                self._arrays = _Arrays(model, motors, sparse)
            self._arrays.allocate(count, limits)
            callable = self._register(call, count)
            # Each trace would have its own graph and copies of the arrays.
            self._calls[key] = callable, jax.make_jaxpr(callable)(*arrays)
        return jaxpr_as_fun(self._calls[key][1])(*arrays)

    def _register(self, call: _Call, count: int) -> Any:
        """Returns Warp's callable for `count` environments, which JAX can call."""
        wp = _warp()
        assert self._arrays is not None
        data = self._arrays.data[count]
        returned = _RESULTS[len(_CHANGED) :]
        likes = {name: getattr(data, name) for name in call.read}
        likes |= {name: getattr(self._arrays.model, name) for name in call.fields}
        likes |= {name: getattr(data, name) for name in returned}

        names = tuple(likes)

        def run(*arrays: Any) -> None:
            self._step(call, count, dict(zip(names, arrays, strict=True)))

        # Warp reads names and types of the arguments from the function, and loads its module.
        kinds = {name: wp.array(dtype=x.dtype, ndim=x.ndim) for name, x in likes.items()}
        kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
        run.__annotations__ = kinds
        run.__qualname__ = "warp_steps"
        run.__module__ = _KERNELS
        vars(run)["__signature__"] = inspect.Signature([inspect.Parameter(x, kind) for x in kinds])
        mode = self._made[4] if jax.default_backend() == "gpu" else "NONE"
        return wp.jax_callable(
            run,
            num_outputs=len(_RESULTS),
            graph_mode=wp.JaxCallableGraphMode[mode],
            output_dims={name: likes[name].shape for name in returned},
            in_out_argnames=_CHANGED,
        )

    def _step(self, call: _Call, count: int, given: dict[str, Any]) -> None:
        """Launches the kernels of a call; a graph repeats them without it."""
        arrays = self._arrays
        if arrays is None:
            raise RuntimeError("the environment of this compiled program no longer exists")
        model = copy.copy(arrays.model)
        data = copy.copy(arrays.data[count])
        for name, array in given.items():
            setattr(model if name in call.fields else data, name, array)
        data.overflow.zero_()
        drive = clamp = _nothing
        step = private.launch_step
        if self.motors is not None:
            drive, clamp = arrays.motor_kernels(model, data, count)
            step = arrays.scene_step(count, "xfrc_applied" in call.read) or step
        unused = warp_model.unused_terms(self.model, call.fields)
        data.qfrc_passive.zero_()
        for left in reversed(range(call.num_substeps)):
            drive()
            private.warp_step(model, data, unused | (private.SENSORS if left else 0), step)
        clamp()


_running: list[_Stepper] = []
"""Steppers whose engines are gone but whose programs ran when they went."""


class _Arrays:
    """Warp's arrays of a model and its motors, and of data of some numbers of environments.

    They are on JAX's first device.
    """

    def __init__(self, model: mujoco.MjModel, motors: Motors | None, sparse: bool) -> None:
        wp = _warp()
        self._model = model
        self.device = _device()
        self.data: dict[int, Any] = {}
        self._armature: dict[int, Any] = {}
        self._solvers: dict[int, Any] = {}
        self._motors: list[Any] = []
        self._runs: list[tuple[slice, int, Any]] = []
        self._kernels: Any = importlib.import_module(_KERNELS)
        with wp.ScopedDevice(self.device):
            self.model = private.warp_model(model, sparse=sparse)
            if motors is not None:
                self._motors = [
                    wp.array(motors.constants, dtype=float),
                    wp.array(motors.joint_qpos, dtype=int),
                    wp.array(motors.joint_qvel, dtype=int),
                    float(motors.timestep),
                ]
                for joints, response in motors.runs:
                    kick = wp.array(motors.timestep * response, dtype=float)
                    self._runs.append((joints, len(response), kick))
            self._ends = wp.array(warp_model.subtree_ends(model), dtype=int)

    def allocate(self, count: int, limits: tuple[int, int]) -> None:
        """Allocates the data of `count` environments unless it exists."""
        if count in self.data:
            return
        wp = _warp()
        with wp.ScopedDevice(self.device):
            self._armature[count] = wp.zeros((count, self._model.nv), dtype=float)
            self.data[count] = private.warp_data(self._model, count, *limits)
            if warp_model.is_small(self._model):
                solver = importlib.import_module(_SOLVER).Solver
                self._solvers[count] = solver(count, self._model.nv, limits[1])
        wp.synchronize_device(self.device)  # JAX's stream does not wait for Warp's

    def scene_step(self, count: int, forced: bool) -> Callable[[Any, Any], None] | None:
        """Returns what launches a physics step in few kernels; None if the model needs more."""
        if not warp_model.is_plain(self._model):
            return None
        own = {"ends": self._ends, "kernels": self._kernels, "solver": self._solvers.get(count)}
        return functools.partial(private.launch_scene_step, forced=forced, **own)

    def motor_kernels(
        self, model: Any, data: Any, count: int
    ) -> tuple[Callable[[], None], Callable[[], None]]:
        """Returns what sets the motors' part before a physics step, and clamps after the last.

        `model` and `data` then have the motors' control, torques and armature.
        """
        wp = _warp()
        given = [model.actuator_gainprm, model.actuator_biasprm, model.dof_armature, data.ctrl]
        data.ctrl = self.data[count].ctrl
        model.dof_armature = self._armature[count]
        wp.launch(
            self._kernels.repeat,
            dim=model.dof_armature.shape,
            inputs=given[2:3],
            outputs=[model.dof_armature],
        )
        state = [data.qpos, data.qvel]

        def drive() -> None:
            for joints, limb, kick in self._runs:
                wp.launch(
                    self._kernels.driver(limb),
                    dim=(count, (joints.stop - joints.start) // limb),
                    inputs=[*self._motors, joints.start, kick, *given],
                    outputs=[*state, data.ctrl, data.qfrc_actuator, model.dof_armature],
                )

        clamp = functools.partial(
            wp.launch,
            self._kernels.clamp,
            dim=data.ctrl.shape,
            inputs=self._motors,
            outputs=state,
        )
        return drive, clamp


def _device() -> Any:
    """Returns JAX's first device of this process; its `id` also counts those of the others."""
    device = jax.local_devices()[0]
    wp = _warp()
    if device.platform == "cpu":
        return wp.get_device("cpu")
    return wp.get_cuda_device(device.local_hardware_id)


def _nothing() -> None:
    pass


def _warp() -> Any:
    return importlib.import_module("warp")


_steps = Primitive("warp_steps")
"""Physics steps of N environments: arrays (N, ...), as `_Call` names them, to `_RESULTS` (N, ...).

A model field may have fewer rows, of which environment n reads row n modulo their number. A
primitive knows the whole batch when JAX lowers it, which is when its arrays are allocated.
"""
_steps.multiple_results = True


@_steps.def_abstract_eval
def _(*arrays: Any, call: _Call) -> list[Any]:
    *state, time = arrays[: len(_CHANGED)]
    sensordata = state[0].update(shape=(time.shape[0], call.stepper.model.nsensordata))
    return [*state, time, sensordata, time.update(dtype=np.int32)]


@_steps.def_impl
@functools.partial(jax.jit, static_argnames="call")
def _(*arrays: jax.Array, call: _Call) -> list[jax.Array]:
    return _steps.bind(*arrays, call=call)


def _batched(
    arrays: Sequence[jax.Array], axes: Sequence[int | None], *, call: _Call
) -> tuple[list[jax.Array], list[int]]:
    """Makes one batch of S batches of N environments."""
    size = next(x.shape[axis] for x, axis in zip(arrays, axes, strict=True) if axis is not None)
    first = arrays[0]
    count = first.shape[int(axes[0] == 0)]
    flat = []
    for number, (x, axis) in enumerate(zip(arrays, axes, strict=True)):
        if axis is not None:
            x = jnp.moveaxis(x, axis, 0)
            if x.shape[1] != count:
                x = jnp.broadcast_to(x, (size, count, *x.shape[2:]))
        elif number < len(call.read):
            x = jnp.broadcast_to(x, (size, *x.shape))
        else:
            flat.append(x)
            continue
        flat.append(x.reshape(size * x.shape[1], *x.shape[2:]))
    found = _steps.bind(*flat, call=call)
    return [x.reshape(size, count, *x.shape[1:]) for x in found], [0] * len(found)


def _lowered(*arrays: jax.Array, call: _Call) -> list[jax.Array]:
    return call.stepper.call(call, arrays)


batching.primitive_batchers[_steps] = _batched
mlir.register_lowering(_steps, mlir.lower_fun(_lowered, multiple_results=True))
