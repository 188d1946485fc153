"""Clips and images, written atomically: .mp4, .webp, .gif and .png."""

import itertools
import subprocess
from collections.abc import Iterable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from mqe_jax.core import files
from mqe_jax.core.errors import InputError
from mqe_jax.core.files import replacing
from mqe_jax.core.settings import fail

SUFFIXES = (".mp4", ".webp", ".gif", ".png")


def check_output(
    path: Path, *, fps: float | None = None, speed: float = 1.0, at: float | None = None
) -> Path:
    """Returns the path if it can be written, with options of `render_episode`; else InputError."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"output {str(path)!r}: the suffix must be one of {', '.join(SUFFIXES)}")
    unused: dict[str, float | None] = {"at": at}
    if suffix == ".png":
        unused = {"fps": fps, "speed": None if speed == 1.0 else speed}
    for name, value in unused.items():
        if value is not None:
            fail(name, value, f"left out for a {suffix} file")
    files.check_output(path)
    if suffix == ".mp4":
        try:
            import_module("imageio_ffmpeg")
        except ImportError:
            raise InputError(
                f"output {str(path)!r}: .mp4 needs imageio-ffmpeg "
                "(pip install 'mqe-jax[render]'); without it use .webp, .gif or .png"
            ) from None
    return path


def write_clip(path: Path, frames: Iterable[np.ndarray], fps: float) -> None:
    """Writes frames (H, W, 3) uint8 as .mp4, .webp, .gif or .png (the last frame), atomically."""
    file = check_output(path)
    suffix = file.suffix.lower()
    with replacing(file) as temporary:
        if suffix == ".mp4":
            _write_mp4(temporary, iter(frames), fps)
        else:
            _write_images(temporary, [Image.fromarray(frame) for frame in frames], suffix, fps)


def _write_mp4(path: Path, frames: Iterator[np.ndarray], fps: float) -> None:
    """Writes H.264 in yuv420p, which browsers and players support."""
    # A subprocess instead of a fork of this process, in which JAX's threads might hold locks.
    program = import_module("imageio_ffmpeg").get_ffmpeg_exe()
    first = next(frames)
    height = first.shape[0] // 2 * 2
    width = first.shape[1] // 2 * 2
    source = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {fps:g} -i -".split()
    encoding = "-c:v libx264 -crf 20 -pix_fmt yuv420p -movflags +faststart".split()
    command = [program, "-loglevel", "error", "-y", *source, *encoding, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdin is not None and process.stderr is not None
        try:
            for frame in itertools.chain([first], frames):
                process.stdin.write(np.ascontiguousarray(frame[:height, :width]).tobytes())
        except BrokenPipeError:
            pass  # reported below from ffmpeg's own message
        process.stdin.close()
        message = process.stderr.read().decode(errors="replace")
    if process.returncode:
        raise InputError(f"output: ffmpeg could not write the clip ({' '.join(message.split())})")


def _write_images(path: Path, images: list[Image.Image], suffix: str, fps: float) -> None:
    """Writes the last image as PNG, or all as a GIF or a WebP, which has about 40% of a GIF's size.

    A GIF has one palette and no dithering, for small files without flicker.
    """
    if suffix == ".png":
        images[-1].save(path)
        return
    # The slowest method, 6, takes twenty times as long for a file that is no smaller.
    options: dict[str, Any] = {"quality": 30, "method": 4, "minimize_size": True}
    if suffix == ".gif":
        sampled = images[:: max(1, len(images) // 6)][:8]
        sample = np.concatenate([np.asarray(image) for image in sampled])
        palette = Image.fromarray(sample).quantize(255, method=Image.Quantize.MEDIANCUT)
        images = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
        options = {"optimize": True}
    unit = 10 if suffix == ".gif" else 1  # of a duration, ms
    ends = unit * np.rint(np.arange(len(images) + 1) * 1000 / fps / unit)
    options["duration"] = np.diff(ends).astype(int).tolist()  # right in total
    images[0].save(path, save_all=True, append_images=images[1:], loop=0, **options)
