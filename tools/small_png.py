"""Stores pictures of the documentation with at most 256 colours: `python tools/small_png.py docs/TASK_ID.png ...`.

The `EXACT` most frequent colours stay as they are, which are those of nearly all pixels; the others, of anti-aliased
edges, become the nearest of the palette. A file that would not become smaller is left alone.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from mqe_jax.files import write_atomically

COLORS, EXACT = 256, 64


def small_png(image: Image.Image) -> bytes:
    """Returns an opaque image as PNG with a palette; without any change if it has at most `COLORS` colours."""
    pixels = np.asarray(image.convert("RGB"))
    colors, of_pixel, counts = np.unique(pixels.reshape(-1, 3), axis=0, return_inverse=True, return_counts=True)
    palette = colors
    if len(colors) > COLORS:
        order = np.argsort(-counts, kind="stable")
        others = Image.fromarray(colors[order[EXACT:]][None])
        reduced = others.quantize(COLORS - EXACT, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
        shades = np.array(reduced.getpalette(), np.uint8).reshape(-1, 3)[: COLORS - EXACT]
        palette = np.unique(np.concatenate([colors[order[:EXACT]], shades]), axis=0)
    distances = ((colors[:, None].astype(int) - palette[None]) ** 2).sum(axis=-1)
    used, nearest = np.unique(distances.argmin(axis=-1), return_inverse=True)
    small = Image.fromarray(nearest.astype(np.uint8)[of_pixel.reshape(pixels.shape[:2])])
    small.putpalette(palette[used].tobytes())
    content = io.BytesIO()
    small.save(content, format="png", optimize=True)
    return content.getvalue()


def main(paths: Sequence[str]) -> None:
    """Rewrites files in place and prints their sizes before and after."""
    for path in map(Path, paths):
        before = path.read_bytes()
        after = min(before, small_png(Image.open(io.BytesIO(before))), key=len)
        if after != before:
            write_atomically(path, after)
        print(f"{path}: {len(before)} -> {len(after)} bytes")


if __name__ == "__main__":
    main(sys.argv[1:])
