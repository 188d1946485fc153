"""Host functions that compiled programs call by number.

JAX's compilation cache can store these programs.

JAX does not store programs that contain its own callbacks, since those hold addresses of this
process. Here a program holds a number that a function has in every process; XLA calls one handler,
a C function made by ctypes, which finds the function by that number. The structures are those of
XLA's stable C interface (`jax.ffi.include_dir()`, xla/ffi/api/c_api.h, version 0.3). With another
version of it, JAX's callbacks do the same without being stored.
"""

import atexit
import contextlib
import ctypes
import functools
import re
import weakref
from collections.abc import Callable, Sequence
from ctypes import POINTER, Structure, c_char_p, c_int, c_int64, c_size_t, c_void_p
from pathlib import Path
from typing import Any

import jax
import numpy as np

TARGET = "mqe_jax_host_call"
_VERSION = 0, 3
_METADATA = 1
_EXECUTE = 3
_INTERNAL = 13
_DTYPES = {1: np.bool_, 4: np.int32, 5: np.int64, 8: np.uint32, 11: np.float32, 12: np.float64}

HostFunction = Callable[..., np.ndarray]
"""Maps arrays to one array; it must not keep the arrays, whose memory belongs to XLA."""


class _Extension(Structure):
    pass


class _Scalar(Structure):
    _fields_ = [("dtype", c_int), ("value", POINTER(c_int64))]


def _structure(name: str, *fields: tuple[str, Any]) -> Any:
    """Returns a structure whose first fields are its size and a pointer to its extensions."""
    head = ("struct_size", c_size_t), ("extension", POINTER(_Extension))
    return type(name, (Structure,), {"_fields_": [*head, *fields]})


_Extension._fields_ = [("struct_size", c_size_t), ("type", c_int), ("next", POINTER(_Extension))]
_Version = _structure("_Version", ("major", c_int), ("minor", c_int))
_Buffer = _structure(
    "_Buffer", ("dtype", c_int), ("data", c_void_p), ("rank", c_int64), ("dims", POINTER(c_int64))
)
_Items = ("size", c_int64), ("types", c_void_p)
_List = _structure("_List", *_Items, ("items", POINTER(POINTER(_Buffer))))
"""XLA_FFI_Args and XLA_FFI_Rets."""
_Attributes = _structure(
    "_Attributes", *_Items, ("names", c_void_p), ("items", POINTER(POINTER(_Scalar)))
)
_Error = _structure("_Error", ("message", c_char_p), ("code", c_int))
_Create = ctypes.CFUNCTYPE(c_void_p, POINTER(_Error))
_Api = _structure("_Api", ("version", _Version), ("internal", c_void_p), ("create_error", _Create))
"""The beginning of XLA_FFI_Api."""
_Frame = _structure(
    "_Frame",
    ("api", POINTER(_Api)),
    ("context", c_void_p),
    ("stage", c_int),
    ("arguments", _List),
    ("results", _List),
    ("attributes", _Attributes),
)


class _Metadata(Structure):
    _fields_ = [("struct_size", c_size_t), ("version", _Version)]


class _MetadataExtension(Structure):
    _fields_ = [("base", _Extension), ("metadata", POINTER(_Metadata))]


_KEPT = 64
_owners: dict[int, weakref.WeakKeyDictionary[Any, HostFunction]] = {}
"""Functions of each number by their owners; they do the same, so any whose owner lives will do."""
_latest: dict[int, HostFunction] = {}
"""The last function of each of the last `_KEPT` numbers, for programs that are called, or run,
without an owner."""


@functools.cache
def finish_at_exit() -> None:
    """Makes the interpreter wait for programs before it ends: their threads call Python."""
    atexit.register(_finish)


def _finish() -> None:
    """Waits for programs whose results exist."""
    for array in jax.live_arrays():
        with contextlib.suppress(Exception):  # deleted, or the result of a program that failed
            array.block_until_ready()


def host_call(
    number: int,
    owner: Any,
    function: HostFunction,
    result: jax.ShapeDtypeStruct,
    arguments: Sequence[jax.Array],
) -> jax.Array:
    """Returns the result of a host function in a compiled program.

    `vmap` batches it with all its arguments.

    Functions of one number (64 bits), the same in every process, do the same; those whose owners
    live are preferred, which they must not reference. `result` has the shape and dtype without
    batch axes.
    """
    finish_at_exit()
    _owners.setdefault(number, weakref.WeakKeyDictionary())[owner] = function
    _latest.pop(number, None)
    _latest[number] = function
    while len(_latest) > _KEPT:
        _latest.pop(next(iter(_latest)), None)
    batching: Any = {"vmap_method": "broadcast_all"}
    if FITS:
        call = jax.ffi.ffi_call(TARGET, result, **batching)
        out = call(*arguments, number=np.int64(number))
    else:
        out = jax.pure_callback(functools.partial(_call, number), result, *arguments, **batching)
    assert isinstance(out, jax.Array)
    return out


def _array(buffer: Any, *, writable: bool = False) -> np.ndarray:
    shape = tuple(buffer.dims[i] for i in range(buffer.rank))
    dtype = np.dtype(_DTYPES[buffer.dtype])
    size = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
    memory: Any = (ctypes.c_char * size).from_address(buffer.data) if size else bytearray()
    array = np.frombuffer(memory, dtype).reshape(shape)
    array.flags.writeable = writable
    return array


def _call(number: int, *arguments: Any) -> np.ndarray:
    function = next(iter(_owners.get(number, {}).values()), _latest.get(number))
    if function is None:
        raise RuntimeError("the environment of this compiled program no longer exists")
    return function(*map(np.asarray, arguments))


def _execute(frame: Any) -> None:
    arguments = [_array(frame.arguments.items[i].contents) for i in range(frame.arguments.size)]
    result = _call(frame.attributes.items[0].contents.value[0], *arguments)
    np.copyto(_array(frame.results.items[0].contents, writable=True), result)


@ctypes.CFUNCTYPE(c_void_p, POINTER(_Frame))
def _handler(pointer: Any) -> int | None:
    frame = pointer.contents
    if frame.extension and frame.extension.contents.type == _METADATA:
        about = ctypes.cast(frame.extension, POINTER(_MetadataExtension)).contents.metadata.contents
        about.version.major, about.version.minor = _VERSION
        return None
    if frame.stage != _EXECUTE:
        return None
    try:
        _execute(frame)
    except BaseException as error:  # an exception does not cross the C function
        message = f"{type(error).__name__}: {error}".encode()
        arguments = _Error(ctypes.sizeof(_Error), None, message, _INTERNAL)
        return frame.api.contents.create_error(ctypes.byref(arguments))
    return None


def _fits() -> bool:
    """Returns whether JAX's C interface has this major version, and at least this minor one."""
    header = Path(jax.ffi.include_dir()) / "xla/ffi/api/c_api.h"
    text = header.read_text("utf-8", "replace") if header.is_file() else ""
    major = re.search(r"define XLA_FFI_API_MAJOR (\d+)", text)
    minor = re.search(r"define XLA_FFI_API_MINOR (\d+)", text)
    if not major or not minor:
        return False
    return int(major[1]) == _VERSION[0] and int(minor[1]) >= _VERSION[1]


FITS = _fits()
"""Whether the structures fit JAX; an unsuitable handler would make JAX lose its CPU backend."""
if FITS:
    jax.ffi.register_ffi_target(TARGET, jax.ffi.pycapsule(_handler), platform="cpu")
