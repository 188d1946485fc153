"""The notebooks: committed without outputs, and run from top to bottom."""

import os
import time
from pathlib import Path
from typing import Any

import pytest

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")
pytest.importorskip("ipykernel")

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "examples" / "notebooks").glob("*.ipynb"))
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
def test_notebooks_are_committed_without_outputs(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
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
