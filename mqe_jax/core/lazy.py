"""Objects that are imported when they are first used."""

import importlib
from typing import Any


def load(path: str) -> Any:
    """Imports and returns the object MODULE:NAME, such as `mqe_jax.train.mat:network`."""
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(module), name)
