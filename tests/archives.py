"""TorchScript archives by their opcodes, as torch.jit.save writes them."""

import io
import struct
import zipfile
from collections.abc import Mapping


def module(*attributes: bytes, kind: str = "torch.nn.modules.x.M") -> bytes:
    """A module of a class below `__torch__` with the attributes, of `named`."""
    package, _, name = kind.rpartition(".")
    return f"c__torch__.{package}\n{name}\n".encode() + b")\x81}(" + b"".join(attributes) + b"ub"


def named(name: str, value: bytes) -> bytes:
    return b"X" + struct.pack("<I", len(name)) + name.encode() + value


def integers(values: tuple[int, ...]) -> bytes:
    return b"(" + b"".join(b"J" + struct.pack("<i", value) for value in values) + b"t"


def tensor(size: tuple[int, ...], stride: tuple[int, ...], key: str = "0", count: int = 1) -> bytes:
    """A tensor of float32 in the member `data/KEY` with `count` numbers."""
    place = named("cpu", b"J" + struct.pack("<i", count) + b"t")
    storage = b"(" + named("storage", b"ctorch\nFloatStorage\n") + named(key, place) + b"Q"
    return b"ctorch._utils\n_rebuild_tensor_v2\n(" + storage + b"K\x00" + integers(size) + integers(stride) + b"tR"


def zipped(pickle: bytes, storages: Mapping[str, bytes], code: Mapping[str, str] | None = None) -> bytes:
    """An archive of a whole pickle, storages by key, and sources by path below `code`."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("net/data.pkl", pickle)
        for key, content in storages.items():
            archive.writestr(f"net/data/{key}", content)
        for path, source in (code or {}).items():
            archive.writestr(f"net/code/{path}", source)
        archive.writestr("net/version", "3\n")
    return file.getvalue()
