"""Memory that environments or a rollout would need, compared with what is free."""

import math
from pathlib import Path
from typing import Any

import jax

from mqe_jax.core import limits
from mqe_jax.core.errors import InputError

_GIGABYTE = 2**30


def bytes_of(tree: Any) -> int:
    """Returns the bytes of a pytree's arrays, or of their shapes."""
    return sum(leaf.dtype.itemsize * math.prod(leaf.shape) for leaf in jax.tree.leaves(tree))


def free_memory() -> float:
    """Returns the free bytes of the device that JAX uses; infinity if unknown."""
    device = jax.local_devices()[0]
    if device.platform != "cpu":
        stats = device.memory_stats() or {}
        return stats.get("bytes_limit", math.inf) - stats.get("bytes_in_use", 0)
    free = math.inf
    meminfo = Path("/proc/meminfo")
    if meminfo.is_file():
        lines = dict(line.split(":") for line in meminfo.read_text().splitlines())
        free = 1024.0 * int(lines["MemAvailable"].split()[0])
    group = Path("/sys/fs/cgroup")
    allowed = group / "memory.max"
    most = allowed.read_text().strip() if allowed.is_file() else ""
    if most.isdecimal():
        free = min(free, int(most) - int((group / "memory.current").read_text()))
    return free


def check_memory(name: str, value: object, needed: float) -> None:
    """Raises an InputError if a setting needs too many bytes.

    It may need `limits.MEMORY_SHARE` of the free memory.
    """
    allowed = limits.MEMORY_SHARE * free_memory()
    if needed > allowed:
        limit = f"at most {allowed / _GIGABYTE:.1f} GB may be used"
        raise InputError(f"{name}: {value} needs {needed / _GIGABYTE:.1f} GB or more; {limit}")
