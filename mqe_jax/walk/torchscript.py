"""Reads the weights of a TorchScript archive without torch and without executing code from it.

The archive is a zip file: `<name>/data.pkl` pickles the module tree, whose tensors refer to raw storages in
`<name>/data/<key>`. The unpickler below supports only tensors and containers; every module class becomes a plain
object that keeps its attributes.
"""

from __future__ import annotations

import io
import os
import pickle
import zipfile
from typing import Any

import numpy as np

_DTYPES = {
    "FloatStorage": "<f4",
    "DoubleStorage": "<f8",
    "HalfStorage": "<f2",
    "LongStorage": "<i8",
    "IntStorage": "<i4",
}


class _Module:
    """Placeholder for any module class of the archive."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)


def _rebuild_tensor(
    storage: np.ndarray, offset: int, size: tuple[int, ...], stride: tuple[int, ...], *_: Any
) -> np.ndarray:
    last = offset + sum((n - 1) * s for n, s in zip(size, stride, strict=True)) if all(size) else offset
    if offset < 0 or any(s < 0 for s in stride) or last >= len(storage):
        raise ValueError("a tensor reaches beyond its storage")
    bytes_per = storage.itemsize
    view = np.lib.stride_tricks.as_strided(storage[offset:], size, [s * bytes_per for s in stride])
    return np.array(view, np.float32)


class _Unpickler(pickle.Unpickler):
    def __init__(self, data: bytes, archive: zipfile.ZipFile, root: str) -> None:
        super().__init__(io.BytesIO(data))
        self._archive, self._root = archive, root

    def find_class(self, module: str, name: str) -> Any:
        if module.startswith("__torch__"):
            return _Module
        if module == "torch._utils" and name in ("_rebuild_tensor_v2", "_rebuild_tensor"):
            return _rebuild_tensor
        if module == "torch._utils" and name == "_rebuild_parameter":
            return lambda tensor, *_: tensor
        if module == "torch" and name in _DTYPES:
            return _DTYPES[name]
        if module == "collections" and name == "OrderedDict":
            return dict
        if module == "torch.jit._pickle":
            return lambda value, *_: value
        raise ValueError(f"unexpected class {module}.{name} in a network of linear layers")

    def persistent_load(self, pid: Any) -> np.ndarray:
        kind, dtype, key = pid[:3]
        if kind != "storage":
            raise ValueError(f"holds a {kind}")
        return np.frombuffer(self._archive.read(f"{self._root}/data/{key}"), dtype)


def read_state(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """Returns the tensors of a TorchScript file by dotted name, float32.

    Raises:
        OSError, zipfile.BadZipFile, KeyError, ValueError: if the file is not such an archive.
    """
    with zipfile.ZipFile(path) as archive:
        names = [name for name in archive.namelist() if name.endswith("/data.pkl") and name.count("/") == 1]
        if len(names) != 1:
            raise ValueError("no data.pkl in it")
        try:
            root = _Unpickler(archive.read(names[0]), archive, names[0].split("/")[0]).load()
        except (pickle.UnpicklingError, EOFError, AttributeError, TypeError, IndexError) as error:
            raise ValueError(str(error)) from None
    state: dict[str, np.ndarray] = {}

    def walk(node: Any, prefix: str) -> None:
        for name, value in vars(node).items():
            if isinstance(value, np.ndarray):
                state[prefix + name] = value
            elif isinstance(value, _Module):
                walk(value, f"{prefix}{name}.")

    if not isinstance(root, _Module):
        raise ValueError("its root is not a module")
    walk(root, "")
    return state
