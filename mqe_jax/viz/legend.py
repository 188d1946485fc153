"""The legend of a clip: which colours are the team's, the opponents' and those of scripted robots."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mqe_jax.viz.geometry import robot_bases, robot_color

_INK, _PAPER = (28, 32, 40), (246, 246, 242)


def entries(env: Any) -> list[tuple[str, list[tuple[int, ...]]]]:
    """Returns labels and the colours, 0 to 255, of their robots: teams in the order of `env.teams`, then others."""
    bases = robot_bases(env.mj_model)
    colors = [tuple(round(255 * part) for part in robot_color(env.mj_model, body)[:3]) for body in bases]
    names = ("team",) if len(env.teams) == 1 else ("team 0", "team 1")
    rows = [(name, [colors[agent] for agent in team]) for name, team in zip(names, env.teams, strict=True)]
    scripted = colors[sum(map(len, env.teams)) :]
    return [*rows, ("scripted", scripted)] if scripted else rows


def legend(env: Any, size: tuple[int, int]) -> Callable[[np.ndarray], np.ndarray]:
    """Returns a function that draws the legend into the lower left corner of a frame (H, W, 3) uint8.

    One robot alone needs none.
    """
    labels = entries(env)
    if sum(len(dots) for _, dots in labels) < 2:
        return lambda frame: frame
    unit = max(size[1] / 360, 0.6)
    font = ImageFont.load_default(13 * unit)
    width = sum(font.getlength(label) + unit * (14 * len(dots) + 16) for label, dots in labels)
    plate = Image.new("RGB", (round(width + 4 * unit), round(22 * unit)), _PAPER)
    draw, x, middle = ImageDraw.Draw(plate), 8 * unit, 11 * unit
    for label, dots in labels:
        for color in dots:
            draw.ellipse((x, middle - 5 * unit, x + 10 * unit, middle + 5 * unit), fill=color)
            x += 14 * unit
        draw.text((x, middle), label, fill=_INK, font=font, anchor="lm")
        x += font.getlength(label) + 16 * unit
    picture, gap = np.asarray(plate), round(8 * unit)

    def drawn(frame: np.ndarray) -> np.ndarray:
        height, width = (min(a, b - gap) for a, b in zip(picture.shape[:2], frame.shape[:2], strict=True))
        frame = frame.copy()
        frame[-gap - height : len(frame) - gap, gap : gap + width] = picture[:height, :width]
        return frame

    return drawn
