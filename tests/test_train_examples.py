"""The examples of a custom environment, a custom network and self-play, at a small size."""

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


def test_self_play_trains_against_a_snapshot_and_a_scripted_opponent() -> None:
    example: dict[str, Any] = runpy.run_path(str(EXAMPLES / "self_play.py"))
    results = example["main"](num_envs=4, updates=3, snapshot_every=2, episodes=4)
    assert len(results) == 2
    assert all(sum(result.match.values()) == pytest.approx(1.0) for result in results)
