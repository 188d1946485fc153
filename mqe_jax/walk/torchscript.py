"""Official TorchScript checkpoints of walk-these-ways, read without torch.

No code from a checkpoint is executed. The archive is a zip file: `<name>/data.pkl` pickles the
module tree, whose tensors refer to raw storages in `<name>/data/<key>`, and `<name>/code` holds the
source of its classes. The unpickler supports only tensors and containers. Every module class
becomes a plain object that keeps its attributes.

"""

import io
import math
import pickle
import re
import zipfile
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from mqe_jax.core import limits
from mqe_jax.core.files import archive
from mqe_jax.walk_policy import NETWORKS, Params

_DTYPES = {"FloatStorage": "<f4", "DoubleStorage": "<f8", "HalfStorage": "<f2"}
_MANGLED = re.compile(r"\.___torch_mangle_\d+")
# as an argument in TorchScript's source
_NUMBER = re.compile(r", (-?[\d.]+(?:e[+-]?\d+)?)(?=[,)])")


class _Module:
    """Placeholder for a module class of the archive."""

    kind: ClassVar[str]  # qualified name of the class
    source: ClassVar[str]  # name of the archive's member that defines it

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)


_PurePython: Any = vars(pickle)["_Unpickler"]  # the one in C allocates whatever a memo's index says


class _Unpickler(_PurePython):
    def __init__(self, data: bytes, opened: zipfile.ZipFile, root: str) -> None:
        super().__init__(io.BytesIO(data))
        self._archive = opened
        self._root = root
        self._storages: dict[str, np.ndarray] = {}
        self._left = limits.FILE_BYTES  # of all tensors, which may share storages

    def find_class(self, module: str, name: str) -> Any:
        if module.startswith("__torch__"):
            kind = f"{_MANGLED.sub('', module)}.{name}".removeprefix("__torch__.")
            source = f"{self._root}/code/{module.replace('.', '/')}.py"
            return type(name, (_Module,), {"kind": kind, "source": source})
        if module == "torch._utils" and name in ("_rebuild_tensor_v2", "_rebuild_tensor"):
            return self._rebuild_tensor
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
        if key not in self._storages:
            self._storages[key] = np.frombuffer(
                self._archive.read(f"{self._root}/data/{key}"), dtype
            )
        return self._storages[key]

    def _rebuild_tensor(
        self,
        storage: np.ndarray,
        offset: int,
        size: tuple[int, ...],
        stride: tuple[int, ...],
        *_: Any,
    ) -> np.ndarray:
        last = offset
        if all(size):
            last += sum((n - 1) * s for n, s in zip(size, stride, strict=True))
        if min(offset, *size, *stride) < 0 or last >= len(storage):
            raise ValueError("a tensor reaches beyond its storage")
        self._left -= 4 * math.prod(size)
        if self._left < 0:
            raise ValueError(f"its tensors have more than {limits.FILE_BYTES} bytes")
        strides = [s * storage.itemsize for s in stride]
        tensor = np.array(
            np.lib.stride_tricks.as_strided(storage[offset:], size, strides), np.float32
        )
        if not np.isfinite(tensor).all():
            raise ValueError("a tensor holds NaN or infinite numbers")
        return tensor


def read_torchscript(path: str | Path) -> dict[str, np.ndarray]:
    """Returns the float32 tensors of a scripted or traced `Sequential` by names such as 0.weight.

    InputError for another file or one beyond the limits. The layers must be linear, with an ELU
    between each two.
    """
    kind = "a TorchScript Sequential of Linear and ELU layers"
    with archive(Path(path), limits.FILE_BYTES, kind) as opened:
        names = [name for name in opened.namelist() if re.fullmatch(r"[^/]*/data\.pkl", name)]
        if len(names) != 1:
            raise ValueError("no data.pkl in it")
        root = _Unpickler(opened.read(names[0]), opened, names[0].split("/")[0]).load()
        children = _parts("the network", root, "container.Sequential")
        state: dict[str, np.ndarray] = {}
        for index, (name, child) in enumerate(children.items()):
            if name != str(index):
                raise ValueError(f"{name} is not expected")
            if index % 2:
                parts = _parts(name, child, "activation.ELU")
                _check_alpha(name, opened.read(child.source).decode())
            else:
                parts = _parts(name, child, "linear.Linear")
            for part, value in parts.items():
                if part not in ("weight", "bias") or not isinstance(value, np.ndarray):
                    raise ValueError(f"{name}.{part} is not expected")
                state[f"{name}.{part}"] = value
        if len(children) % 2 == 0:
            raise ValueError(f"{len(children)} layers; the last must be Linear")
        return state


def _check_alpha(name: str, source: str) -> None:
    for alpha in _NUMBER.findall(source):
        if float(alpha) != 1:
            raise ValueError(f"{name} is an ELU with alpha {alpha}, not 1")


def _parts(name: str, module: Any, kind: str) -> dict[str, Any]:
    """Returns the attributes of a module of `torch.nn.modules`, without torch's own.

    `kind` names its class, such as linear.Linear.
    """
    found = getattr(module, "kind", type(module).__name__)
    if found != f"torch.nn.modules.{kind}":
        raise ValueError(f"{name} is a {found}, not a torch.nn.modules.{kind}")
    own = ("training", "_is_full_backward_hook")
    return {key: value for key, value in vars(module).items() if key not in own}


def convert(adaptation: str | Path, body: str | Path) -> Params:
    """Reads the official pair of TorchScript checkpoints into this package's weights."""
    flat = {f"adaptation.{name}": value for name, value in read_torchscript(adaptation).items()}
    flat |= {f"body.{name}": value for name, value in read_torchscript(body).items()}
    return NETWORKS.nest(flat, f"{adaptation}, {body}")
