"""Files and folders: atomic writes, write checks, locks."""

from __future__ import annotations

import contextlib
import fcntl
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from mqe_jax.errors import InputError, InUseError


def write_atomically(path: Path, content: bytes) -> None:
    """Writes a file atomically: under a temporary name in the same folder, flushed to disk, then renamed."""
    handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


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
