"""Checkpoints of any pytree of arrays, written atomically as safetensors files."""

import json
import re
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from mqe_jax.core import limits
from mqe_jax.core.errors import InputError, brief
from mqe_jax.core.files import make_folder, parse_json, parsing, read_bytes, write_atomically
from mqe_jax.core.settings import fail
from mqe_jax.core.types import is_typed_key, raw_keys

FORMAT = "mqe_jax.train"
VERSION = 4

_LENGTH = 8  # bytes of a safetensors file that hold the length of its header
_LARGEST = {"policy": limits.FILE_BYTES, "checkpoint": limits.CHECKPOINT_BYTES}
_NAME = re.compile(r"step_(\d{12})\.safetensors")

_FINITE = (-float(np.finfo(np.float32).max), float(np.finfo(np.float32).max))
_RANGES: tuple[tuple[str, float, float], ...] = (
    (r"normalizer/(obs/|privileged/)?(variance|samples|square|weight)$", 0.0, _FINITE[1]),
    (r"^optimizer/(square/|updates$)|^learning_rate$", 0.0, _FINITE[1]),
    (
        r"^(updates|rollout/episode_steps|extra/(played|snapshot|recent|member|pool/(games|score)))$",
        0.0,
        _FINITE[1],
    ),
    (r"^extra/pool/born$", -1.0, _FINITE[1]),
    (r"^assistance$", 0.0, 1.0),
    (r"(^|/)params/(?!critic)", -limits.WEIGHT, limits.WEIGHT),
)
"""Lowest and highest value of arrays by patterns of their names; of others any finite number."""
_ANY = re.compile(r"/env_state/(?!.*(arrays|before)/)(?!.*(obs|qpos|qvel|groups/[^/]+)$)")
"""Names of arrays in which NaN may be meant."""


def _flatten(tree: Any) -> tuple[dict[str, Any], Any]:
    """Returns the leaves by path name, in the tree's order, and the tree's structure."""
    leaves, structure = jax.tree_util.tree_flatten_with_path(tree)
    return {
        jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves
    }, structure


def _checksum(arrays: Mapping[str, np.ndarray], metadata: str) -> str:
    total = zlib.crc32(metadata.encode())
    for name in sorted(arrays):
        array = arrays[name]
        about = f"{name} {array.dtype} {array.shape}"
        total = zlib.crc32(array.tobytes(), zlib.crc32(about.encode(), total))
    return str(total)


def save_tree(path: str | Path, tree: Any, metadata: Mapping[str, Any], *, kind: str) -> None:
    """Writes a pytree of arrays with JSON metadata to a file.

    `kind` names the kind of file. Equal content gives equal bytes.
    """
    try:
        text = json.dumps(dict(metadata), sort_keys=True)
    except (TypeError, ValueError):
        fail("metadata", metadata, "a mapping of names to what JSON has")
    try:
        named, _ = _flatten(jax.device_get(raw_keys(tree)))
        # ascontiguousarray turns scalars into (1,); `Stored.tree` checks the original shape
        arrays = {
            name: np.ascontiguousarray(leaf).reshape(np.shape(leaf)) for name, leaf in named.items()
        }
        header = {
            "kind": kind,
            "version": str(VERSION),
            "checksum": _checksum(arrays, text),
            "metadata": text,
        }
        content = save(arrays, {FORMAT: json.dumps(header)})
    except (SafetensorError, TypeError, ValueError):
        fail("tree", tree, "a pytree of arrays")
    write_atomically(Path(path), content)


class Stored(NamedTuple):
    """What a file holds, read and checked."""

    path: Path
    arrays: dict[str, np.ndarray]
    """Arrays by path name."""
    metadata: dict[str, Any]

    def tree(self, template: Any, *, half: bool = False, part: str = "") -> Any:
        """Returns the arrays as a pytree of the structure of `template`.

        The leaves of `template` have the expected shapes and dtypes. With `half`, float16 leaves
        are converted to float32. With `part`, such as "extra/pool/", the pytree has only the leaves
        below this path name.

        InputError, naming the file, for leaves that are missing, unknown, impossible or of another
        shape or dtype.
        """
        arrays = {
            name.removeprefix(part): array
            for name, array in self.arrays.items()
            if name.startswith(part)
        }
        expected, structure = _flatten(template)
        for name in expected:
            if name not in arrays:
                raise InputError(
                    f"{self.path}: {name} is missing; the file has other settings or is of another "
                    "version"
                )
        for name in sorted(arrays):
            if name not in expected:
                raise InputError(
                    f"{self.path}: unexpected entry {name}, not defined by the current settings"
                )
        for name, leaf in _flatten(jax.eval_shape(raw_keys, template))[0].items():
            found = arrays[name]
            about = f"{self.path}: {name} has"
            if tuple(found.shape) != tuple(leaf.shape):
                raise InputError(
                    f"{about} shape {tuple(found.shape)}; {tuple(leaf.shape)} is needed"
                )
            if half and found.dtype == np.float16 and leaf.dtype == np.float32:
                arrays[name] = found.astype(np.float32)
            elif found.dtype != leaf.dtype:
                raise InputError(f"{about} dtype {found.dtype}; {leaf.dtype} is needed")
            _check_range(self.path, part + name, arrays[name])
        leaves = []
        for name, leaf in expected.items():
            array = jax.device_put(arrays[name])
            if is_typed_key(leaf):
                array = jax.random.wrap_key_data(array, impl=leaf.dtype)
            leaves.append(array)
        return jax.tree_util.tree_unflatten(structure, leaves)


