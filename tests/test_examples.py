"""The examples at a small size, and the notebooks: stored outputs, and runs from top to bottom."""

from __future__ import annotations

import importlib
import importlib.util
import os
import runpy
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax.envs import PLANNERS, TASKS, VectorEnv, make
from mqe_jax.planners import scripted_policy
from mqe_jax.train.evaluate import evaluate
from mqe_jax.train.networks import NETWORKS

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")
pytest.importorskip("ipykernel")

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"


@pytest.fixture(autouse=True)
def script_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    """Examples run as scripts, with their own folder on the import path."""
    monkeypatch.syspath_prepend(str(EXAMPLES))


@pytest.fixture
def example() -> Any:
    """The module of the guide to a new task; its registrations are removed afterwards."""
    spec = importlib.util.spec_from_file_location("new_task", EXAMPLES / "new_task.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["new_task"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["new_task"], TASKS["go1catch"], PLANNERS["go1catch"]


def test_the_example_can_be_solved_and_its_parts_behave_as_documented(example: Any) -> None:
    env = VectorEnv(make("go1catch", impl="c", num_envs=8), 8)
    plan = jax.vmap(scripted_policy(env.env))
    result = evaluate(env, lambda obs, memory, _: (plan(obs), memory), 8, jax.random.PRNGKey(0))
    assert result.success_rate >= 0.5
    idle = evaluate(env, lambda obs, memory, _: (jnp.zeros((8, 1, 3)), memory), 8, jax.random.PRNGKey(0))
    assert idle.success_rate == 0
    np.testing.assert_allclose(
        example.flee(jnp.array([3.0, 1.0]), jnp.array([3.0, 0.0]), speed=0.4), [0, 0.4], atol=1e-6
    )
    np.testing.assert_allclose(example.flee(jnp.array([3.0, 2.0]), jnp.array([3.0, 0.0]), speed=0.4), [0, 0])
    pillar = env.env.compiled.model.geom("wall/pillar1")
    np.testing.assert_allclose(pillar.pos[:2], [2.5, 0.0])


def test_an_environment_of_ones_own_is_trained() -> None:
    example: dict[str, Any] = runpy.run_path(str(EXAMPLES / "foreign_env.py"))
    history = example["main"](num_envs=32, updates=25)
    assert len(history) == 25 and history[-1] < 0.6 * history[0]


def test_a_network_of_ones_own_is_trained() -> None:
    runpy.run_path(str(EXAMPLES / "custom_network.py"))
    try:
        foreign_env = importlib.import_module("foreign_env")

        history = foreign_env.main(num_envs=32, updates=25, network={"name": "mean_field", "width": 32})
    finally:
        NETWORKS.pop("mean_field")
    assert history[-1] < 0.6 * history[0]


def test_self_play_trains_against_a_snapshot_and_a_scripted_opponent() -> None:
    example: dict[str, Any] = runpy.run_path(str(EXAMPLES / "self_play.py"))
    results = example["main"](num_envs=4, updates=3, snapshot_every=2, episodes=4)
    assert len(results) == 2
    assert all(sum(result.match.values()) == pytest.approx(1.0) for result in results)


# -- notebooks --------------------------------------------------------------------------------------------------------

NOTEBOOKS = sorted((EXAMPLES / "notebooks").glob("*.ipynb"))
CLIPS = {"tour": 2, "design_a_task": 1, "compare_algorithms": 0}


def run(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, timeout: int) -> Any:
    """Runs a notebook in a kernel of its own, in an empty folder, and returns it with its outputs."""
    notebook = nbformat.read(path, as_version=4)
    monkeypatch.setenv("PYTHONPATH", str(ROOT), prepend=os.pathsep)
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    client = nbclient.NotebookClient(
        notebook, timeout=timeout, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    )
    return client.execute()


def outputs(notebook: Any, kind: str) -> list[str]:
    """The outputs of a MIME type."""
    found = [output.get("data", {}) for cell in notebook.cells for output in cell.get("outputs", [])]
    return [str(data[kind]) for data in found if kind in data]


def check(notebook: Any, name: str) -> None:
    """Clips are inline, and plots are there."""
    pages = outputs(notebook, "text/html")
    clips = [page for page in pages if "data:video/mp4;base64," in page or "data:image/gif;base64," in page]
    assert len(clips) == CLIPS[name] and all(len(clip) > 2000 for clip in clips)
    if name != "design_a_task":
        assert outputs(notebook, "image/png")


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_are_committed_without_outputs_and_the_tour_with_those_of_one_run(path: Path) -> None:
    """`jupyter execute --inplace FILE` stores them."""
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    if path.stem == "tour":
        assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
        assert all(output.output_type != "error" for cell in code for output in cell.outputs)
        assert path.stat().st_size < 800_000
        check(notebook, path.stem)
    else:
        assert code and all(not cell.outputs and cell.execution_count is None for cell in code)
        assert path.stem in CLIPS


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_run_at_small_size(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MQE_NOTEBOOK_SMALL", "1")
    monkeypatch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")  # halves the time, which is compilation
    check(run(path, tmp_path, monkeypatch, timeout=240), path.stem)


@pytest.mark.soak
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_run_whole_in_under_five_minutes(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MQE_NOTEBOOK_SMALL", raising=False)
    start = time.monotonic()
    check(run(path, tmp_path, monkeypatch, timeout=900), path.stem)
    assert time.monotonic() - start < 300
