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
_WIDTH = 78  # characters of a matrix's line, after the number of its row


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


def grid(cells: NDArray[np.str_]) -> Iterator[str]:
    """Yields the lines of a matrix of texts (P, P) with numbered rows and columns."""
    width = 2 + max(map(len, cells.flat))
    step = _WIDTH // width
    for start in range(0, len(cells), step):
        shown = range(start, min(start + step, len(cells)))
        yield "  " + "".join(f"{column + 1:{width}}" for column in shown)
        for row in range(len(cells)):
            yield f"{row + 1:>2}" + "".join(f"{cells[row, j]:>{width}}" for j in shown).rstrip()


def write_table(file: Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Writes a CSV file, atomically."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([header, *rows])
    write_atomically(file, text.getvalue().encode())


def draw(
    names: Sequence[str],
    shares: NDArray[Any],
    cells: NDArray[np.str_],
    title: str,
    path: Path,
    *,
    least: float = 0.0,
) -> None:
    """Draws texts (P, P) on the colours of shares from `least` to 1, atomically."""
    from matplotlib.figure import Figure

    size = 2.6 + 0.6 * len(names)
    figure = Figure((size + 0.8, size), dpi=120, layout="constrained")
    axes = figure.add_subplot()
    image = axes.imshow(shares, cmap="Blues" if least == 0 else "RdBu", vmin=least, vmax=1)
    for (row, column), text in np.ndenumerate(cells):
        ink = "black" if np.mean(image.to_rgba(shares[row, column])[:3]) > 0.5 else "white"
        axes.text(column, row, text, ha="center", va="center", fontsize=9, color=ink)
    shown = [to_label(shorten(name)) for name in names]
    axes.set_xticks(range(len(names)), shown, rotation=45, ha="right")
    axes.set_yticks(range(len(names)), shown)
    figure.suptitle(title, fontsize=10)
    with replacing(path) as temporary:
        figure.savefig(temporary)