def read_file(path: str | Path, *, kind: str) -> Stored:
    """Reads a file of a kind, opening it once.

    Raises:
        InputError: naming the file, if it is missing, damaged, of another kind or another version.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such file; a {kind} written by this package is needed")
    return parse_file(path, read_bytes(path, _LARGEST[kind]), kind)


def parse_file(path: Path, content: bytes, kind: str) -> Stored:
    """Returns what the content of a file holds; errors as `read_file`."""
    try:
        with parsing(path, f"a {kind}, or truncated"):
            arrays = load(content)
            size = int.from_bytes(content[:_LENGTH], "little")
            found = json.loads(content[_LENGTH : _LENGTH + size]).get("__metadata__", {})
            if FORMAT not in found:
                raise InputError(
                    f"not a file of this package, or of a version before 0.2.0; a {kind} is needed"
                )
            header = parse_json(found[FORMAT], "header")
            if header["kind"] != kind:
                raise InputError(f"holds a {brief(str(header['kind']))}; a {kind} is needed")
            if header["version"] != str(VERSION):
                raise InputError(
                    f"has format version {brief(str(header['version']))}; version {VERSION} is "
                    "needed"
                )
            metadata = parse_json(header["metadata"], "metadata")
            if not isinstance(metadata, dict):
                raise ValueError("its metadata is not a mapping")
            if header["checksum"] != _checksum(arrays, header["metadata"]):
                raise ValueError("its content does not match its checksum")
    except InputError as error:
        text = str(error)
        raise InputError(text if str(path) in text else f"{path}: {text}") from None
    return Stored(path, arrays, metadata)


def _check_range(path: Path, name: str, array: np.ndarray) -> None:
    """Raises an InputError for numbers that no training writes."""
    low, high = next(
        ((low, high) for pattern, low, high in _RANGES if re.search(pattern, name)), _FINITE
    )
    if (
        array.dtype.kind in "fiu"
        and not _ANY.search(name)
        and not np.all(within := (array >= low) & (array <= high))
    ):
        wrong = array[~within].flat[0]
        raise InputError(
            f"{path}: {name} holds {wrong}; a number from {low:g} to {high:g} is needed"
        )


def checkpoint_folder(run_dir: str | Path) -> Path:
    """Returns the checkpoint folder of a run."""
    return Path(run_dir) / "checkpoints"


def list_checkpoints(run_dir: str | Path) -> list[Path]:
    """Returns a run's checkpoints, oldest first."""
    return files_by_step(checkpoint_folder(run_dir))


def files_by_step(folder: Path) -> list[Path]:
    """Returns a folder's files named by environment steps, as checkpoints are, oldest first."""
    return sorted(p for p in folder.glob("step_*.safetensors") if _NAME.fullmatch(p.name))


def checkpoint_step(path: Path) -> int:
    """Returns the environment steps in a checkpoint's name."""
    match = _NAME.fullmatch(path.name)
    assert match is not None, path
    return int(match[1])


def latest(run_dir: str | Path) -> Path | None:
    """Returns a run's newest checkpoint, or None."""
    return next(reversed(list_checkpoints(run_dir)), None)


def nonfinite(tree: Any) -> list[str]:
    """Returns the path names of the leaves that hold NaN or infinite numbers."""
    return [
        name
        for name, leaf in _flatten(jax.device_get(raw_keys(tree)))[0].items()
        if not np.all(np.isfinite(leaf))
    ]


def save_checkpoint(
    run_dir: str | Path, tree: Any, step: int, metadata: Mapping[str, Any], keep: int
) -> Path:
    """Writes a checkpoint of environment step `step`, then removes all but the newest `keep`."""
    folder = checkpoint_folder(run_dir)
    make_folder(folder)
    path = folder / f"step_{step:012d}.safetensors"
    save_tree(path, tree, {**metadata, "step": step}, kind="checkpoint")
    for old in list_checkpoints(run_dir)[:-keep]:
        old.unlink(missing_ok=True)
    return path
