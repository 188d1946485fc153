"""The examples of a custom environment and a custom network, at a small size."""

from __future__ import annotations

import importlib
import runpy
from pathlib import Path
from typing import Any

import pytest

from mqe_jax.train.networks import NETWORKS

EXAMPLES = Path(__file__).parent.parent / "examples"


@pytest.fixture(autouse=True)
def script_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    """Examples run as scripts, with their own folder on the import path."""
    monkeypatch.syspath_prepend(str(EXAMPLES))


def test_an_environment_of_ones_own_is_trained() -> None:
    example: dict[str, Any] = runpy.run_path(str(EXAMPLES / "foreign_env.py"))
    history = example["main"](num_envs=32, updates=25)
    assert len(history) == 25 and history[-1] < 0.6 * history[0]


def test_a_network_of_ones_own_is_trained() -> None:
    runpy.run_path(str(EXAMPLES / "custom_network.py"))
    try:
        foreign_env = importlib.import_module("foreign_env")

        history = foreign_env.main(num_envs=32, updates=25, network={"name": "mean_field", "width": 32})
    finally:
        NETWORKS.pop("mean_field")
    assert history[-1] < 0.6 * history[0]
