"""`python -m mqe_jax.adapters SCRIPT [ARGUMENT...]` runs another library's script.

The tasks are registered in it.

The script creates a task by the `make` of its library: `ENV_NAME=go1gate` for the baselines of
JaxMARL.
"""

import contextlib
import importlib
import runpy
import sys
from pathlib import Path

from mqe_jax.core.errors import InputError

if __name__ == "__main__":
    if not sys.argv[1:] or not Path(sys.argv[1]).is_file():
        usage = "SCRIPT must be a Python file: python -m mqe_jax.adapters SCRIPT ..."
        sys.exit(f"{sys.argv[1:2]}: {usage}")
    for library in ("gymnasium", "pettingzoo", "brax", "jaxmarl"):
        with contextlib.suppress(InputError):  # not installed
            importlib.import_module(f"mqe_jax.adapters.{library}")
    sys.argv = sys.argv[1:]
    sys.path.insert(0, str(Path(sys.argv[0]).resolve().parent))
    runpy.run_path(sys.argv[0], run_name="__main__")
