"""What the panel shows besides plots: robots by colour, reward terms as bars, an observation by blocks."""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from mqe_jax.appearance import ROBOT_COLOR_NAMES, ROBOT_COLORS
from mqe_jax.viz.geometry import robot_bases, robot_color


def robot_labels(model: mujoco.MjModel) -> list[str]:
    """Returns `robot 1 (blue)`, ... for all robots of a rendering model, by the nearest of the agents' colours."""
    shown = np.array([robot_color(model, trunk) for trunk in robot_bases(model)])
    apart = np.linalg.norm(shown[:, None] - np.array(ROBOT_COLORS), axis=-1)
    return [f"robot {i + 1} ({ROBOT_COLOR_NAMES[nearest]})" for i, nearest in enumerate(apart.argmin(axis=1))]


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
