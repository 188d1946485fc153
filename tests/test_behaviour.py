"""What is measured of the shipped teams, on episodes made by hand."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from mqe_jax import make
from mqe_jax.viz.recording import Episode

sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))
import behaviour


@pytest.mark.parametrize("passed", [True, False])
def test_touches_until_the_goal_are_counted_by_robot(passed: bool) -> None:
    """The first robot starts the ball, the second, if it is near, shoots it into the goal."""
    env = make("go1football-2vs2", impl="c", num_envs=1)
    qpos = np.tile(env.mj_model.qpos0, (8, 1))
    bases = env.index.base_qpos
    qpos[:, bases[:, :2]] = [[6.7, 0.0], [7.0, 0.5 if passed else 2.0], [10.0, 2.0], [10.0, -2.0]]
    ball = [7.0, 7.0, 7.0, 7.01, 7.02, 9.0, 12.1, 12.2]
    qpos[:, env.objects["ball"].qpos[:2]] = np.stack([ball, np.zeros(8)], axis=1)
    qpos[3:, bases[0, 0]] = 4.0  # it stays behind
    found = behaviour.football(env, Episode(qpos, np.zeros((8, 0, 3)), np.zeros((8, 0, 4)), dt=0.02))
    assert found["goal"] and not found["opponent fell"] and found["time"] == pytest.approx(6 * 0.02)
    assert found["goal after touches by both"] == passed
    assert found["touches by the one that touches more"] == (0.5 if passed else 1.0)
