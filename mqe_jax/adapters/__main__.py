"""`python -m mqe_jax.adapters SCRIPT [ARGUMENT...]` runs a script of another library in which the tasks are registered.

The script creates a task by the `make` of its library: `ENV_NAME=go1gate` for the baselines of JaxMARL.
"""

from __future__ import annotations

import importlib
import runpy
import sys
from pathlib import Path

from mqe_jax.core.errors import InputError

LIBRARIES = ("gymnasium", "pettingzoo", "brax", "jaxmarl")


def register() -> list[str]:
    """Registers the tasks with every installed library; returns their names."""
    found = []
    for library in LIBRARIES:
        try:
            importlib.import_module(f"mqe_jax.adapters.{library}")
        except InputError:
            continue
        found.append(library)
    return found


def main(arguments: list[str]) -> None:
    """Runs the script, the first argument, with the others as its own."""
    if not arguments or not Path(arguments[0]).is_file():
        given = repr(arguments[0]) if arguments else "none"
        print(f"SCRIPT: {given}; expected a Python file: python -m mqe_jax.adapters SCRIPT ...", file=sys.stderr)
        raise SystemExit(2)
    register()
    script = Path(arguments[0]).resolve()
    sys.argv = [str(script), *arguments[1:]]
    sys.path.insert(0, str(script.parent))
    runpy.run_path(str(script), run_name="__main__")


if __name__ == "__main__":
    main(sys.argv[1:])
