"""Rooms import only from those above them in the table of docs/architecture.md."""

import ast
import graphlib
import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "mqe_jax"
CHECKING = {
    "adapters",
    "adapters.brax",
    "adapters.gymnasium",
    "adapters.jaxmarl",
    "adapters.opponent",
    "adapters.pettingzoo",
    "envs",
    "envs.autoreset",
    "envs.base",
    "envs.registry",
    "export.robot_team",
    "names",
    "policies.simple",
    "runs.cast",
    "runs.exploiting",
    "runs.learning",
    "runs.playing",
    "runs.real_time",
    "runs.recording",
    "runs.stress",
    "runs.sweeping",
    "runs.throughput",
    "selfplay.league.crossplay",
    "selfplay.league.tournament",
    "selfplay.opponents",
    "testing",
    "train.algorithms",
    "train.policy",
    "walk.evaluation",
    "walk.training",
}
"""Modules that may use `checked`."""


def modules() -> dict[str, Path]:
    """Returns the source files by module, without the package's own name."""
    paths = {path.relative_to(PACKAGE).with_suffix(""): path for path in PACKAGE.rglob("*.py")}
    return {
        ".".join(parts.parts).removesuffix(".__init__"): path
        for parts, path in paths.items()
        if len(parts.parts)
    }


def imported(path: Path, names: set[str]) -> set[str]:
    """Returns the modules of this package that a source file imports, at any nesting depth."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("mqe_jax"):
            base = (node.module or "").removeprefix("mqe_jax").removeprefix(".")
            for alias in node.names:
                full = f"{base}.{alias.name}" if base else alias.name
                found.add(full if full in names else base)
        elif isinstance(node, ast.Import):
            found |= {
                alias.name.removeprefix("mqe_jax.")
                for alias in node.names
                if alias.name.startswith("mqe_jax.")
            }
    return found - {""}


def test_rooms_import_from_those_above() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    cells = re.findall(r"^\| (`\w+(?:/|\.py)`[^|]*)\|", text, re.MULTILINE)
    rows = [re.findall(r"`(\w+)(?:/|\.py)`", cell) for cell in cells]
    order = {name: place for place, names in enumerate(rows) for name in names}
    every = modules()
    assert order.keys() == {name.split(".")[0] for name in every} - {"__init__"}
    for name, path in every.items():
        if name != "__init__":
            above = {room for room, place in order.items() if place <= order[name.split(".")[0]]}
            assert {module.split(".")[0] for module in imported(path, {*every})} <= above, name


def test_only_skills_know_how_many_joints_a_quadruped_has() -> None:
    every = modules()
    room = "physics.robots.quadruped"
    users = {name for name, path in every.items() if room in imported(path, {*every})}
    own = {name for name in users if not name.startswith(("walk", "skills."))}
    assert own == {"physics.robots.go1", "physics.robots.go2"}


def test_commands_do_not_import_each_other() -> None:
    every = {name: path for name, path in modules().items() if name.startswith("cli")}
    graph = {name: imported(path, {*every}) & every.keys() - {name} for name, path in every.items()}
    graphlib.TopologicalSorter(graph).prepare()


def test_networks_and_optimisers_are_our_own() -> None:
    for path in PACKAGE.rglob("*.py"):
        assert not re.search(
            r"^\s*(import|from) (flax|optax)\b", path.read_text(encoding="utf-8"), re.MULTILINE
        ), path


def test_the_wheel_has_no_experiments_and_the_package_imports_none() -> None:
    setuptools = pytest.importorskip("setuptools")
    find = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["setuptools"]
    shipped = setuptools.find_namespace_packages(str(ROOT), **find["packages"]["find"])
    assert {name.split(".")[0] for name in shipped} == {"mqe_jax"}
    for path in PACKAGE.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"^\s*(import|from) (lab|tools|tests)\b", text, re.MULTILINE), path


def test_public_modules_alone_check_arguments() -> None:
    """Input is checked where it comes in: the names of the package, registries, adapters."""
    users = {
        name
        for name, path in modules().items()
        if re.search(r"^ *@checked$", path.read_text(encoding="utf-8"), re.MULTILINE)
    }
    assert users == CHECKING
