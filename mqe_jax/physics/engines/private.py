"""All uses of private modules and attributes of MuJoCo and MJX."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import functools
import importlib
import importlib.metadata
import io
import sys
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

if TYPE_CHECKING:
    from mujoco import mjx

SENSORS = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
PASSIVE = int(mujoco.mjtDisableBit.mjDSBL_SPRING) | int(mujoco.mjtDisableBit.mjDSBL_DAMPER)
_ITERATIONS = 1 << 9 | 1 << 10
"""Warp's flags for a solver at its iteration limit, which is expected, and no overflow."""
_READ = "3.17.0"
"""Version of mujoco-mjx of which `newton.py` and `launch_scene_step` replace parts; compare these
before raising it."""


class _Late(ModuleType):
    """A module that is imported when it is used.

    Until it is `ready`, all its attributes are `object`.
    """

    ready = False

    def __getattr__(self, name: str) -> Any:
        return getattr(importlib.import_module(self.__name__), name) if self.ready else object


@functools.cache
def load_mjx() -> ModuleType:
    """Imports MJX, without the lines that it prints if Warp is not installed.

    Only an NVIDIA GPU needs Warp.

    The packages with which it computes convex hulls of meshes take 80% of this time; they are
    imported when it does.
    """
    printed = io.StringIO()
    late = {name: _Late(name) for name in ("scipy.spatial", "trimesh") if name not in sys.modules}
    sys.modules.update(late)
    try:
        with contextlib.redirect_stdout(printed):
            from mujoco import mjx
    finally:
        for name, module in late.items():
            del sys.modules[name]
            module.ready = True
    for line in printed.getvalue().splitlines():
        if not line.endswith("No module named 'warp'"):
            print(line)
    return mjx


def light_data(model: mujoco.MjModel) -> mjx.Data:
    """Returns MJX's data of one environment with public fields only, on JAX's first device.

    They are of impl `cpp`, whose private fields are two memory addresses, here zero: those of
    MJX's `make_data` are invalid in another process, and it needs JAX's CPU backend.
    """
    load_mjx()
    from mujoco.mjx._src import io as mjx_io
    from mujoco.mjx._src import types

    fields = mjx_io._put_data_public_fields(mujoco.MjData(model))
    zero = np.zeros((), np.uint32)
    data = types.Data(**fields, _impl=types.DataCPP(pointer_lo=zero, pointer_hi=zero))
    return mjx_io._strip_weak_type(jax.device_put(data, jax.local_devices()[0]))


def warp_is_installed() -> bool:
    """Returns whether MJX found the package warp-lang."""
    load_mjx()
    from mujoco.mjx import warp as mjx_warp

    return bool(mjx_warp.WARP_INSTALLED)


@functools.cache
def keep_streams() -> None:
    """Makes Warp remember JAX's streams until the process ends.

    Warp forgets a stream when the garbage collector finds an old handle to it, even while a newer
    handle captures a step. The capture then fails with "unknown stream" (warp 1.18, with several
    environments in one process).
    """
    stream = importlib.import_module("warp").Stream
    release = stream.__del__
    stream.__del__ = lambda handle: release(handle) if handle.owner else None


def without_warnings(model: mjx.Model) -> mjx.Model:
    """Disables Warp's printed warnings of overflows, which `Engine.step` returns."""
    return model.replace(opt=model.opt.replace(_impl=model.opt._impl.replace(warn_overflow=0)))


def without_overflow(data: mjx.Data) -> mjx.Data:
    """Clears Warp's overflow flags."""
    none = jnp.zeros_like(data._impl.overflow)
    return data.replace(_impl=dataclasses.replace(data._impl, overflow=none))


def overflow(data: mjx.Data) -> jax.Array:
    """Returns whether Warp dropped contacts or constraints since its flags were cleared () bool."""
    return jnp.any(overflowed(data._impl.overflow))


def is_read() -> bool:
    """Returns whether the installed mujoco-mjx is the one of which this package replaces parts."""
    return importlib.metadata.version("mujoco-mjx") == _READ


def sparse_newton_needs(model: mujoco.MjModel) -> str | None:
    """Returns what a model lacks on Warp for `with_sparse_newton`, or None.

    The text ends a line that begins with "needs".
    """
    if not is_read():
        return f"mujoco-mjx {_READ}, not {importlib.metadata.version('mujoco-mjx')}"
    if model.opt.jacobian == mujoco.mjtJacobian.mjJAC_DENSE:
        return f"sparse Jacobians, but those of {model.nv} degrees of freedom are dense"
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_DISCRETE:  # couples robots by tendons too
        return "another integrator than discrete"
    return None


def with_sparse_newton(model: mjx.Model) -> mjx.Model:
    """Returns a model whose Newton steps on Warp are those of `newton.py`.

    Other models of the process keep theirs.
    """
    marked = _sparse_block_dim()(**vars(model._impl.block_dim))
    return model.replace(_impl=model._impl.replace(block_dim=marked))


