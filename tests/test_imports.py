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


def test_imports_follow_the_table_of_modules() -> None:
    """The table names every module, each after those that it imports."""
    order = re.findall(r"^\| `(\w+)", (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8"), re.MULTILINE)
    modules = {path.stem for path in PACKAGE.glob("*.py")} | {
        path.parent.name for path in PACKAGE.glob("*/__init__.py")
    }
    assert sorted(order) == sorted(modules - {"__init__"})
    for path in {*PACKAGE.rglob("*.py")} - {PACKAGE / "__init__.py"}:
        module = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        above = {*order[: order.index(module) + 1]}
        assert modules_of(ast.parse(path.read_text(encoding="utf-8"))) <= above, path


def test_networks_and_optimisers_are_our_own() -> None:
    for path in PACKAGE.rglob("*.py"):
        assert not re.search(r"^\s*(import|from) (flax|optax)\b", path.read_text(encoding="utf-8"), re.MULTILINE), path
