"""Output of the commands: the `--json` object and tables on standard output, messages on standard error."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator, Mapping
from typing import Any, TextIO


def echo(text: str) -> None:
    """Prints a line to standard error."""
    print(text, file=sys.stderr, flush=True)


def print_table(values: Mapping[str, Any]) -> None:
    """Prints one name and value per line."""
    flat = {}
    for name, value in values.items():
        flat.update({f"reward/{n}": v for n, v in value.items()} if isinstance(value, Mapping) else {name: value})
    for name, value in flat.items():
        print(f"{name:<28} {value:.4g}" if isinstance(value, float) else f"{name:<28} {value}")


@contextlib.contextmanager
def standard_output(*, reserved: bool) -> Iterator[TextIO]:
    """Yields a file that writes to standard output.

    With `reserved`, everything else that is written to standard output meanwhile, also by C code, goes to standard
    error, so that the `--json` object is the only output.
    """
    if not reserved:
        yield sys.stdout
        return
    sys.stdout.flush()
    real = os.dup(1)
    try:
        os.dup2(2, 1)
        with contextlib.redirect_stdout(sys.stderr), os.fdopen(os.dup(real), "w", encoding="utf-8") as file:
            yield file
    finally:
        os.dup2(real, 1)
        os.close(real)
