"""Settings that every test shares: the CPU, a compilation cache, and the reason why GPU tests are skipped."""

import os
import subprocess
from pathlib import Path

# Before the first import of jax: what the environment sets already wins.
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")

import pytest


def _gpu_missing() -> str:
    """Why a GPU test cannot run here; empty where it can."""
    if os.environ["JAX_PLATFORMS"] == "cpu":
        return "JAX_PLATFORMS=cpu (set JAX_PLATFORMS=cuda,cpu to run the GPU tests)"
    try:
        subprocess.run(["nvidia-smi", "-L"], check=True, capture_output=True, timeout=20)
    except (OSError, subprocess.SubprocessError):
        return "no NVIDIA GPU"
    return ""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip the tests marked `gpu` where there is no GPU."""
    marked = [item for item in items if item.get_closest_marker("gpu")]
    reason = _gpu_missing() if marked else ""
    for item in marked if reason else []:
        item.add_marker(pytest.mark.skip(reason=reason))
