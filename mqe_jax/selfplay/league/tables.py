"""Results of tournaments as text at most 80 columns wide, CSV files and pictures."""

import csv
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mqe_jax.core.files import replacing, write_atomically
from mqe_jax.core.literal import line, to_label

NAME = 28
"""Characters of a policy's name that are shown, at most."""
_COLUMNS = 15  # of a matrix that fit into a line


def shorten(name: str) -> str:
    """Returns a name on one line; of a long one the end, which names a run."""
    name = line(name)
    return name if len(name) <= NAME else f"...{name[3 - NAME :]}"


def table(columns: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """Yields the lines of a table with numbered rows, from its columns by header.

    The first column is aligned to the left.
    """
    every = [[name, *column] for name, column in columns.items()]
    sides = ["<", *">" * len(every)]
    padded = [
        [f"{text:{side}{max(map(len, x))}}" for text in x]
        for side, x in zip(sides, every, strict=False)
    ]
    for number, row in enumerate(zip(*padded, strict=True)):
        yield " ".join([f"{number or '':>2}", *row]).rstrip()


def grid(values: NDArray[Any], form: str, *, diagonal: bool = True) -> Iterator[str]:
    """Yields the lines of a matrix (P, P) with numbered rows and columns."""
    for start in range(0, len(values), _COLUMNS):
        shown = range(start, min(start + _COLUMNS, len(values)))
        yield "  " + "".join(f"{column + 1:5}" for column in shown)
        for row in range(len(values)):
            cells = (format(values[row, j], form) if diagonal or row != j else "" for j in shown)
            yield f"{row + 1:>2}" + "".join(f"{cell:>5}" for cell in cells).rstrip()


def write_table(file: Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Writes a CSV file, atomically."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([header, *rows])
    write_atomically(file, text.getvalue().encode())


def draw(
    names: Sequence[str],
    shares: NDArray[Any],
    title: str,
    path: Path,
    *,
    least: float = 0.0,
    diagonal: bool = True,
) -> None:
    """Draws shares (P, P) from `least` to 1 in percent, rows against columns, atomically."""
    from matplotlib.figure import Figure

    size = 2.6 + 0.6 * len(names)
    figure = Figure((size + 0.8, size), dpi=120, layout="constrained")
    axes = figure.add_subplot()
    axes.imshow(shares, cmap="RdYlGn", vmin=least, vmax=1)
    for (row, column), value in np.ndenumerate(shares):
        if diagonal or row != column:
            text = format(100 * value + 0.0, ".0f" if least == 0 else "+.0f")
            axes.text(column, row, text, ha="center", va="center", fontsize=9)
    shown = [to_label(shorten(name)) for name in names]
    axes.set_xticks(range(len(names)), shown, rotation=45, ha="right")
    axes.set_yticks(range(len(names)), shown)
    figure.suptitle(title, fontsize=10)
    with replacing(path) as temporary:
        figure.savefig(temporary)
