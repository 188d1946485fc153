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
    file = path.suffix == ".py" or os.sep in name
    if file and not path.is_file():
        raise InputError(f"import: no file {name!r}")
    try:
        importlib.import_module(_module_of(path) if file else name)
    except (Exception, SystemExit) as error:
        if isinstance(error, ModuleNotFoundError) and error.name == name:
            hint = f"; did you mean {path.name}.py?" if Path(f"{path}.py").is_file() else ""
            raise InputError(f"import: no module {name!r}{hint}") from None
        raise InputError(f"import: {name}: {reason(error)}") from None
    if name not in IMPORTED:
        IMPORTED.append(name)


def _module_of(path: Path) -> str:
    """Returns the name of a file's module, under which it is imported once in a process."""
    folder = path.parent
    parts = [] if path.name == "__init__.py" else [path.stem]
    while (folder / "__init__.py").is_file():
        parts.insert(0, folder.name)
        folder = folder.parent
    if str(folder) not in sys.path:
        sys.path.append(str(folder))
    module = ".".join(parts)
    spec = importlib.util.find_spec(module)
    found = spec and spec.origin
    if found is None or Path(found).resolve() != path:
        raise InputError(f"{module} is the name of another module, {found}; rename the file")
    return module


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
