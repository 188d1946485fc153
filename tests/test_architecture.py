"""The order of modules in docs/architecture.md, in which imports go up, and conventions of the source."""

import ast
import re
import subprocess
import sys
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


def test_the_learner_imports_no_task_and_no_learning_library() -> None:
    forbidden = {"flax", "optax", "brax", "torch"}
    for path in (PACKAGE / "train").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            for name in names:
                assert name.split(".")[0] not in forbidden, path
                assert not name.startswith(
                    ("mqe_jax.envs", "mqe_jax.adapters", "mqe_jax.cli", "mqe_jax.cli.commands")
                ), path


def test_fields_are_documented_by_the_docstring_under_them() -> None:
    """The other style, a section of the class's docstring, is not used."""
    files = [*PACKAGE.rglob("*.py"), *(ROOT / "examples").glob("*.py")]
    assert len(files) > 80
    assert [path.name for path in files if "    Attributes:" in path.read_text(encoding="utf-8")] == []


def test_the_soak_is_asked_for_in_one_place() -> None:
    """Only tests/conftest.py reads MQE_SOAK; a test that should be longer in the soak is a parameter marked `soak`."""
    files = [path for path in Path(__file__).parent.glob("*.py") if path != Path(__file__)]
    assert [path.name for path in files if "MQE_SOAK" in path.read_text(encoding="utf-8")] == ["conftest.py"]


def test_importing_and_listing_the_tasks_print_no_warnings() -> None:
    """Such as MJX's note that Warp is missing; Python's own warnings are errors."""
    code = "import mqe_jax; mqe_jax.tasks(); import sys; from mqe_jax.cli import main; sys.exit(main(['tasks']))"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert done.stderr == "" and "Failed" not in done.stdout
    first, *_, last = done.stdout.splitlines()
    assert first.startswith("The tasks with their default parameters") and last.startswith("actions per agent")
    rows = {line.split()[0]: line.split() for line in done.stdout.splitlines() if line.startswith("go1")}
    assert rows["go1gate"][-1] == "shipped" and rows["go1plane"][-1] == "none"
    assert rows["go1football-2vs2"][5:8] == ["2", "vs", "2"]
