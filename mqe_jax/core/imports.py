"""A user's files and modules that register tasks, robots, sensors, networks or algorithms."""

import importlib
import importlib.util
import os
import shlex
import sys
import traceback
from collections.abc import Iterable
from pathlib import Path

from mqe_jax.core.errors import InputError, brief

IMPORTED: list[str] = []
"""What `add` has imported, as it was named. Policies record it: a name, which nothing runs."""


def add(name: str) -> None:
    """Imports a Python file or a module, once.

    A file's folder joins the end of Python's search path, for modules beside it.

    InputError naming the file or module, and the line of an error in it.
    """
    path = Path(name).resolve()
    file = path.suffix == ".py" or os.sep in name or name.startswith(".")
    if file and not path.is_file():
        raise InputError(f"import: no file {name!r}")
    try:
        if file:
            _import_file(path)
        elif not getattr(importlib.import_module(name), "__file__", True):
            raise InputError("a folder without __init__.py; name a module in it")
    except (Exception, SystemExit) as error:
        if isinstance(error, ModuleNotFoundError) and error.name == name:
            hint = f"; did you mean {path.name}.py?" if Path(f"{path}.py").is_file() else ""
            raise InputError(f"import: no module {name!r}{hint}") from None
        raise InputError(f"import: {name}: {reason(error)}") from None
    if name not in IMPORTED:
        IMPORTED.append(name)


def _import_file(path: Path) -> None:
    """Imports a file under the name that Python would find it by, once in a process."""
    folder = path.parent
    parts = [] if path.name == "__init__.py" else [path.stem]
    while (folder / "__init__.py").is_file():
        parts.insert(0, folder.name)
        folder = folder.parent
    if str(folder) not in sys.path:
        sys.path.append(str(folder))
    name = ".".join(parts)
    known = sys.modules.get(name)
    if known is not None and Path(getattr(known, "__file__", None) or "").resolve() == path:
        return
    if known is not None or name in sys.stdlib_module_names:
        raise InputError(f"{name} is the name of another module; rename the file")
    if len(parts) > 1:
        importlib.import_module(".".join(parts[:-1]))
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    sys.modules[name] = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(sys.modules[name])
    except BaseException:
        del sys.modules[name]
        raise


def needed(kind: type) -> list[str]:
    """Returns what `mqe` imports to know a class: what this process did, or the class's file."""
    file = getattr(sys.modules[kind.__module__], "__file__", None)
    if IMPORTED or file is None or Path(file).is_relative_to(Path(__file__).parents[1]):
        return [*IMPORTED]
    return [os.path.relpath(file)]


def reason(error: BaseException) -> str:
    """Returns why an import failed: the error, and the first line of a user's file."""
    text = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
    own = (str(Path(__file__).parents[1]), str(Path(importlib.__file__).parent), "<frozen")
    for frame in traceback.extract_tb(error.__traceback__):
        if not frame.filename.startswith(own):
            return f"{text} ({Path(frame.filename).name}, line {frame.lineno})"
    return text


def flags(names: Iterable[str]) -> str:
    """Returns the flags with which `mqe` imports names, for messages."""
    return brief(" ".join(f"--import {shlex.quote(name)}" for name in names))
