"""The cooperative tasks on states made by hand, and endings of every task; motion of boxes, balls,
sheep and the defender.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mqe_jax.envs import TASKS, Moment, QuadrupedEnv, State, VectorEnv, make
from mqe_jax.envs.reward import weigh
from mqe_jax.npc import defend
from mqe_jax.physics import objects
from mqe_jax.physics.robots.index import RobotState
from mqe_jax.physics.scene import Scene, compile_scene
from mqe_jax.policies.scripted import scripted_policy
from mqe_jax.terrain import Plane, SpawnArea, Track
from tests.inputs import refuses
from tests.states import (
    angles,
    ending,
    initial,
    made,
    moving,
    observation,
    placed,
    robot_state,
    stepped,
    still,
    terms_of,
    with_object,
)

gate = pytest.fixture(scope="module")(lambda: made("go1gate"))


def test_gate_observation_is_what_the_paper_lists(gate: QuadrupedEnv) -> None:
    both = robot_state([[1.0, 2.0, 0.3], [4.0, 5.0, 0.6]], yaw=(0.1, 0.2))
    state = dataclasses.replace(initial(gate), anchors=jnp.array([[3.4, 0.2]]))
    obs = gate.observation_layout.pack(gate.observe(state, both))
    first = [1, 0, 1, 2, 0.3, 0, 0, 0.1, 4, 5, 0.6, 0, 0, 0.2, 3.4, 0.2]
    second = [0, 1, 4, 5, 0.6, 0, 0, 0.2, 1, 2, 0.3, 0, 0, 0.1, 3.4, 0.2]
    np.testing.assert_allclose(obs, [first, second], atol=1e-6)


def test_gate_rewards_add_up_as_worked_out_by_hand(gate: QuadrupedEnv) -> None:
    before = robot_state([[3.5, 0.75, 0.3], [3.5, 0.35, 0.3]])
    # Targets are (5.5, 0.75) and (5.5, -0.75): the first is 2 m away, the second hypot(2, 1.1) m.
    state = dataclasses.replace(initial(gate), anchors=jnp.array([[3.5, 0.0]]))
    after = robot_state([[3.8, 0.78, 0.3], [3.5, 0.35, 0.3]])
    terms = gate.rewards(Moment(state, before), Moment(state, after), jnp.array(True))
    assert float(terms["success"]) == 1  # 0.3 m past the gate; the other stands in it
    assert float(terms["approach"]) == pytest.approx(2 - np.hypot(1.7, 0.03), abs=1e-5)
    # hypot(0.3, 0.43) = 0.524 m apart, which is not closer than 0.5 m
    assert float(terms["crowding"]) == 0
    reward, logged = weigh(terms, gate.params.rewards, gate.teams, jnp.ones(2, bool))
    np.testing.assert_allclose(reward, [5 + 0.29974 - 2] * 2, atol=1e-4)
    close = robot_state([[3.6, 0.6, 0.3], [3.6, 0.4, 0.3]])
    near = gate.rewards(Moment(state, after), Moment(state, close), jnp.array(False))
    assert float(near["crowding"]) == pytest.approx(2 / 0.2**2, rel=1e-4)
    closer = np.hypot(1.7, 0.03) - np.hypot(1.9, 0.15) + np.hypot(2.0, 1.1) - np.hypot(1.9, 1.15)
    assert float(near["collision"]) == 0 and float(near["approach"]) == pytest.approx(
        closer, abs=1e-5
    )
    assert float(logged["average_step_reward"]) == pytest.approx(3.29974, abs=1e-4)


def test_gate_success_needs_both_through_and_no_failure(gate: QuadrupedEnv) -> None:
    state = dataclasses.replace(initial(gate), anchors=jnp.array([[3.5, 0.0]]))
    both = robot_state([[3.8, 0, 0.3], [4.5, 0, 0.3]])
    one = robot_state([[3.8, 0, 0.3], [3.7, 0, 0.3]])
    fine = jnp.array(False)
    assert float(gate.outcome(state, both, fine)["success"]) == 1
    assert float(gate.outcome(state, both, ~fine)["success"]) == 0
    assert float(gate.outcome(state, one, fine)["success"]) == 0
    assert float(gate.outcome(state, one, fine)["one"]) == 1


def ground_height(env: Any, x: float, y: float) -> float:
    """Height of the ground or object below (x, y), m."""
    model = env.compiled.model
    data = mujoco.MjData(env.compiled.model)
    data.qpos[env.index.base_qpos[:, 2]] = 50.0
    mujoco.mj_kinematics(model, data)
    geom = np.zeros(1, np.int32)
    return 5.0 - mujoco.mj_ray(
        model, data, np.array([x, y, 5.0]), np.array([0, 0, -1.0]), None, 1, -1, geom
    )


@pytest.mark.parametrize("task", list(TASKS))
def test_endings(task: str) -> None:
    env = made(task)
    pose = np.array(env.spawn_poses())
    height = [ground_height(env, x, y) + env.robots[0].stand_height + 0.01 for x, y, _ in pose]
    position = np.c_[pose[:, :2], height]
    euler = np.c_[np.zeros((len(pose), 2)), pose[:, 2]]

    after = stepped(env, placed(env, position, euler))
    assert not after.terminated and not after.truncated and not ending(after)

    late = dataclasses.replace(placed(env, position, euler), step=jnp.int32(env.max_steps - 1))
    after = stepped(env, late)
    assert after.truncated and not after.terminated and ending(after) == ["time_limit"]

    rolled = euler.copy()
    high = position.copy()
    rolled[-1, 0] = env.params.max_roll + 0.1
    high[-1, 2] = high[-1, 2] + 0.5
    for start in (placed(env, high, rolled), placed(env, high, rolled, state=late)):
        after = stepped(env, start)
        assert after.terminated and ending(after) == ["fall"]
    rolled[-1, 0] = env.params.max_roll - 0.1
    assert not stepped(env, placed(env, high, rolled)).terminated

    # The first robot's trunk lies across the second's: they touch.
    if len(pose) > 1:
        touching = position.copy()
        across = euler.copy()
        touching[0] = touching[1] + [0.0, 0.0, 0.09]
        across[0, 2] = pose[1, 2] + np.pi / 2
        bumped = stepped(env, placed(env, touching, across))
        assert bool(bumped.metrics["collision"])
        assert bool(bumped.terminated) == env.params.end_on_collision
        assert ending(bumped) == ["collision"] * env.params.end_on_collision


def test_only_the_cooperative_tasks_of_two_robots_end_on_a_collision() -> None:
    found = {task for task in TASKS if made(task).params.end_on_collision}
    assert found == {"go1gate", "go1seesaw", "go1sheep-easy", "go1sheep-hard"}


SPAWN = [[1.0, -0.75, 0.31], [1.0, 0.75, 0.31]]


@pytest.mark.parametrize(("task", "ceiling"), [("go1gate", True), ("go1seesaw", False)])
def test_roll_and_a_bump_into_a_wall_end_pitch_does_not_and_height_in_the_gate(
    task: str, ceiling: bool
) -> None:
    env = made(task)
    for height, euler, ends in (
        (0.9, angles(roll=(0.9, 0.0)), True),
        (0.9, angles(pitch=(1.2, 0.0)), False),
        (1.6, angles(), ceiling),
    ):
        assert stepped(env, placed(env, [[1.0, -0.75, height], SPAWN[1]], euler)).terminated == ends
    # the head against the back wall
    at_wall = placed(env, [[0.33, -0.75, 0.31], SPAWN[1]], angles(yaw=(np.pi, 0.0)))
    bumped = stepped(env, moving(env, at_wall, [-1.5, 0.0, 0.0]))
    assert bumped.terminated and float(bumped.metrics["reward/collision"]) == -2


# -- Climb on Seesaw


env = pytest.fixture(scope="module")(lambda: made("go1seesaw"))


def on_plank(x: float, height: float = 0.31) -> list[float]:
    """Where a robot stands on the plank that rests on the ground, m."""
    return [x, 0.0, 0.545 + (x - 5.6) * np.tan(0.25) + 0.015 + height / np.cos(0.25)]


def angle(env: Any, state: State) -> float:
    return float(state.data.qpos[env.objects["seesaw"].qpos[0]])


def test_the_scene_is_as_listed(env: Any) -> None:
    model = env.compiled.model
    data = mujoco.MjData(env.compiled.model)
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 16))
    start = np.asarray(states.data.qpos)[:, env.index.base_qpos[:, :3]]
    assert np.abs(start - [[1.0, -0.75, 0.42], [1.0, 0.75, 0.42]]).max((0, 1)) == pytest.approx(
        [0.1, 0.1, 0], abs=0.02
    )
    assert env.params.gait == "pace" and env.params.episode_length == 10
    assert (
        env.compiled.layout.anchors == ()
        and env._scene.track.length == 10
        and env._scene.track.width == 3
    )

    plank = env.objects["seesaw"]
    platform = env.objects["platform"]
    data.qpos[:] = states.data.qpos[0]
    mujoco.mj_kinematics(model, data)
    half = model.geom_size[plank.geom]
    turn = data.geom_xmat[plank.geom].reshape(3, 3)
    ends = (
        data.geom_xpos[plank.geom]
        + np.array([[-half[0], 0, half[2]], [half[0], 0, half[2]]]) @ turn.T
    )
    assert 2 * half == pytest.approx([4.123, 1.0, 0.03])
    assert ends[0] == pytest.approx([3.5, 0.0, 0.02], abs=0.01)  # the near end: a step of 2 cm
    # the far end, just above the platform
    assert ends[1] == pytest.approx([7.5, 0.0, 1.045], abs=0.01)
    low = data.geom_xpos[platform.geom] + (-1) * model.geom_size[platform.geom]
    high = data.geom_xpos[platform.geom] + 1 * model.geom_size[platform.geom]
    assert low == pytest.approx([7.5, -0.5, 0.97]) and high == pytest.approx([8.5, 0.5, 1.0])


def test_observation(env: Any) -> None:
    both = robot_state([[1.0, 2.0, 0.3], [4.0, 5.0, 0.6]], pitch=(-0.2, 0.0), yaw=(0.0, 0.4))
    obs = env.observation_layout.pack(env.observe(initial(env), both))
    first = [1, 2, 0.3, 0, -0.2, 0]
    second = [4, 5, 0.6, 0, 0, 0.4]
    np.testing.assert_allclose(obs, [[1, 0, *first, *second], [0, 1, *second, *first]], atol=1e-6)
    assert env.observation_size == 14


def test_rewards_add_up_as_worked_out_by_hand(env: Any) -> None:
    no = jnp.array(False)
    yes = jnp.array(True)
    before = Moment(initial(env), robot_state([[7.70, 0, 0.3], [3.90, 0, 0.3]]))

    def reward(after: RobotState, collision: Any = no) -> tuple[Any, Any]:
        terms = env.rewards(before, Moment(initial(env), after), collision)
        total, logged = weigh(terms, env.params.rewards, env.teams, jnp.ones(2, bool))
        assert float(logged["average_step_reward"]) == float(total[0]) == float(total[1])
        return total[0], terms

    # One stands on the platform: heights 1.3 + 0.45 - 0.56; ways 0.02 - 0.01; squares 0.01 + 0.04 -
    # 0.5.
    up = robot_state([[7.72, 0.1, 1.3], [3.89, -0.2, 0.45]])
    assert float(reward(up)[0]) == pytest.approx(10 + 1.19 + 5 * 0.01 + 0.5 * 0.45, abs=1e-4)
    assert float(reward(up, yes)[0]) == pytest.approx(11.465 - 2, abs=1e-4)
    # Before the platform, or too low: nothing for success. Both on it: twice.
    for position, count in (
        ([[7.68, 0, 1.3], [3.9, 0, 0.4]], 0),
        ([[7.8, 0, 1.15], [3.9, 0, 0.4]], 0),
        ([[7.8, 0, 1.3]] * 2, 2),
    ):
        assert float(reward(robot_state(position))[1]["success"]) == count
    # A fall, by roll and by nothing less.
    assert float(reward(robot_state(SPAWN, roll=(0.0, 0.81)))[1]["fall"]) == 1
    assert float(reward(robot_state(SPAWN, roll=(-0.79, 0.0), pitch=(0.9, 0.0)))[1]["fall"]) == 0
    fallen = robot_state([[7.70, 0.5, 0.28], [3.90, -0.5, 0.28]], roll=(0.9, 0.0))
    assert float(reward(fallen)[0]) == pytest.approx(-2, abs=1e-4)
    # 0.3 m and 0.4 m from each other is 0.5 m, which is not closer; 0.4 m is: -0.25 / 0.16.
    assert float(reward(robot_state([[4.0, 0, 0.3], [4.31, 0.4, 0.3]]))[1]["crowding"]) == 0
    close = robot_state([[7.70, 0.5, 0.28], [7.30, 0.5, 0.28]])
    assert float(reward(close)[0]) == pytest.approx(5 * (7.30 - 3.90) - 0.25 / 0.16, abs=1e-3)


def test_success_is_a_robot_on_the_platform_that_did_not_fail(env: Any) -> None:
    fine = jnp.array(False)
    up = robot_state([[3.9, 0, 0.45], [8.0, 0, 1.3]])
    below = robot_state([[3.9, 0, 0.45], [8.0, 0, 0.3]])
    assert float(env.outcome(initial(env), up, fine)["success"]) == 1
    assert float(env.outcome(initial(env), up, ~fine)["success"]) == 0
    assert float(env.outcome(initial(env), below, fine)["success"]) == 0
    assert float(env.outcome(initial(env), up, fine)["height"]) == pytest.approx(1.3)


def test_a_fall_costs_and_a_trunk_too_low_ends_without_a_cost(env: Any) -> None:
    rolled = stepped(env, placed(env, [[1.0, -0.75, 1.6], SPAWN[1]], angles(roll=(0.9, 0.0))))
    assert rolled.terminated and float(rolled.metrics["reward/fall"]) == -2
    # Legs upwards, so that nothing but the trunk is near the ground, which it does not touch yet.
    low = placed(env, [[1.0, -0.75, 0.075], SPAWN[1]])
    qpos = low.data.qpos.at[env.index.joint_qpos[0, 1::3]].set(np.pi)
    low = stepped(env, dataclasses.replace(low, data=low.data.replace(qpos=qpos)))
    assert (
        low.terminated
        and float(low.metrics["collision"]) == 0
        and float(low.metrics["reward/fall"]) == 0
    )


def test_robots_hold_and_tip_the_plank_and_stand_on_the_platform(env: Any) -> None:
    def stand(first: Any, second: Any, pitch: Any) -> State:
        after = placed(env, [first, second], angles(pitch=pitch))
        for _ in range(30):
            after = stepped(env, after)
        return after

    held = stand(on_plank(7.0), on_plank(3.9), (-0.25, -0.25))
    assert angle(env, held) < -0.245
    tipped = stand(on_plank(7.0), SPAWN[1], (-0.25, 0.0))
    assert angle(env, tipped) > -0.22
    up = stand([8.0, 0.0, 1.31], SPAWN[1], (0.0, 0.0))
    assert float(up.outcome.success[0]) == 1 and angle(env, up) == pytest.approx(-0.25, abs=1e-3)
    assert float(env.read(up.data).position_w[0, 2]) == pytest.approx(1.3, abs=0.03)


# -- objects and NPCs


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
