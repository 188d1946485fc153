"""`check_task` finds the faults of a task, and names the method."""

from typing import Any

import jax.numpy as jnp
import pytest

from mqe_jax.envs.gate import Go1Gate
from mqe_jax.envs.tug import Go1Tug
from mqe_jax.testing import check_task


def spawn_in_wall(env: Any) -> Any:
    return [(x, y - 0.7, yaw) for x, y, yaw in env.compiled.layout.spawn]


def spawn_outside(env: Any) -> Any:
    return [(x, y - 1.4, yaw) for x, y, yaw in env.compiled.layout.spawn]


def shift(dy: float, dz: float) -> Any:
    def spawn(env: Any, key: Any) -> Any:
        return Go1Gate.spawn(env, key) + jnp.array([0.0, dy, dz, 0.0])

    return spawn


def infinite_reward(env: Any, before: Any, after: Any, collision: Any) -> Any:
    return Go1Gate.rewards(env, before, after, collision) | {"approach": jnp.inf}


def unlike_yaw(env: Any) -> Any:
    return [(x, y, 0.0) for x, y, _ in Go1Tug.spawn_poses(env)]


def unseen(env: Any, state: Any, robot_state: Any) -> Any:
    blocks = Go1Tug.observe(env, state, robot_state)
    return blocks | {"base": jnp.log(blocks["base"] - 1e6)}


def unfair_score(env: Any, before: Any, after: Any, collision: Any) -> Any:
    reward, logged = Go1Tug.score(env, before, after, collision)
    return reward + 1.0, logged


@pytest.mark.parametrize(
    ("base", "method", "fault", "said"),
    [
        (Go1Gate, "spawn_poses", spawn_in_wall, "robot0/.* starts .* m inside barrier/side_right"),
        (
            Go1Gate,
            "spawn_poses",
            spawn_outside,
            "spawn_poses lie 0.65 m outside of the outer walls",
        ),
        (Go1Gate, "spawn", shift(-0.7, 0.0), "^spawn: robot0/.* starts .* m inside barrier/side_r"),
        (Go1Gate, "spawn", shift(-1.4, 0.0), "^spawn: a robot starts 0.6. m outside of the outer"),
        (Go1Gate, "spawn", shift(0.0, -0.3), "^spawn: robot./.* starts 0.1. m inside floor"),
        (Go1Gate, "rewards", infinite_reward, "rewards: a number is NaN or infinite"),
        (Go1Gate, "outcome", lambda *_: {"success": 2.0}, "success is not between 0 and 1"),
        (Go1Gate, "acting", lambda *_: jnp.zeros(2, bool), "actions do not change the robots"),
        (Go1Gate, "step_task", lambda *_: jnp.zeros(()), r"step_task: \(\) float32; expected as"),
        (
            Go1Gate,
            "reset_task",
            lambda env, key: None,
            r"Faulty.reset_task: .*; expected \(self, k",
        ),
        (Go1Tug, "score", unfair_score, "rewards: those of the teams do not add up to 0"),
        (Go1Tug, "observe", unseen, "observe: base: a number is NaN or infinite"),
        (
            Go1Tug,
            "center",
            property(lambda env: (Go1Tug.center.__get__(env)[0], 0.3)),
            r"spawn_poses: team 1 sees .* and center \(.*, 0.3\) agree",
        ),
        (Go1Tug, "spawn_poses", unlike_yaw, "spawn_poses: team 1 sees"),
        (
            Go1Tug,
            "spawn_poses",
            lambda env: [*Go1Tug.spawn_poses(env)][:1],
            "spawn_poses: 1; expected 2, one per",
        ),
        (Go1Tug, "symmetry", "rotate", "symmetry: 'rotate' is not allowed; it must be 'turn' or"),
        (Go1Tug, "leading", lambda *_: jnp.zeros((), bool), r"leading: \(\) bool; expected \(2,\)"),
        (Go1Tug, "wins", lambda *_: jnp.ones(2, bool), "outcome: not one of win, draw and loss"),
    ],
)
def test_faults_are_named(base: Any, method: str, fault: Any, said: str) -> None:
    faulty: Any = type("Faulty", (base,), {method: fault})
    with pytest.raises((AssertionError, ValueError), match=said):
        check_task(faulty(impl="c", num_envs=2), num_envs=2, steps=3)
