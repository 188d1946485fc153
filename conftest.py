"""Shared by all tests: the CPU, a compilation cache, skip reasons of GPU and soak tests, and a fake
task for `mqe`.
"""

import functools
import gc
import importlib.util
import os
import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

# Before the first import of jax; existing environment variables take precedence.
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parent / ".cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
# Programs without the lines of Python that their operations come from.
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")

import pytest

# The tests compile far longer than they simulate. Unoptimised code halves their time, and XLA's
# fusion emitters without MLIR save a third of the rest (an XLA that lacks this option ignores it).
# The soak runs optimised code.
UNOPTIMISED = (
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
    " --xla_backend_extra_options=xla_cpu_disable_new_fusion_emitters"
    " --xla_cpu_opt_preset=FAST_COMPILE --xla_cpu_parallel_codegen_split_count=1"
)


def _soak_requested(config: pytest.Config) -> bool:
    return os.environ.get("MQE_SOAK") == "1" or "soak" in str(config.getoption("-m", default=""))


def pytest_configure(config: pytest.Config) -> None:
    """Disables XLA optimisation on the CPU, also in subprocesses; an existing XLA_FLAGS takes
    precedence.
    """
    # tracing makes objects that stay: looking for garbage takes a third of its time
    gc.set_threshold(200_000, 20, 50)
    given = os.environ.get("XLA_FLAGS", "")
    if (
        os.environ["JAX_PLATFORMS"] == "cpu"
        and not _soak_requested(config)
        and UNOPTIMISED not in given
    ):
        os.environ["XLA_FLAGS"] = f"{UNOPTIMISED} {given}".strip()


def _gpu_missing(config: pytest.Config) -> str:
    """Reason for skipping GPU tests; empty if they can run.

    In the soak Warp runs on the CPU, where it is installed.
    """
    if os.environ["JAX_PLATFORMS"] == "cpu":
        if _soak_requested(config) and importlib.util.find_spec("warp"):
            return ""
        return (
            "JAX_PLATFORMS=cpu (set JAX_PLATFORMS=cuda,cpu, or install warp-lang and run the soak)"
        )
    try:
        subprocess.run(["nvidia-smi", "-L"], check=True, capture_output=True, timeout=20)
    except (OSError, subprocess.SubprocessError):
        return "no NVIDIA GPU"
    return ""


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Skips the tests marked `gpu` where there is no GPU, and those marked `soak` unless requested.

    `MQE_SOAK=1 pytest` runs all tests, `pytest -m soak` the soak alone.
    """
    marked = [item for item in items if item.get_closest_marker("gpu")]
    reason = _gpu_missing(config) if marked else ""
    for item in marked if reason else []:
        item.add_marker(pytest.mark.skip(reason=reason))
    if _soak_requested(config):
        return
    for item in items:
        if item.get_closest_marker("soak"):
            item.add_marker(
                pytest.mark.skip(reason="long: MQE_SOAK=1 pytest, or pytest -m soak, runs it")
            )


@pytest.fixture(scope="session", autouse=True)
def forgotten_modules() -> Iterator[None]:
    """JAX forgets the MLIR module of a program that is compiled, and makes the next one in the same
    context.

    It would keep 1.4 MB for each of thousands of programs, and the more there are, the longer it
    takes to compile another one: 26 ms at first, 48 ms after 2000. A context of its own takes half
    of the time in which a small program is lowered.
    """
    from jax._src.interpreters import mlir, pxla

    original = pxla.MeshComputation.compile
    context = mlir.make_ir_context()

    def compile_and_forget(self: Any, *arguments: Any, **options: Any) -> Any:
        made = original(self, *arguments, **options)
        self._hlo = None
        pxla._cached_lowering_to_hlo.cache_clear()
        return made

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pxla.MeshComputation, "compile", compile_and_forget)
        patch.setattr(mlir, "make_ir_context", lambda: context)
        yield


@pytest.fixture(scope="session", autouse=True)
def short_random_bits(request: pytest.FixtureRequest) -> None:
    """Random numbers are computed by few operations, outside the soak."""
    if not _soak_requested(request.config):
        from tests import random_bits

        random_bits.register()


def pytest_unconfigure() -> None:
    """Python looks for no garbage at its end, among millions of objects."""
    gc.freeze()


@pytest.fixture
def fake_tasks(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The task `fake` in addition to the real ones, for `mqe`, and an empty working folder."""
    from tests import fake_env

    monkeypatch.chdir(tmp_path)
    fake_env.install(monkeypatch)


@functools.cache
def _kept_programs() -> tuple[dict[Any, Any], Any, Any]:
    """Learners by what they are made from, and `SeedBatch` with its `map`, kept until the process
    ends.
    """
    from mqe_jax.train.seeds import SeedBatch

    return {}, functools.cache(SeedBatch), functools.cache(SeedBatch.map)


@pytest.fixture
def mqe(capfd: pytest.CaptureFixture[str]) -> Callable[..., Any]:
    """Runs `mqe` with the words of a line and further ones; returns its `out` and `err`."""
    from mqe_jax import cli

    def run(line: str, *more: object, code: int = 0) -> Any:
        capfd.readouterr()
        found = cli.main([*line.split(), *map(str, more)])
        said = capfd.readouterr()
        assert found == code, said
        return said

    return run


@pytest.fixture(scope="module")
def shared_programs() -> Iterator[None]:
    """Trainings of one environment share their learner and its programs, where settings of the
    learner are the same.
    """
    from mqe_jax.train import runner, start
    from mqe_jax.train.seeds import SeedBatch

    learners, seeds, seeds_map = _kept_programs()
    make_learner = start.make_learner
    others = dict.fromkeys(("seed", "start", "evaluation", "checkpoint", "loggers", "task", "env"))

    def shared_learner(env: Any, config: Any, **options: Any) -> Any:
        key = env, repr(vars(config) | others), *options.values()
        if key not in learners:
            learners[key] = make_learner(env, config, **options)
        return learners[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(start, "make_learner", shared_learner)
        patch.setattr(SeedBatch, "map", seeds_map)
        patch.setattr(runner, "SeedBatch", seeds)
        yield


@pytest.fixture
def sigint() -> Iterator[None]:
    """Python's own handler, which a background job of a shell lacks."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)
