"""Scenes with distinct geoms agree on MuJoCo's C engine and MJX; `python -m tests.engines` compares all tasks."""

from __future__ import annotations

import pytest

from mqe_jax.envs import TASKS
from tests import engines


@pytest.mark.soak
@pytest.mark.parametrize("task", list(TASKS))
def test_mjx_agrees_with_the_c_engine_over_20_steps(task: str) -> None:
    """Standing robots and episodes in play under random joint targets: contacts make small differences grow."""
    figures = engines.disagreement(task, "jax", engines.record(task, num_envs=4))
    assert figures["standing/robots_1"] < 1e-3, figures
    assert figures["standing/robots_20"] < 0.02 and figures["standing/robots_20_max"] < 0.1, figures
    assert figures.get("standing/objects_20_max", 0.0) < 0.02, figures
    # Where a robot leans on an edge of a box, the engines put the contact points otherwise.
    assert figures["play/robots_1"] < 0.03 and figures["play/robots_20"] < 0.05, figures
    assert figures.get("play/objects_20", 0.0) < 0.05, figures
