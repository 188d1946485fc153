"""Physics engines behind one protocol, `Engine`, by name; the state is always an `mjx.Data`.

| name (`impl`) | engine | hardware |
|---|---|---|
| `warp` | MuJoCo Warp, called once an environment step | NVIDIA GPU (CPU for tests) |
| `c` | MuJoCo's own C engine on all cores, called through XLA's foreign function interface | CPU |
| `jax` | MJX, JAX implementation | CPU, GPU, TPU |
| `warp-mjx` | MuJoCo Warp as MJX calls it: the reference of `warp`, slower | as `warp` |
"""

import pkgutil
from typing import Any

import mujoco

from mqe_jax.core.devices import platform
from mqe_jax.core.errors import InputError, known_name
from mqe_jax.physics.engines.engine import STATE_FIELDS, Engine

__all__ = ["ENGINES", "STATE_FIELDS", "Engine", "make", "resolve"]

ENGINES: dict[str, str] = {
    "warp": "mqe_jax.physics.engines.warp_engine:WarpEngine",
    "c": "mqe_jax.physics.engines.c:CEngine",
    "jax": "mqe_jax.physics.engines.mjx:JaxEngine",
    "warp-mjx": "mqe_jax.physics.engines.mjx:WarpMjxEngine",
}
"""Engines by name as MODULE:CLASS, imported on demand: a new one is one line. `auto` is the first
that is preferred on this machine."""


def resolve(impl: str = "auto") -> str:
    """Returns the name of an engine that can run here.

    `auto` is warp on an NVIDIA GPU, c on a CPU, and jax elsewhere. InputError for an unknown engine
    or one that cannot run here.
    """
    platform()  # an InputError without the devices of JAX_PLATFORMS
    if known_name("impl: unknown engine", impl, ("auto", *ENGINES)) == "auto":
        return next(name for name in ENGINES if pkgutil.resolve_name(ENGINES[name]).is_preferred())
    obstacle = pkgutil.resolve_name(ENGINES[impl]).obstacle()
    if obstacle is not None:
        raise InputError(f"impl {impl!r} {obstacle}")
    return impl


def make(model: mujoco.MjModel, *, impl: str = "auto", **options: Any) -> Engine:
    """Creates an engine by name for a compiled model.

    The options are those of `Engine`. InputError as `resolve`.
    """
    return pkgutil.resolve_name(ENGINES[resolve(impl)])(model, **options)
