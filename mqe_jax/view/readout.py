"""What the panel shows besides plots: robots by colour, reward terms as bars, an observation by blocks."""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from mqe_jax.viz.geometry import robot_bases, robot_color

COLOURS = {
    "red": (0.84, 0.27, 0.27),
    "orange": (0.9, 0.5, 0.15),
    "yellow": (0.95, 0.85, 0.25),
    "green": (0.25, 0.68, 0.3),
    "blue": (0.18, 0.45, 0.84),
    "purple": (0.5, 0.35, 0.75),
    "white": (0.95, 0.95, 0.95),
    "grey": (0.5, 0.5, 0.5),
    "black": (0.05, 0.05, 0.05),
}


def colour_name(rgb: Sequence[float]) -> str:
    """Returns the name of the nearest of `COLOURS` to red, green and blue in [0, 1]."""
    return min(COLOURS, key=lambda name: float(np.sum((np.asarray(COLOURS[name]) - np.asarray(rgb[:3])) ** 2)))


def robot_labels(model: mujoco.MjModel) -> list[str]:
    """Returns `robot 1 (blue)`, ... for all robots of a rendering model."""
    trunks = robot_bases(model)
    return [f"robot {i + 1} ({colour_name(robot_color(model, trunk))})" for i, trunk in enumerate(trunks)]


def bars(names: Sequence[str], values: Sequence[float]) -> str:
    """Returns HTML with one bar per name, to the right for positive values and to the left for negative ones."""
    greatest = max([1e-9, *(abs(value) for value in values)])
    rows = []
    for name, value in zip(names, values, strict=True):
        width = 50 * abs(value) / greatest
        side, colour = ("left", "#3fae49") if value >= 0 else ("right", "#d64545")
        bar = f'<div style="position:absolute;{side}:50%;width:{width:.1f}%;height:100%;background:{colour}"></div>'
        rows.append(
            f'<div style="display:flex;font-size:11px;align-items:center"><span style="width:8.5em">'
            f'{html.escape(name)}</span><div style="position:relative;flex:1;height:10px;background:#8882">{bar}</div>'
            f'<span style="width:5em;text-align:right">{value:+.4f}</span></div>'
        )
    return f'<div style="padding:0 12px">{"".join(rows)}</div>'


def observation_table(layout: Any, obs: np.ndarray) -> str:
    """Returns Markdown with the values (O,) of an agent's observation by the blocks of its layout, or as one block."""
    if layout is None:
        parts = [("observation", obs)]
    else:
        parts = [(block.name, obs[layout.slice(block.name)]) for block in layout.blocks]
    rows = [f"| {name} | {' '.join(f'{x:.2f}' for x in values)} |" for name, values in parts]
    return "| block | values |\n|---|---|\n" + "\n".join(rows)
