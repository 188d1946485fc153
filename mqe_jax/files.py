"""Files and folders: atomic writes, errors that name the file, write checks, locks."""

from __future__ import annotations

import contextlib
import fcntl
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from mqe_jax import interrupts
from mqe_jax.errors import InputError, InUseError

if TYPE_CHECKING:
    import numpy as np


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yields a temporary name in the same folder, with the same suffix, which is renamed to `path` at the end.

    The temporary file is removed if this fails, or a signal ends the process. An OSError names `path`.
    """
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    interrupts.temporaries.add(temporary)
    try:
        with naming(path):
            yield temporary
            os.replace(temporary, path)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        interrupts.temporaries.discard(temporary)


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Adds the file's name to an OSError, such as a full disk, which a write does not name."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from None


def write_atomically(path: Path, content: bytes) -> None:
    """Writes a file atomically: under a temporary name in the same folder, flushed to disk, then renamed."""
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def append(path: Path, content: bytes) -> None:
    """Appends to a file, which it creates where there is none; an OSError names it."""
    with naming(path), path.open("ab") as file:
        file.write(content)


def read_tensors(file: Path, what: str) -> dict[str, np.ndarray]:
    """Reads a safetensors file; an InputError says `what` it should be."""
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    try:
        return load_file(file)
    except SafetensorError as error:
        raise InputError(f"{what} {file}: not a safetensors file ({error})") from None


def check_folder(folder: Path, field: str = "run_dir") -> None:
    """Creates a folder, and raises an InputError that names the field if it cannot be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"{field}: {folder} cannot be written ({error.strerror or error})") from None


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Holds a lock on a folder; it is released when the process exits, even abnormally.

    Raises:
        InUseError: where another process (or this one) already holds it.
    """
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InUseError(f"run_dir: {folder} is in use by another process") from None
        yield
    finally:
        os.close(handle)