@functools.cache
def _sparse_block_dim() -> type:
    """Returns a type of Warp's block sizes that marks models.

    Warp takes the Newton steps of marked models from `newton.py`.

    Of all that MJX hands to Warp, this class is the only one that keeps its type, also in the keys
    of caches.
    """
    from mujoco.mjx.third_party.mujoco_warp._src import solver
    from mujoco.mjx.warp import types

    from mqe_jax.physics.engines import newton

    @jax.tree_util.register_pytree_node_class
    class SparseBlockDim(types.BlockDim):
        pass

    dense: Any = solver._cholesky_factorize_solve

    def step(model: Any, *arguments: Any, **options: Any) -> None:
        # Scenes with sleep are solved as dense copies.
        sparse = isinstance(model.block_dim, SparseBlockDim) and model.is_sparse
        solve = newton.step if sparse else dense
        solve(model, *arguments, **options)

    solver._cholesky_factorize_solve = step
    return SparseBlockDim


def warp_model(model: mujoco.MjModel, *, sparse: bool) -> Any:
    """Returns MuJoCo Warp's model on Warp's device, as MJX makes it.

    `sparse` says whether its Newton steps are those of `newton.py`.
    """
    made = _mujoco_warp().put_model(model)
    made.opt.warn_overflow = 0
    made.opt.tolerance.fill_(model.opt.tolerance)  # MuJoCo Warp raises it to 1e-6, MJX does not
    if sparse:
        made.block_dim = _sparse_block_dim()(**vars(made.block_dim))
    return made


def warp_data(model: mujoco.MjModel, count: int, contacts: int, constraints: int) -> Any:
    """Returns MuJoCo Warp's data of `count` environments on Warp's device.

    `contacts` is for all environments, `constraints` for each.
    """
    return _mujoco_warp().make_data(model, nworld=count, naconmax=contacts, njmax=constraints)


def warp_bytes(model: mujoco.MjModel, count: int, contacts: int, constraints: int) -> int:
    """Returns the bytes of `warp_data`, which are linear in `count` and `contacts`."""

    def measure(count: int, contacts: int) -> int:
        return _bytes_of_arrays(warp_data(model, count, contacts, constraints))

    with importlib.import_module("warp").ScopedDevice("cpu"):
        least = measure(1, 1)
        of_environment = measure(2, 1) - least
        of_contact = measure(1, 2) - least
    return least + (count - 1) * of_environment + (contacts - 1) * of_contact


def warp_step(model: Any, data: Any, disable: int, launch: Callable[[Any, Any], None]) -> None:
    """Launches a physics step, `launch(model, data)`, with further disable flags."""
    model = copy.copy(model)
    model.opt = copy.copy(model.opt)
    model.opt.disableflags |= disable
    launch(model, data)


def launch_step(m: Any, d: Any) -> None:
    """Launches a physics step of MuJoCo Warp."""
    _mujoco_warp().step(m, d)


def launch_scene_step(
    m: Any, d: Any, ends: Any, kernels: Any, forced: bool, solver: Any = None
) -> None:
    """Launches a physics step of a scene of `warp_model.is_plain` in fewer kernels.

    Actuators are not read, but their forces `qfrc_actuator`. `forced` says whether `xfrc_applied`
    is read. `ends` are those of `warp_model.subtree_ends`, on the device; `kernels` is the module
    `warp_kernels`. `solver` is a `warp_solver.Solver`, or None for MuJoCo Warp's.
    """
    launch = importlib.import_module("warp").launch
    smooth = warp_source("smooth")
    forward = warp_source("forward")

    def each(kernel: Any, columns: int, *inputs: Any, to: Sequence[Any]) -> None:
        launch(kernel, dim=(d.nworld, columns), inputs=[*inputs], outputs=[*to])

    smooth.kinematics(m, d)
    masses = m.body_mass, m.body_subtreemass
    each(kernels.center, m.nbody, ends, *masses, d.xipos, to=[d.subtree_com])
    masses = m.body_mass, m.body_inertia
    frames = d.xipos, d.ximat, d.subtree_com
    each(smooth._cinert, m.nbody, m.body_rootid, *masses, *frames, to=[d.cinert])
    joints = m.jnt_type, m.jnt_dofadr, m.jnt_bodyid
    frames = d.xmat, d.xanchor, d.xaxis, d.subtree_com
    each(smooth._cdof, m.njnt, m.body_rootid, *joints, *frames, to=[d.cdof])
    each(kernels.composite, m.nbody, ends, d.cinert, to=[d.crb])
    d.M.zero_()
    rows = m.dof_bodyid, m.dof_parentid, m.dof_armature, m.M_rownnz, m.M_rowadr
    each(smooth._M, m.nv, *rows, d.cdof, d.crb, to=[d.M])
    warp_source("collision_driver").collision(m, d)
    warp_source("constraint").make_constraint(m, d)
    smooth.com_vel(m, d)
    if ~m.opt.disableflags & PASSIVE:
        warp_source("passive").passive(m, d)
    smooth._rne_cacc_world(m, d)
    smooth._rne_cacc_forward(m, d)
    smooth._rne_cfrc(m, d)
    known = d.cdof, d.cfrc_int, d.qfrc_passive, d.qfrc_actuator
    each(kernels.forces, m.nv, ends, m.dof_bodyid, *known, to=[d.qfrc_smooth])
    if forced:
        warp_source("support").xfrc_accumulate(m, d, d.qfrc_smooth)
    if solver is None:
        smooth.factor_solve_i(m, d, d.M, d.qLD, d.qLDiagInv, d.qacc_smooth, d.qfrc_smooth)
        warp_source("solver").solve(m, d)
    else:
        solver.launch(m, d)
    if ~m.opt.disableflags & SENSORS:
        d.sensordata.zero_()
        warp_source("sensor").sensor_acc(m, d, skip_rne_postconstraint=True)
    joints = m.jnt_type, m.jnt_qposadr, m.jnt_dofadr
    changed = d.qpos, d.qvel, d.qacc_warmstart
    each(kernels.advance, m.njnt, m.opt.timestep, *joints, d.qacc, to=changed)
    limits = d.nworld, d.naconmax, d.njmax, d.njmax_nnz
    counts = d.efc.J_rownnz, d.efc.J_rowadr, *limits, d.nacon, d.ncollision
    launch(
        forward._next_time_builder(int(m.opt.warn_overflow)),
        dim=d.nworld,
        inputs=[m.opt.timestep, m.is_sparse, d.nefc, d.time, *counts],
        outputs=[d.time, d.overflow],
    )


