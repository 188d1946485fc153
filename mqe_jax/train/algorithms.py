"""Presets of the algorithms: only the settings in which they differ, as in configs/paper. See docs/algorithms.md."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mqe_jax.errors import nearest
from mqe_jax.settings import fail

_MAPPO = {"name": "actor_critic", "share_policy": True, "critic_input": "own"}

ALGORITHMS: Mapping[str, Mapping[str, Any]] = {
    "mappo": {"ppo": {"ratio": "dimension", "value": "agent", "dual_clip": None}, "network": _MAPPO},
    "jrpo": {
        "ppo": {"ratio": "joint", "value": "joint", "dual_clip": None},
        "network": {**_MAPPO, "critic_input": "observations"},
    },
    "mat": {"ppo": {"ratio": "dimension", "value": "agent", "dual_clip": None}, "network": {"name": "mat"}},
    "ippo": {
        "ppo": {"ratio": "dimension", "value": "agent", "dual_clip": None},
        "network": {"name": "actor_critic", "share_policy": False, "critic_input": "own"},
    },
    "dual-clip": {"ppo": {"ratio": "dimension", "value": "agent", "dual_clip": 3.0}, "network": _MAPPO},
}
"""Presets of settings: multi-agent PPO, joint-ratio PPO, multi-agent transformer, independent PPO, dual-clip MAPPO."""


def preset(algorithm: str) -> dict[str, Any]:
    """Returns the settings of an algorithm, as nested names and values for `mqe_jax.settings.override`.

    Raises:
        InputError: for an unknown name, with the nearest known one.
    """
    if algorithm not in ALGORITHMS:
        fail("algorithm", algorithm, f"one of {', '.join(ALGORITHMS)}{nearest(algorithm, ALGORITHMS)}")
    return {name: dict(values) for name, values in ALGORITHMS[algorithm].items()}
