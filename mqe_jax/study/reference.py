"""Values that a report compares with, such as those of a paper, and the names and order of its cells."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field
from pathlib import Path
from typing import Any

from mqe_jax.errors import InputError
from mqe_jax.settings import build, load_yaml, record


@record
class Reference:
    """Reference values by cell, and the titles and order of variants, tasks and algorithms in figures and tables."""

    label: str = "reference"
    """What the values are, in the legend of figures."""
    values: Mapping[str, Any] = field(default_factory=dict)
    """Variant -> task -> algorithm -> average step reward."""
    variants: Mapping[str, Any] = field(default_factory=dict)
    """Titles of variants, in their order; others follow."""
    tasks: Mapping[str, Any] = field(default_factory=dict)
    """Titles of tasks, in their order; others follow."""
    algorithms: tuple[str, ...] = ()
    """Algorithms in their order; others follow."""

    def value(self, variant: str, task: str, algorithm: str) -> float | None:
        """Returns the reference value of a cell, or None."""
        return self.values.get(variant, {}).get(task, {}).get(algorithm)


def load_reference(path: Path) -> Reference:
    """Reads a YAML file with the fields of `Reference`.

    Raises:
        InputError: naming the file, for invalid content.
    """
    try:
        return build(Reference, load_yaml(path))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
