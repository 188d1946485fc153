"""Counts the statements of Python files: `python tools/size.py mqe_jax tests lab`.

It prints a folder a line. A docstring counts nothing. `a, b = x, y` counts as two statements, and a
walrus counts as an assignment, so packing statements into one line does not make code smaller.
"""

import argparse
import ast
from pathlib import Path


def statements(source: str) -> int:
    """Return the number of statements in Python source."""
    return sum(_weight(node) for node in ast.walk(ast.parse(source)))


def _weight(node: ast.AST) -> int:
    if isinstance(node, ast.NamedExpr):
        return 1
    if not isinstance(node, ast.stmt) or _is_docstring(node):
        return 0
    if isinstance(node, ast.Assign):
        return _parts(node)
    return 1


def _is_docstring(node: ast.AST) -> bool:
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


def _parts(node: ast.Assign) -> int:
    target = node.targets[-1]
    if isinstance(target, ast.Tuple | ast.List) and isinstance(node.value, ast.Tuple | ast.List):
        return len(target.elts)
    return 1


def main() -> None:
    """Print the statements of each folder, and those of its subfolders."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--each", action="store_true", help="also print each room or file")
    arguments = parser.parse_args()
    for folder in arguments.folders:
        counts: dict[str, int] = {}
        for file in sorted(folder.rglob("*.py")):
            room = file.relative_to(folder).parts[0]
            counts[room] = counts.get(room, 0) + statements(file.read_text(encoding="utf-8"))
        if arguments.each:
            for room, count in counts.items():
                print(f"{count:6,} {folder}/{room}")
        print(f"{sum(counts.values()):6,} {folder}")


if __name__ == "__main__":
    main()
