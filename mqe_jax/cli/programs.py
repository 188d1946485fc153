"""The start of a command, and compiled programs that JAX stores."""

import contextlib
import gc
import importlib
import os
import platform
import sys
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mqe_jax.core.errors import InputError


def hasten() -> None:
    """Makes the start of a command faster: fewer searches for garbage, no plug-ins of pydantic."""
    gc.set_threshold(50_000, 20, 100)
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")


def add_imports(names: Sequence[str]) -> None:
    """Imports the values of `--import`, in single precision; errors as `core.imports.add`."""
    if not names:
        return
    import_mujoco()
    from mqe_jax.core import imports
    from mqe_jax.core.precision import single  # imports JAX

    with contextlib.redirect_stdout(sys.stderr):  # which has the `--json` object alone
        for name in names:
            single(imports.add)(name)


def find_packages(target: str) -> None:
    """Imports packages that register tasks, if a target may be a task of theirs."""
    from mqe_jax.envs.registry import ALIASES, TASKS, load_packages, packages

    if target not in (*TASKS, *ALIASES) and os.sep not in target and packages():
        import_mujoco()
        with contextlib.redirect_stdout(sys.stderr):
            load_packages()


def import_mujoco() -> None:
    """Imports MuJoCo without a GL library, whatever MUJOCO_GL is: `viz.render` loads one to draw.

    A missing library fails while MuJoCo is imported, and its search for GLFW starts a process.
    """
    chosen = os.environ.get("MUJOCO_GL")
    os.environ["MUJOCO_GL"] = "disable"
    try:
        importlib.import_module("mujoco")
    finally:
        del os.environ["MUJOCO_GL"]
        if chosen is not None:
            os.environ["MUJOCO_GL"] = chosen


def keep() -> None:
    """Has JAX store compiled programs in the user's cache folder, by kind of processor.

    `JAX_COMPILATION_CACHE_DIR` names another folder.
    """
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    from mqe_jax.core.files import user_cache

    # Nothing is stored without a home, or in one that cannot be written.
    with contextlib.suppress(OSError, InputError):
        about = Path("/proc/cpuinfo")
        lines = about.read_text().splitlines() if about.is_file() else []
        flags = [line for line in lines if line.startswith(("flags", "Features"))]
        kind = flags[0] if flags else platform.machine()
        folder = user_cache() / f"programs-{zlib.crc32(kind.encode()):08x}"
        folder.mkdir(parents=True, exist_ok=True)
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")


def write_whole() -> None:
    """Has JAX write the files of compiled programs atomically.

    JAX itself writes them in place and never replaces one. If a kill or a full disk cuts a file
    off, every later start would read it in vain, warn, and compile its program again. Imports JAX.
    """
    from mqe_jax.core.files import write_atomically

    # The class is private: another JAX may lack it, and then writes as it does.
    with contextlib.suppress(ImportError, AttributeError):
        from jax._src.lru_cache import LRUCache

        original = LRUCache.put

        def put(self: Any, key: str, value: bytes) -> None:
            if self.eviction_enabled:
                return original(self, key, value)
            path = Path(self.path, f"{key}-cache")
            if not path.exists():
                write_atomically(path, value)

        if original.__module__ != __name__:
            LRUCache.put = put
