"""What both engines on Warp share: when they can run, and the model that Warp gets."""

import copy
from collections.abc import Collection

import jax
import mujoco
import numpy as np

from mqe_jax.core.settings import fail
from mqe_jax.physics.engines import private

_BIT = mujoco.mjtDisableBit
_JACOBIAN = mujoco.mjtJacobian
_FRICTION: int = int(_BIT.mjDSBL_FRICTIONLOSS)
_MAX_DENSE = 50
"""Degrees of freedom up to which Warp's line search needs no extra kernels for dense Jacobians."""
_MAX_FULL = 80
"""Degrees of freedom above which Warp's solver skips zeros by default.

On an H200 this gains nothing with four robots (78, the most of the paper) and a third with eight
(150): sizes/warp in results/measurements.json.
"""
_TERMS: dict[int, tuple[str, ...]] = {
    _FRICTION: ("dof_frictionloss", "tendon_frictionloss"),
    private.PASSIVE: (
        "jnt_stiffness",
        "jnt_stiffnesspoly",
        "tendon_stiffness",
        "tendon_stiffnesspoly",
        "dof_damping",
        "dof_dampingpoly",
        "tendon_damping",
        "tendon_dampingpoly",
        "actuator_damping",
        "actuator_dampingpoly",
        "body_gravcomp",
        "geom_adhesion",
        "pair_adhesion",
    ),
}
"""The model fields of each term of the dynamics: if all are zero, so is the term.

Without springs and dampers Warp and MuJoCo compute no passive force at all, so the fields of
`PASSIVE` include gravity compensation and adhesion.
"""


def unused_terms(model: mujoco.MjModel, fields: Collection[str]) -> int:
    """Returns the disable flags of terms that are zero, also with any values of `fields`."""
    flags = sum(
        flag
        for flag, names in _TERMS.items()
        if not any(name in fields or np.any(getattr(model, name)) for name in names)
    )
    # Flexes and fluids add passive forces; without dampers, implicit integrators ignore the
    # actuators' derivatives.
    fluid = any((model.opt.density, model.opt.viscosity, *model.opt.wind))
    implicit = model.opt.integrator != mujoco.mjtIntegrator.mjINT_EULER
    if implicit or model.nflex or fluid:
        flags &= ~private.PASSIVE
    return flags


def is_plain(model: mujoco.MjModel) -> bool:
    """Returns whether `private.launch_scene_step` computes a model's step, without its actuators.

    It lacks tendons, flexes, activations, energy, other integrators than Euler's without implicit
    damping, and sensors other than of contacts.
    """
    absent = model.ntendon, model.nflex, model.na, model.nplugin, model.opt.enableflags
    explicit = model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    explicit &= bool(model.opt.disableflags & _BIT.mjDSBL_EULERDAMP)
    contacts = np.all(model.sensor_type == mujoco.mjtSensor.mjSENS_CONTACT)
    known = private.is_read() and explicit and bool(contacts)
    return known and not any(absent) and not np.any(model.jnt_actfrclimited)


def is_small(model: mujoco.MjModel) -> bool:
    """Returns whether `warp_solver` computes the accelerations of a model."""
    newton = model.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON
    pyramids = model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    dense = model.opt.jacobian == _JACOBIAN.mjJAC_DENSE and model.nv <= _MAX_DENSE
    return is_plain(model) and newton and pyramids and dense and not model.opt.noslip_iterations


def subtree_ends(model: mujoco.MjModel) -> np.ndarray:
    """Returns the number after the last of each body and those below it (nbody,)."""
    ends = np.arange(1, model.nbody + 1)
    for body in reversed(range(1, model.nbody)):
        parent = model.body_parentid[body]
        ends[parent] = max(ends[parent], ends[body])
    return ends


def with_jacobian(model: mujoco.MjModel) -> mujoco.MjModel:
    """Returns the model, or a copy with dense Jacobians.

    These take fewer kernels in small models that leave the choice.
    """
    if model.opt.jacobian != _JACOBIAN.mjJAC_AUTO or model.nv > _MAX_DENSE:
        return model
    model = copy.copy(model)
    model.opt.jacobian = _JACOBIAN.mjJAC_DENSE
    return model


def skips_zeros(model: mujoco.MjModel, wanted: bool | None) -> bool:
    """Returns whether the solver skips zeros, as `Engine.sparse_solver` says.

    `model` is of `with_jacobian`. InputError if it is wanted but impossible.
    """
    needs = private.sparse_newton_needs(model)
    if needs and wanted:
        fail("sparse_solver", True, f"None or False: it needs {needs}")
    return not needs and (model.nv > _MAX_FULL if wanted is None else wanted)


def is_preferred() -> bool:
    """Returns whether Warp is here and JAX runs on an NVIDIA GPU."""
    kinds = [device.device_kind.lower() for device in jax.devices()]
    nvidia = any("cuda" in kind or "nvidia" in kind for kind in kinds)
    return jax.default_backend() == "gpu" and nvidia and private.warp_is_installed()


def obstacle() -> str | None:
    """Returns why this machine cannot run Warp, or None."""
    if private.warp_is_installed():
        return None
    return "needs the package warp-lang: pip install 'mqe-jax[warp]', or choose impl 'c' or 'jax'"
