"""Pictures of the documentation: at most 256 colours, of which the frequent ones are exact."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tools"))
import small_png  # noqa: E402


def decoded(content: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"), int)


def flat_with_soft_edges() -> Image.Image:
    """Four flat regions, and a row with hundreds of colours between two of them."""
    pixels = np.zeros((64, 600, 3), np.uint8)
    pixels[:20], pixels[20:40], pixels[40:, :300], pixels[40:, 300:] = (
        (10, 20, 31),
        (201, 99, 3),
        (4, 5, 6),
        (255, 0, 7),
    )
    pixels[20] = np.linspace((10, 20, 31), (201, 99, 243), 600).astype(np.uint8)
    return Image.fromarray(pixels)


def test_frequent_colors_are_exact_and_others_near() -> None:
    image = flat_with_soft_edges()
    content = small_png.small_png(image)
    before, after = np.asarray(image, int), decoded(content)
    rest = np.arange(64) != 20
    np.testing.assert_array_equal(after[rest], before[rest])
    assert np.abs(after - before).max() <= 16
    assert len(np.unique(before.reshape(-1, 3), axis=0)) > small_png.COLORS
    assert len(np.unique(after.reshape(-1, 3), axis=0)) <= small_png.COLORS
    assert small_png.small_png(Image.open(io.BytesIO(content))) == content


def test_few_colors_are_all_exact_and_a_file_never_grows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image = Image.fromarray(np.random.default_rng(0).integers(0, 6, (32, 32, 3)).astype(np.uint8))
    path = tmp_path / "image.png"
    image.save(path)
    small_png.main([str(path)])
    small = path.read_bytes()
    np.testing.assert_array_equal(decoded(small), np.asarray(image))
    small_png.main([str(path)])
    assert path.read_bytes() == small
    assert f"{len(small)} -> {len(small)} bytes" in capsys.readouterr().out


@pytest.mark.parametrize("path", sorted((ROOT / "docs").glob("*.png")), ids=lambda path: path.stem)
def test_pictures_of_the_documentation_are_stored_like_that(path: Path) -> None:
    assert Image.open(path).mode == "P"
