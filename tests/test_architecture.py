"""The direction of imports, and the picture of it."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))

import architecture


def test_every_import_goes_down() -> None:
    """No room imports a room above it, and the trainer knows no task, robot or physics."""
    assert architecture.violations() == []


def test_the_picture_is_drawn_from_the_present_imports() -> None:
    """docs/architecture.svg is what tools/architecture.py draws, and the page names every room."""
    assert architecture.PICTURE.read_text(encoding="utf-8") == architecture.draw()
    page = architecture.PICTURE.with_suffix(".md").read_text(encoding="utf-8")
    assert [room for room in architecture.rooms() if f"`{room}" not in page] == []


def test_a_wrong_import_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """An import upwards is found, also inside a function, and told with its file."""
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
