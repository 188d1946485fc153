"""Objects and NPCs: motion of boxes, balls, sheep and the defender, and the tasks with objects and
sheep.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mqe_jax.envs import Moment, VectorEnv, make
from mqe_jax.npc import defend
from mqe_jax.physics import objects
from mqe_jax.physics.scene import Scene, compile_scene
from mqe_jax.policies.scripted import scripted_policy
from mqe_jax.terrain import Plane, SpawnArea, Track
from tests.inputs import refuses
from tests.states import (
    angles,
    initial,
    made,
    observation,
    placed,
    still,
    terms_of,
    with_object,
)

STEP = 0.02


box_env = pytest.fixture(scope="module")(lambda: made("go1pushbox"))
herd = pytest.fixture(scope="module")(lambda: made("go1sheep-hard"))


def plain(**objects: objects.Object) -> Any:
    return compile_scene(
        Scene(Track((SpawnArea(2.0), Plane(8.0)), walled=False), num_robots=1, objects=objects)
    )


@pytest.mark.parametrize(
    ("position", "yaw", "ball", "move"),
    [
        # Where it should be: 3 m before the goal, 0.6 of the way to a ball 5 m away; it faces away
        # from the goal.
        ((9.0, 0.0), np.pi, (7.0, 0.0), (0.0, 0.0, 0.0)),
        # 0.3 m too near the goal: forward, which is away from it. 2 m too near: as fast as it may.
        ((9.3, 0.0), np.pi, (7.0, 0.0), (0.3, 0.0, 0.0)),
        ((11.0, 0.0), np.pi, (7.0, 0.0), (0.5, 0.0, 0.0)),
        # The ball is behind it, 1 m from the goal: back to 0.6 m.
        ((9.0, 0.0), np.pi, (11.0, 0.0), (-0.5, 0.0, 0.0)),
        # Facing +x it must turn, the short way and at full rate.
        ((9.0, 0.0), 0.1, (7.0, 0.0), (0.0, 0.0, 1.0)),
        ((9.0, 0.0), -0.1, (7.0, 0.0), (0.0, 0.0, -1.0)),
        # 0.15 rad off: half of full rate, also across the cut at pi.
        ((9.0, 0.0), np.pi - 0.15, (7.0, 0.0), (0.0, 0.0, 0.5)),
        ((9.0, 0.0), -np.pi + 0.15, (7.0, 0.0), (0.0, 0.0, -0.5)),
    ],
)
def test_the_law_of_the_defender_by_hand(position: Any, yaw: float, ball: Any, move: Any) -> None:
    law = defend(jnp.array(position), jnp.array(yaw), jnp.array(ball), jnp.array([12.0, 0.0]))
    np.testing.assert_allclose(law, move, atol=1e-5)


def test_sheep_observation(herd: Any) -> None:
    state = dataclasses.replace(initial(herd), anchors=jnp.array([[8.5, 0.4]]))
    for number in range(9):
        state = with_object(herd, state, f"sheep{number}", [number, -0.1 * number])
    obs = observation(herd, state)
    info = np.asarray(herd.read(state.data).base_info)
    sheep = [place for number in range(9) for place in (number, -0.1 * number)]
    for agent in range(2):
        expected = [*np.eye(2)[agent], *info[agent], *info[1 - agent], 8.5, 0.4, *sheep]
        np.testing.assert_allclose(obs[agent], expected, atol=1e-6)


def test_sheep_walk_in_the_physics_as_the_law_says_and_stop_at_walls() -> None:
    env: Any = make(
        "go1sheep-easy", impl="c", control="position", restlessness=0.0, end_on_collision=False
    )
    step = jax.jit(env.step)

    def after(steps: int, robot: Any, sheep: Any) -> Any:
        places = [[*robot, 0.42], [0.5, -1.5, 0.42]]
        state = with_object(env, placed(env, places), "sheep0", sheep)
        for _ in range(steps):
            state = step(state, still(env))
        return env.sheep(state.data)[0]

    speed = 0.2 * 0.8 / 0.64**1.4 - 0.0981
    assert after(1, [1.2, 1.0], [2.0, 1.0])[0] == pytest.approx(2.0 + STEP * speed, abs=1e-3)
    # the side wall is at 2.0, the sheep's radius 0.2
    assert after(50, [2.0, 1.2], [2.0, 1.75])[1] < 1.85


def test_pushbox_rewards_and_success(box_env: Any) -> None:
    state = dataclasses.replace(initial(box_env), anchors=jnp.array([[4.5, 0.2]]))
    state = with_object(box_env, state, "box", [4.47, 0.2, 0.5, 1, 0, 0, 0])
    robots = box_env.read(state.data)
    no = jnp.array(False)
    ahead = with_object(box_env, state, "box", [4.49, 0.2, 0.5, 1, 0, 0, 0])
    reward = terms_of(box_env, state, ahead)[1]
    np.testing.assert_allclose(reward, [10 * 0.02] * 2, atol=1e-4)
    assert float(box_env.outcome(ahead, robots, no)["success"]) == 0
    behind = with_object(box_env, state, "box", [4.52, 0.2, 0.5, 1, 0, 0, 0])
    reward = terms_of(box_env, state, behind)[1]
    np.testing.assert_allclose(reward, [10 * 0.05 + 1] * 2, atol=1e-4)
    assert float(box_env.outcome(behind, robots, no)["success"]) == 1
    start = dataclasses.replace(
        behind, task=dataclasses.replace(behind.task, start=jnp.float32(2.2))
    )
    assert float(box_env.outcome(start, robots, no)["distance"]) == pytest.approx(2.32, abs=1e-4)


def test_pushbox_observation(box_env: Any) -> None:
    state = with_object(box_env, initial(box_env), "box", [3.0, 0.4, 0.5, 0.8, 0, 0, 0.6])
    obs = observation(box_env, state)
    info = np.asarray(box_env.read(state.data).base_info)
    for agent in range(2):
        expected = [
            *np.eye(2)[agent],
            *info[agent],
            *info[1 - agent],
            *np.asarray(state.anchors[0]),
        ]
        np.testing.assert_allclose(obs[agent], [*expected, 3.0, 0.4, 0.8, 0, 0, 0.6], atol=1e-6)


def test_sheep_rewards_easy_and_hard(herd: Any) -> None:
    easy = made("go1sheep-easy")
    state = dataclasses.replace(initial(easy), anchors=jnp.array([[5.0, 0.3]]))
    before = with_object(easy, state, "sheep0", [4.98, 0.3])
    after = with_object(easy, state, "sheep0", [5.01, 0.3])
    reward = terms_of(easy, before, after)[1]
    np.testing.assert_allclose(reward, [1 + 2 * 0.03] * 2, atol=1e-4)

    state = dataclasses.replace(initial(herd), anchors=jnp.array([[8.5, 0.0]]))
    # two are through; the others stand 3 m and 4 m away from the gate: hypot = 5
    for number in range(9):
        state = with_object(
            herd, state, f"sheep{number}", [8.6 + number, 0.0] if number < 2 else [5.5, 4.0]
        )
    reward = terms_of(herd, state, state)[1]
    np.testing.assert_allclose(reward, [2 + 7 * np.exp(-2.5)] * 2, atol=1e-4)
    for failed, share in ((False, 2 / 9), (True, 0.0)):
        outcome = herd.outcome(state, herd.read(state.data), jnp.array(failed))
        assert [float(x) for x in outcome.values()] == pytest.approx([share, 2 / 9])


def test_shaping_terms_of_sheep_dog(herd: Any) -> None:
    """Of two sheep that move, one passes the gate from 0.5 m before it, the other comes 1 m nearer
    to its centre.
    """
    before = dataclasses.replace(initial(herd), anchors=jnp.array([[8.5, 0.0]]))
    for number in range(9):
        before = with_object(herd, before, f"sheep{number}", [5.5, 4.0])  # 5 m away
    before = with_object(herd, before, "sheep0", [8.0, 0.0])
    after = with_object(herd, with_object(herd, before, "sheep0", [8.6, 0.0]), "sheep1", [6.1, 3.2])
    forth = terms_of(herd, before, after)[0]
    back = terms_of(herd, after, before)[0]
    assert float(forth["crossing"]) == 1 and float(forth["gathering"]) == pytest.approx(
        1.5, abs=1e-5
    )
    assert float(back["crossing"]) == -1 and float(back["gathering"]) == pytest.approx(
        -1.5, abs=1e-5
    )
    weights = herd.params.rewards
    assert weights.crossing == weights.gathering == weights.failure == 0
    fallen = placed(herd, [[2.0, -1.0, 0.5], [2.0, 1.0, 0.3]], angles(roll=(0.9, 0.0)))
    standing = placed(herd, [[2.0, -1.0, 0.3], [2.0, 1.0, 0.3]])
    moments = [Moment(state, herd.read(state.data)) for state in (standing, fallen)]
    failures = [
        herd.rewards(now, now, jnp.array(bump))["failure"]
        for now in moments
        for bump in (False, True)
    ]
    assert [bool(x) for x in failures] == [False, True, True, True]


def test_the_herd_starts_as_listed(herd: Any) -> None:
    states = jax.jit(jax.vmap(herd.reset))(jax.random.split(jax.random.PRNGKey(0), 16))
    sheep = np.asarray(jax.vmap(herd.sheep)(states.data))
    rows = np.stack(np.meshgrid([3.5, 5.0, 6.5], [-1.5, 0.0, 1.5], indexing="ij"), -1).reshape(9, 2)
    assert np.abs(sheep - rows).max() <= 0.3 and np.abs(sheep - rows).max() > 0.25
    assert herd.observation_size == 34
    assert np.all(np.abs(np.asarray(states.anchors)[:, 0] - [8.5, 0.0]) <= [0.0, 1.0])


@pytest.mark.parametrize(
    ("task", "share"),
    [
        ("go1gate", 0.9),
        *(
            pytest.param(task, 0.6, marks=pytest.mark.soak)
            for task in ("go1sheep-hard", "go1seesaw")
        ),
    ],
)
def test_the_scripted_policy_wins(task: str, share: float) -> None:
    from mqe_jax.acting.evaluate import evaluate_batch

    batch = VectorEnv(make(task, impl="c", num_envs=16), 16)
    plan = jax.vmap(scripted_policy(batch.env))
    result = evaluate_batch(
        batch, lambda obs, memory, _: (plan(obs), memory), 16, jax.random.PRNGKey(0)
    )
    assert result.to_dict()["success_rate"] >= share


def motor(spec: mujoco.MjSpec, name: str) -> None:
    spec.worldbody.add_body(name=name).add_joint(name=name)
    spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)


def weightless(spec: mujoco.MjSpec, name: str) -> None:
    spec.worldbody.add_body(name=name).add_freejoint()


def faster(spec: mujoco.MjSpec, name: str) -> None:
    spec.worldbody.add_body(name=name)
    spec.option.timestep = 0.001


@pytest.mark.parametrize(
    ("add", "message"),
    [
        (motor, r"objects: thing: Own.add\(\) changes the scene's actuators from 12 to 13"),
        (
            lambda spec, name: spec.worldbody.add_body(name=name, mocap=True),
            "mocap bodies from 0 to 1",
        ),
        (lambda spec, name: spec.delete(spec.actuator("robot0/FL_hip")), "actuators from 12 to 11"),
        (lambda spec, name: spec.worldbody.add_body(name="crate"), "adds no body 'object/thing'"),
        (faster, "timestep from 0.005 to 0.001"),
        (weightless, r"scene: MuJoCo rejects it \(Error: mass and inertia"),
    ],
)
def test_objects_that_engines_cannot_step_are_refused(add: Any, message: str) -> None:
    class Own(objects.Object):
        def add(self, spec: mujoco.MjSpec, name: str, visual: bool) -> None:
            add(spec, name)

    refuses(message, plain, thing=Own())
