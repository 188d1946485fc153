"""Files and folders: bounded readers, atomic writes, errors that name the file, locks.

The bounds are in `mqe_jax.core.limits`.
"""

import contextlib
import csv
import hashlib
import json
import os
import re
import secrets
import stat
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from mqe_jax.core import interrupts, limits
from mqe_jax.core.errors import InputError, InUseError, brief

if TYPE_CHECKING:
    import numpy as np


_TAGS = {
    f"tag:yaml.org,2002:{name}" for name in ("null", "bool", "int", "float", "str", "seq", "map")
}
LOCK = ".mqe.lock"
"""Name of the file that a process locks in a run folder."""
_locks: dict[Path, os.stat_result] = {}
"""Folders that this process has locked, with the lock file of each."""

# -- writers: below a locked folder they write only while the folder's path still leads to it


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yields a new file, which is renamed to `path` at the end.

    It has the suffix and the folder of `path`, which is created if missing. The file is removed if
    this fails, or a signal ends the process. An OSError names `path`.
    """
    temporary = path.with_name(f".mqe-{secrets.token_hex(8)}.tmp{path.suffix}")
    check_locks(path)
    interrupts.temporaries.add(temporary)
    try:
        with naming(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
            yield temporary
            check_locks(path)
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
    """Writes a file under a temporary name, flushes it to disk, and renames it."""
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def append(path: Path, content: bytes) -> None:
    """Appends to a file, which it creates if missing; an OSError names it, even for a link."""
    check_locks(path)

    def open_no_link(name: str, flags: int) -> int:
        return os.open(name, flags | getattr(os, "O_NOFOLLOW", 0), 0o666)

    with naming(path), open(path, "ab", opener=open_no_link) as file:
        file.write(content)


def make_folder(path: Path) -> None:
    """Creates a folder, if missing, in one that exists; an OSError names it."""
    check_locks(path)
    with naming(path):
        path.mkdir(exist_ok=True)


def check_locks(path: Path) -> None:
    """Raises an InputError if a locked folder around `path` was removed, renamed or replaced."""
    for folder in path.parents:
        if folder in _locks:
            with contextlib.suppress(OSError):
                if os.path.samestat((folder / LOCK).stat(), _locks[folder]):
                    continue
            raise InputError(
                f"run_dir: {folder} was removed, renamed or replaced; nothing more is written to it"
            )


# -- readers: every failure of a parser is an InputError that names the file


def digest(path: str | os.PathLike[str]) -> str:
    """Returns the SHA-256 of a file's content."""
    with open(path, "rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


def check_file(path: Path, limit: int) -> None:
    """Raises an InputError unless a path is a regular file of at most `limit` bytes."""
    try:
        status = path.stat()
    except (OSError, ValueError) as error:  # ValueError: a null byte
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise InputError(f"{path}: cannot be read ({reason})") from None
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{path}: cannot be read (not a regular file)")
    if status.st_size > limit:
        raise InputError(f"{path}: has {status.st_size} bytes; it must have at most {limit}")


@contextlib.contextmanager
def parsing(path: Path | str, what: str) -> Iterator[None]:
    """Turns what a parser raises for a damaged or hostile file into an InputError that names it."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        reason = brief(" ".join(str(error).split()) or type(error).__name__)
        raise InputError(f"{path}: damaged, or not {what} ({reason})") from None


def read_bytes(path: Path, limit: int) -> bytes:
    """Reads a file of at most `limit` bytes."""
    check_file(path, limit)
    with parsing(path, "a file that can be read"):
        return path.read_bytes()


def read_text(path: Path, limit: int, what: str) -> str:
    """Reads a UTF-8 file of at most `limit` bytes."""
    check_file(path, limit)
    with parsing(path, what):
        return path.read_text(encoding="utf-8")


def read_json(path: Path) -> Any:
    """Reads a JSON file."""
    return parse_json(read_text(path, limits.FILE_BYTES, "JSON"), str(path))


def parse_json(text: str, name: str) -> Any:
    """Returns the value of a JSON text; errors start with its name."""
    with parsing(name, "JSON"):
        return json.loads(text)


class _Loader(yaml.SafeLoader):
    """Loader of a text without aliases, foreign tags, dates, and names that are given twice.

    PyYAML itself keeps the last of two values of one name, and lets aliases make a few bytes as
    large as memory.
    """

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("aliases (*name) are not allowed")
        node: Any = super().compose_node(parent, index)
        if node.tag not in _TAGS:
            raise yaml.YAMLError(f"the tag {node.tag} is not allowed")
        number = node.tag.endswith((":int", ":float"))
        if number and re.search(r"^[-+]?0[0-7_]|:", node.value):
            node.tag = "tag:yaml.org,2002:str"  # 010 and 1:30, which YAML 1.1 reads as 8 and 90
        return node

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        names: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value in names:
                raise yaml.YAMLError(f"{key.value!r} is given twice")
            names.add(str(key.value))
        return super().construct_mapping(node, deep)


_Loader.yaml_implicit_resolvers = {  # without that of dates, which are texts
    letter: [(tag, pattern) for tag, pattern in resolvers if tag in _TAGS]
    for letter, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


def parse_yaml(text: str, name: str) -> Any:
    """Returns the value of a YAML text; an InputError starts with its name."""
    with parsing(name, "YAML"):
        if len(text) > limits.YAML_BYTES:
            raise ValueError(f"more than {limits.YAML_BYTES} characters")
        return yaml.load(text, _Loader)


def read_yaml(path: Path) -> Any:
    """Returns the value of a YAML file; an InputError names it."""
    return parse_yaml(read_text(path, limits.YAML_BYTES, "YAML"), str(path))


def read_rows(path: Path) -> Iterator[list[str]]:
    """Yields the rows of a CSV file, the columns' names first."""
    check_file(path, limits.FILE_BYTES)
    with parsing(path, "a CSV file"), path.open(encoding="utf-8", newline="") as file:
        yield from csv.reader(file, strict=True)


def split_bytes(array: "np.ndarray") -> "np.ndarray":
    """Returns float16 numbers as their low and their high bytes (2, ...), which a wheel's archive
    packs 6% smaller.
    """
    import numpy as np

    pairs = np.ascontiguousarray(array, np.float16)[..., None].view(np.uint8)
    return np.ascontiguousarray(np.moveaxis(pairs, -1, 0))


def read_tensors(file: Path, what: str) -> "dict[str, np.ndarray]":
    """Reads a safetensors file of finite floating-point weights, some perhaps by `split_bytes`.

    An InputError says `what` the file should be.
    """
    import numpy as np
    from safetensors.numpy import load_file

    check_file(file, limits.FILE_BYTES)
    with parsing(f"{what} {file}", "a safetensors file of finite floating-point numbers"):
        arrays = load_file(file)
        for name, array in arrays.items():
            if array.dtype == np.uint8 and array.shape[:1] == (2,):
                array = arrays[name] = np.moveaxis(array, 0, -1).copy().view(np.float16)[..., 0]
            if array.dtype.kind not in "fV" or not np.isfinite(array).all():  # V: bfloat16
                raise ValueError(f"{name} is not, dtype {array.dtype}")
        return arrays


def linear_layers(
    what: str, arrays: "Mapping[str, np.ndarray]", sizes: Mapping[str, tuple[int, int]]
) -> "dict[str, dict[str, np.ndarray]]":
    """Returns the float32 arrays LAYER.weight (outputs, inputs) and LAYER.bias (outputs,) by layer.

    `sizes` holds inputs and outputs of each layer. An InputError says what is wrong with `what`.
    """
    import numpy as np

    shapes: dict[str, tuple[int, ...]] = {}
    for layer, (n_in, n_out) in sizes.items():
        shapes |= {f"{layer}.weight": (n_out, n_in), f"{layer}.bias": (n_out,)}
    for name in (*shapes, *arrays):
        if name not in arrays:
            raise InputError(f"{what}: {name} is missing; expected {', '.join(shapes)}")
        if name not in shapes:
            raise InputError(f"{what}: {name} is not expected; expected {', '.join(shapes)}")
        shape = tuple(arrays[name].shape)
        if shape != shapes[name]:
            raise InputError(f"{what}: {name} has shape {shape}; expected {shapes[name]}")
        most = float(np.abs(arrays[name].astype(np.float64)).max())
        if most > limits.WEIGHT:
            raise InputError(
                f"{what}: {name} holds magnitudes to {most:g}; at most {limits.WEIGHT:g} is allowed"
            )
    return {
        layer: {
            part: np.asarray(arrays[f"{layer}.{part}"], np.float32) for part in ("weight", "bias")
        }
        for layer in sizes
    }


@contextlib.contextmanager
def archive(path: Path, limit: int, what: str) -> Iterator[zipfile.ZipFile]:
    """Opens a zip file of at most `limit` bytes, packed and unpacked.

    Errors while it is open are those of `parsing`.
    """
    check_file(path, limit)
    with parsing(path, what), zipfile.ZipFile(path) as opened:
        size = sum(member.file_size for member in opened.infolist())
        if size > limit:
            raise ValueError(f"its members have {size} bytes; at most {limit} are allowed")
        if any(member.flag_bits & 1 for member in opened.infolist()):
            raise ValueError("encrypted")
        yield opened


def user_cache() -> Path:
    """Returns this package's folder in the user's cache; an InputError without a home folder."""
    try:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError:
        raise InputError(
            "XDG_CACHE_HOME: is missing, and there is no home folder; it must be a folder"
        ) from None
    return Path(home) / "mqe_jax"


def check_folder(folder: Path, field: str = "run_dir", file: Path | None = None) -> None:
    """Raises an InputError that names the field unless a folder can be created and written.

    With `file`, the folder must accept that file.
    """
    try:
        there = next(
            path for path in (folder, *folder.parents) if path.exists() or path.is_symlink()
        )
        with tempfile.TemporaryDirectory(prefix=".mqe-", dir=there) as inner:
            made = Path(inner, folder.relative_to(there))
            made.mkdir(parents=True, exist_ok=True)
            (made / (file.name if file is not None and file.name else ".probe")).touch()
    except (OSError, ValueError) as error:  # ValueError: a null byte
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{field}: {file or folder} cannot be written ({reason})") from None


def check_output(path: Path, field: str = "output") -> None:
    """Raises an InputError that names the field unless a file can be written.

    Its folder need not exist.
    """
    check_folder(path.parent, field, path)
    if not path.name or (path.exists() and not path.is_file()):
        raise InputError(
            f"{field}: {str(path)!r} is not allowed; it must be a file, not a folder or a device"
        )


@contextlib.contextmanager
def lock(folder: Path) -> Iterator[None]:
    """Creates a folder and holds a lock on it, which ends with the process.

    InUseError if it is locked already.

    Below it, nothing is written once its path leads to another folder or to none. Folders that it
    created are removed again if they stay empty.
    """
    import filelock  # 30 ms, which most commands need not wait for

    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    with naming(folder):
        folder.mkdir(parents=True, exist_ok=True)
    lock = filelock.FileLock(folder / LOCK, blocking=False)
    outer = _locks.get(folder)
    try:
        lock.acquire()
    except filelock.Timeout:
        raise InUseError(f"run_dir: {folder} is in use by another process") from None
    try:
        _locks[folder] = (folder / LOCK).stat()
        yield
    finally:
        with contextlib.suppress(OSError, InputError):
            check_locks(folder / LOCK)
            # before the release: another process takes no lock on a file that is gone
            (folder / LOCK).unlink()
        lock.release()
        _locks.pop(folder, None)
        if outer is not None:
            _locks[folder] = outer
        with contextlib.suppress(OSError):
            for path in missing:
                path.rmdir()
