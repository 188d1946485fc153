"""HTML of the panel.

viser's Markdown renders HTML in a text, so this module escapes every text of the panel.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from mqe_jax.core.literal import to_html

_BOX = "padding:0 12px 10px;font-size:13px;overflow-wrap:anywhere"
_CELL = "padding:2px 4px;text-align:left;border-bottom:1px solid #8884"


def paragraph(text: str, strong: str = "") -> str:
    """Returns a paragraph that begins with the text `strong`, in bold."""
    return f'<div style="{_BOX}"><b>{to_html(strong)}</b> {to_html(text)}</div>'


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Returns a table of texts with a line of heads."""

    def cells(tag: str, texts: Sequence[str]) -> str:
        return "".join(f'<{tag} style="{_CELL}">{to_html(text)}</{tag}>' for text in texts)

    head_row = f"<thead><tr>{cells('th', head)}</tr></thead>"
    body = "".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    content = f"{head_row}<tbody>{body}</tbody>"
    return f'<div style="{_BOX}"><table style="border-collapse:collapse">{content}</table></div>'


def legend(colors: Mapping[str, tuple[float, float, float]]) -> str:
    """Returns labels, each after a dot of its colour, 0 to 1."""
    entries = []
    for label, color in colors.items():
        rgb = ",".join(str(int(255 * part)) for part in color)
        entries.append(f'<span style="color:rgb({rgb})">&#9679;</span> {to_html(label)}')
    return f'<div style="{_BOX}">{" &nbsp; ".join(entries)}</div>'


def bars(names: Sequence[str], values: Sequence[float]) -> str:
    """Returns one bar per name, to the right for positive values and to the left for others."""
    greatest = max([1e-9, *(abs(value) for value in values)])
    rows = []
    for name, value in zip(names, values, strict=True):
        width = 50 * abs(value) / greatest
        side, colour = ("left", "#3fae49") if value >= 0 else ("right", "#d64545")
        bar = (
            f'<div style="position:absolute;{side}:50%;width:{width:.1f}%;height:100%;'
            f'background:{colour}"></div>'
        )
        rows.append(
            '<div style="display:flex;font-size:11px;align-items:center">'
            f'<span style="width:8.5em">{to_html(name)}</span>'
            f'<div style="position:relative;flex:1;height:10px;background:#8882">{bar}</div>'
            f'<span style="width:5em;text-align:right">{value:+.4f}</span></div>'
        )
    return f'<div style="padding:0 12px">{"".join(rows)}</div>'


def observation_table(layout: Any, obs: np.ndarray) -> str:
    """Returns the values (O,) of an agent's observation by the blocks of its layout.

    Without a layout, they are one block.
    """
    if layout is None:
        parts = [("observation", obs)]
    else:
        parts = [(block.name, obs[layout.slice(block.name)]) for block in layout.blocks]
    rows = [(name, " ".join(f"{x:.2f}" for x in values)) for name, values in parts]
    return table(("block", "values"), rows)
