"""The direction of imports, and the import diagram."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))

import architecture


def test_every_import_goes_down() -> None:
    """No module imports from a higher layer, and the trainer does not depend on tasks, robots or physics."""
    assert architecture.violations() == []


def test_the_import_diagram_is_up_to_date() -> None:
    """docs/architecture.svg is up to date, and docs/architecture.md names every module."""
    assert architecture.PICTURE.read_text(encoding="utf-8") == architecture.draw()
    page = architecture.PICTURE.with_suffix(".md").read_text(encoding="utf-8")
    assert [module for module in architecture.modules() if f"`{module}" not in page] == []


def test_a_wrong_import_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """An upward import is found, also inside a function, and reported with its file."""
    package = tmp_path / "mqe_jax"
    (package / "train").mkdir(parents=True)
    (package / "train" / "__init__.py").write_text("def late():\n    from mqe_jax.envs import make\n")
    (package / "envs").mkdir()
    (package / "envs" / "__init__.py").write_text("")
    monkeypatch.setattr(architecture, "ROOT", tmp_path)
    monkeypatch.setattr(architecture, "PACKAGE", package)
    assert architecture.violations() == ["mqe_jax/train/__init__.py: train may not import envs"]


def test_fields_are_documented_by_the_docstring_under_them() -> None:
    """The other style, a section of the class's docstring, is not used."""
    files = [*architecture.PACKAGE.rglob("*.py"), *(architecture.ROOT / "examples").glob("*.py")]
    assert len(files) > 80
    assert [path.name for path in files if "    Attributes:" in path.read_text(encoding="utf-8")] == []


def test_the_soak_is_asked_for_in_one_place() -> None:
    """Only tests/conftest.py reads MQE_SOAK; a test that should be longer in the soak is a parameter marked `soak`."""
    files = [path for path in Path(__file__).parent.glob("*.py") if path != Path(__file__)]
    assert [path.name for path in files if "MQE_SOAK" in path.read_text(encoding="utf-8")] == ["conftest.py"]