def warp_source(name: str) -> ModuleType:
    """Returns a module of MuJoCo Warp."""
    return importlib.import_module(f"mujoco.mjx.third_party.mujoco_warp._src.{name}")


def overflowed(flags: jax.Array) -> jax.Array:
    """Returns where Warp dropped contacts or constraints, from its flags."""
    return (flags & ~_ITERATIONS) != 0


def forget_graphs(call: Any) -> None:
    """Frees the graphs that a callable of Warp captured, and their copies of arguments."""
    call.captures.clear()
    for traced in call.call_descriptors.values():
        for name in ("capture", *_STAGED):
            setattr(traced, name, None)


_STAGED = "input_staging_arrays", "output_staging_arrays", "static_staging_arrays"


def _mujoco_warp() -> Any:
    return importlib.import_module("mujoco.mjx.third_party.mujoco_warp")


def _bytes_of_arrays(structure: Any) -> int:
    """Returns the bytes of Warp's arrays in a structure."""
    found = 0
    for value in vars(structure).values():
        if dataclasses.is_dataclass(value):
            found += _bytes_of_arrays(value)
        else:
            found += getattr(value, "capacity", 0)
    return found


def contact(data: mjx.Data) -> mjx.Contact:
    """Returns MJX-JAX's list of contacts."""
    return data._impl.contact


def with_contact(data: mjx.Data, contact: mjx.Contact) -> mjx.Data:
    """Returns data with another list of contacts."""
    return data.replace(_impl=data._impl.replace(contact=contact))


def is_constrained(data: mjx.Data) -> bool:
    """Returns whether MJX-JAX's data have rows for constraints."""
    return data._impl.efc_J.size > 0


class GeomPairs(NamedTuple):
    """K pairs of geoms that may touch, of the same types."""

    types: tuple[Any, Any]  # types of both geoms
    condim: int  # dimension of their contacts
    geoms: np.ndarray  # numbers of the geoms (K, 2)
    contact: mjx.Contact  # parameters of their contacts (K, ...)
    collide: Callable[[mjx.Model, mjx.Data], tuple[jax.Array, jax.Array, jax.Array]]
    """Returns distances (K C,), positions (K C, 3) and frames (K C, 3, 3) of C contacts for each
    pair."""


def geom_pairs(model: mjx.Model, data: mjx.Data) -> list[GeomPairs]:
    """Returns the pairs of geoms between which MJX-JAX computes contacts, by their types."""
    from mujoco.mjx._src import collision_driver

    found = []
    geoms = collision_driver._geom_groups(model)
    for key, pairs in collision_driver._contact_groups(model, data).items():
        function: Any = collision_driver._COLLISION_FUNC[key.types]  # pyright: ignore[reportArgumentType]

        def collide(
            model: mjx.Model,
            data: mjx.Data,
            function: Any = function,
            key: Any = key,
            pairs: Any = pairs,
        ):
            return function(model, data, key, pairs.geom)

        found.append(GeomPairs(key.types, key.condim, np.array(geoms[key]), pairs, collide))
    return found


def make_frames(normal: jax.Array) -> jax.Array:
    """Returns contact frames (N, 3, 3) of contact normals (N, 3)."""
    from mujoco.mjx._src import math

    return jax.vmap(math.make_frame)(normal)
