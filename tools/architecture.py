"""The modules of `mqe_jax`, their allowed imports, and the import diagram docs/architecture.svg.

`python tools/architecture.py` draws the diagram from the imports in the source, and exits with 1 if one violates the
layering. tests/test_architecture.py fails too if the diagram is out of date.
"""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "mqe_jax"
PICTURE = ROOT / "docs" / "architecture.svg"

# Layers from bottom to top, each a row of modules. A module may import from lower layers and from modules to its left.
LAYERS: tuple[tuple[str, ...], ...] = (
    ("errors", "interrupts", "files", "settings"),
    ("collision", "rotation", "robots"),
    ("terrain", "objects", "npc"),
    ("scene", "engines"),
    ("skills", "walk_policy", "actuators", "control"),
    ("envs", "train"),
    ("planners", "walk"),
    ("policies", "opponents", "demonstrations"),
    ("study", "viz", "view", "export", "adapters"),
    ("cli",),
)
# Horizontal position of each module in the diagram, from 0 (left) to 1 (right).
ACROSS = {
    "settings": 0.12, "errors": 0.37, "interrupts": 0.62, "files": 0.87,
    "rotation": 0.86, "collision": 0.3, "robots": 0.58, "terrain": 0.12,
    "objects": 0.33, "npc": 0.53, "scene": 0.3, "engines": 0.7, "skills": 0.1,
    "walk_policy": 0.35, "actuators": 0.62, "control": 0.88, "envs": 0.25, "train": 0.9,
    "planners": 0.34, "walk": 0.62, "policies": 0.3, "opponents": 0.6, "demonstrations": 0.88,
    "study": 0.08, "viz": 0.27, "view": 0.46, "export": 0.65,
    "adapters": 0.84, "cli": 0.5,
}  # fmt: skip
# Stricter exceptions to the rule above. The trainer does not depend on tasks, robots or physics.
ONLY: dict[str, frozenset[str]] = {"train": frozenset({"errors", "interrupts", "files", "settings"})}


def modules() -> list[str]:
    """Returns the names of the package's modules and subpackages, without `__init__`."""
    found = {path.stem for path in PACKAGE.glob("*.py")} | {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    return sorted(found - {"__init__"})


def allowed(module: str) -> frozenset[str]:
    """Returns the modules that `module` may import."""
    if module in ONLY:
        return ONLY[module]
    order = [name for layer in LAYERS for name in layer]
    return frozenset(order[: order.index(module)])


def imports(path: Path) -> set[str]:
    """Returns the modules of this package that a source file imports, at any nesting depth."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module == "mqe_jax":
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("mqe_jax."):
            found.add(str(node.module).split(".")[1])
        elif isinstance(node, ast.Import):
            found |= {alias.name.split(".")[1] for alias in node.names if alias.name.startswith("mqe_jax.")}
    return found


def edges() -> dict[str, dict[str, str]]:
    """Returns, for each module, the modules that it imports, with one importing file."""
    table: dict[str, dict[str, str]] = {}
    for module in modules():
        single = PACKAGE / f"{module}.py"
        for path in [single] if single.is_file() else sorted((PACKAGE / module).rglob("*.py")):
            for other in sorted(imports(path) - {module}):
                table.setdefault(module, {}).setdefault(other, path.relative_to(ROOT).as_posix())
    return table


def violations() -> list[str]:
    """Returns imports that violate the layering, each with its file, and modules without a layer."""
    known = {name for layer in LAYERS for name in layer}
    wrong = [f"{module}: has no layer in tools/architecture.py" for module in modules() if module not in known]
    for module, others in edges().items():
        if module in known:
            wrong += [f"{path}: {module} may not import {o}" for o, path in others.items() if o not in allowed(module)]
    return wrong


def reduced(table: dict[str, dict[str, str]]) -> dict[str, set[str]]:
    """Returns the transitive reduction of the imports, for the diagram."""

    def reach(module: str) -> set[str]:
        return {module}.union(*(reach(other) for other in table.get(module, {})))

    return {
        module: {o for o in others if not any(o in reach(between) for between in others if between != o)}
        for module, others in table.items()
    }


def draw() -> str:
    """Returns the diagram as SVG text: layers as rows, imports as lines from the importing module to the imported."""
    width, row, box = 860, 76, 132
    height = row * len(LAYERS) + 20
    levels = {name: level for level, layer in enumerate(LAYERS) for name in layer}
    place = {n: (width * ACROSS[n], height - row * (levels[n] + 0.5) - 10) for n in modules()}
    lines, boxes = [], []
    for module, others in sorted(reduced(edges()).items()):
        for other in sorted(others):
            (x1, y1), (x2, y2) = place[module], place[other]
            if y1 == y2:
                side = 1 if x2 > x1 else -1
                way = f"M{x1 + side * box / 2:.0f},{y1:.0f} L{x2 - side * box / 2:.0f},{y2:.0f}"
            else:
                middle = (y1 + y2) / 2
                way = f"M{x1:.0f},{y1 + 15:.0f} C{x1:.0f},{middle:.0f} {x2:.0f},{middle:.0f} {x2:.0f},{y2 - 15:.0f}"
            lines.append(f'<path d="{way}" fill="none" stroke="#8a8f99" marker-end="url(#a)"/>')
    for name, (x, y) in sorted(place.items()):
        single = (PACKAGE / f"{name}.py").is_file()
        label, fill = (f"{name}.py", "#f4f5f7") if single else (f"{name}/", "#dfeaf8")
        boxes.append(
            f'<rect x="{x - box / 2:.0f}" y="{y - 15:.0f}" width="{box}" height="30" rx="5" fill="{fill}" '
            f'stroke="#23252b"/><text x="{x:.0f}" y="{y + 5:.0f}" text-anchor="middle">{label}</text>'
        )
    head = f'''<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" \
font-family="monospace" font-size="14" fill="#23252b">
<defs><marker id="a" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">\
<path d="M0,0 L8,4 L0,8 z" fill="#8a8f99"/></marker></defs>
<rect width="{width}" height="{height}" fill="white"/>'''
    return "\n".join([head, *lines, *boxes, "</svg>"]) + "\n"


def main() -> int:
    """Draws the diagram; returns the exit status."""
    wrong = violations()
    PICTURE.write_text(draw(), encoding="utf-8")
    print("\n".join(wrong) or "all imports respect the layering")
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
