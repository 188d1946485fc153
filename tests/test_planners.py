"""Scripted policies: the registry of them, and actions in the `command` mode on observations made by hand."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax.envs import PLANNERS, TASKS
from mqe_jax.errors import InputError
from mqe_jax.planners import planner_of
from mqe_jax.planners.cooperative import plan_seesaw
from mqe_jax.planners.matches import plan_tug
from mqe_jax.walk_policy import COMMANDS

SPEED = COMMANDS[0].gain  # m/s per unit of forward action


def push(speed: float, x: float = 1.6) -> np.ndarray:
    """Actions (2, 3) of robots in contact with a cylinder of the given speed, m/s."""
    base = jnp.tile(jnp.array([x, -0.7, 0.3, 0.0, 0.0, jnp.pi / 2]), (2, 1))
    return np.asarray(plan_tug({"base": base, "cylinder": jnp.tile(jnp.array([0.8, speed]), (2, 1))}))


def climb(x: float, y: float) -> np.ndarray:
    """Actions (2, 3) of a climber at x, y and a partner on the centre line 0.9 m behind it."""
    base = jnp.array([[x, y, 0.31, 0.0, 0.0, 0.0], [x - 0.9, 0.0, 0.31, 0.0, 0.0, 0.0]])
    return np.asarray(plan_seesaw({"base": base}))


def test_the_tug_robot_pushes_a_little_faster_than_the_cylinder() -> None:
    for speed, expected in ((0.0, 0.4), (-0.3, 0.4), (0.3, 0.7)):
        assert push(speed)[:, 0] * SPEED == pytest.approx(expected, abs=1e-5)
    assert push(0.3)[:, 1:] == pytest.approx(0.0, abs=1e-5)


def test_the_tug_robot_does_not_push_off_axis() -> None:
    action = push(0.0, x=1.2)
    assert np.all(action[:, 0] < 0) and np.all(action[:, 1] < 0)  # back, and to the right, towards x = 1.6


def test_the_climber_enters_the_plank_centred() -> None:
    assert climb(2.8, 0.05)[0, 0] == 1
    for y in (-0.25, 0.25):
        assert climb(2.8, y)[0, 0] < 0 and np.sign(climb(2.8, y)[0, 1]) == -np.sign(y)
        assert climb(3.5, y)[0, 0] == 1


def test_the_climber_leaves_the_low_end_of_the_plank_at_its_edge_and_goes_on_higher_up() -> None:
    assert climb(3.8, 0.4)[0, 0] < 0
    assert climb(5.0, 0.4)[0, 0] == 1


def test_every_line_of_the_registry_names_a_scripted_policy_that_exists() -> None:
    """All tasks but the plane have one, of a module of their own package."""
    assert set(TASKS) - set(PLANNERS) == {"go1plane"}
    for task in PLANNERS:
        assert planner_of(task).__module__.startswith("mqe_jax.planners.")
    with pytest.raises(InputError, match=r"go1plane has no scripted policy; allowed for: go1gate, "):
        planner_of("go1plane")
