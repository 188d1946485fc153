"""Conversion of official TorchScript checkpoints of walk-these-ways."""

from __future__ import annotations

import os

import numpy as np

from mqe_jax.settings import PathText, checked
from mqe_jax.walk_policy import Params, nested_params


@checked(path=PathText)
def read_torchscript(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """Reads the float32 weights of a TorchScript file of a `torch.nn.Sequential`, without torch.

    The file is a zip archive whose `data.pkl` names storages kept beside it; only tensors and plain
    containers are accepted, so nothing in the file is executed.

    Returns:
        `{"0.weight": (out, in), "0.bias": (out,), ...}`.

    Raises:
        InputError: if the file is not such an archive.
    """
    from mqe_jax.walk.torchscript import read_state

    return read_state(path)


def convert(adaptation: str | os.PathLike[str], body: str | os.PathLike[str]) -> Params:
    """Reads the official pair of TorchScript checkpoints into this package's weights."""
    flat = {f"adaptation.{name}": value for name, value in read_torchscript(adaptation).items()}
    flat |= {f"body.{name}": value for name, value in read_torchscript(body).items()}
    return nested_params(flat, f"{adaptation}, {body}")
