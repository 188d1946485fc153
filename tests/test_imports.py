"""Modules import only from those above them in the table of docs/architecture.md."""

from __future__ import annotations

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "mqe_jax"


def modules_of(tree: ast.AST) -> set[str]:
    """Returns the modules of this package that a source file imports, at any nesting depth."""
    names = [f"{n.module}.{a.name}" for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) for a in n.names]
    names += [alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names]
    return {name.split(".")[1] for name in names if name.startswith("mqe_jax.")}


def wrong_imports(package: Path, order: list[str]) -> list[str]:
    """Returns the imports of a package's modules from modules that are not before them."""
    wrong = []
    for path in sorted(package.rglob("*.py")):
        if path == package / "__init__.py":
            continue
        module = path.relative_to(package).parts[0].removesuffix(".py")
        others = modules_of(ast.parse(path.read_text(encoding="utf-8"))) - {module}
        above = order[: order.index(module)] if module in order else []
        wrong += [f"{path.relative_to(package)}: {module} may not import {x}" for x in sorted(others - {*above})]
    return wrong


def test_imports_follow_the_table_of_modules() -> None:
    """The table names every module, each after those that it imports."""
    order = re.findall(r"^\| `(\w+)", (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8"), re.MULTILINE)
    modules = {path.stem for path in PACKAGE.glob("*.py")} | {
        path.parent.name for path in PACKAGE.glob("*/__init__.py")
    }
    assert sorted(order) == sorted(modules - {"__init__"})
    assert wrong_imports(PACKAGE, order) == []


def test_a_wrong_import_is_named(tmp_path: Path) -> None:
    """An import of a module further down is found, also inside a function, and reported with its file."""
    (tmp_path / "train").mkdir()
    (tmp_path / "train" / "late.py").write_text("def late():\n    from mqe_jax.envs import make\n")
    (tmp_path / "envs.py").write_text("from mqe_jax import train\nimport mqe_jax.train.late\n")
    assert wrong_imports(tmp_path, ["train", "envs"]) == ["train/late.py: train may not import envs"]


def test_the_learner_imports_no_learning_library() -> None:
    for path in (PACKAGE / "train").glob("*.py"):
        assert not re.search(r"^\s*(import|from) (flax|optax|brax|torch)\b", path.read_text(), re.MULTILINE), path
