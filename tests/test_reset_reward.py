"""The reward of an untrained team, with and without the box's displacement by resets."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))

import reset_reward


def test_only_the_variant_with_resets_rewards_a_box_that_nobody_touches() -> None:
    rows = reset_reward.measure("go1pushbox", "held", 3, 2, "c", steps=8, episode_length=0.2)  # 10 steps
    assert [row["reward"] for row in rows] == [0.0, 0.0]
    assert rows[0]["with_resets"] == 0.0  # no episode has ended
    # Three boxes at 2.5 +-0.5 m were reset once: at most 1 m each, 10 per m, averaged over 8 steps.
    assert 0.0 < abs(rows[1]["with_resets"]) < 10.0 / 8


def test_the_summary_has_mean_and_deviation_over_rollouts() -> None:
    result = reset_reward.summary([{"reward": 1.0}, {"reward": 2.0}])
    assert result["reward"]["mean"] == 1.5 and result["reward"]["rollouts"] == [1.0, 2.0]
    assert result["reward"]["deviation"] == pytest.approx(0.70711)
