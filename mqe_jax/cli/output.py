"""Output of the commands."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any


def say(text: str) -> None:
    """Prints a line to standard error."""
    print(text, file=sys.stderr, flush=True)


def print_table(values: Mapping[str, Any]) -> None:
    """Prints one name and value per line."""
    flat = {}
    for name, value in values.items():
        flat.update({f"reward/{n}": v for n, v in value.items()} if isinstance(value, Mapping) else {name: value})
    for name, value in flat.items():
        print(f"{name:<28} {value:.4g}" if isinstance(value, float) else f"{name:<28} {value}")
