"""Climb on Seesaw: its scene, observation, rewards and endings on states made by hand, and the plank's physics."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mqe_jax import objects
from mqe_jax.envs import Moment, State, make
from mqe_jax.envs.reward import weigh
from mqe_jax.objects import Door, Seesaw
from mqe_jax.planners.cooperative import plan_seesaw, plan_seesaw_alone
from mqe_jax.robots.index import RobotState
from mqe_jax.scene import Scene, compile_scene
from mqe_jax.terrain import Plane, SpawnArea, Track
from tests.states import angles, initial, made, moving, placed, robot_state, stepper

SPAWN = [[1.0, -0.75, 0.31], [1.0, 0.75, 0.31]]
WEIGHT = 11.31 * objects.GRAVITY  # N, of a Go1


@pytest.fixture(scope="module")
def env() -> Any:
    return made("go1seesaw")


@pytest.fixture(scope="module")
def step(env: Any) -> Any:
    return stepper(env.name)


@pytest.fixture(scope="module")
def fresh(env: Any) -> State:
    return initial(env)


def on_plank(x: float, height: float = 0.31) -> list[float]:
    """Where a robot stands on the plank that rests on the ground, m."""
    return [x, 0.0, 0.545 + (x - 5.6) * np.tan(0.25) + 0.015 + height / np.cos(0.25)]


def angle(env: Any, state: State) -> float:
    """Of the plank, rad."""
    return float(env.object_pose(state.data, "seesaw")[0])


def test_the_scene_is_as_listed(env: Any) -> None:
    model, data = env.compiled.model, mujoco.MjData(env.compiled.model)
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 16))
    start = np.asarray(states.data.qpos)[:, env.index.base_qpos[:, :3]]
    assert np.abs(start - [[1.0, -0.75, 0.42], [1.0, 0.75, 0.42]]).max((0, 1)) == pytest.approx([0.1, 0.1, 0], abs=0.02)
    assert env.params.gait == "pace" and env.params.episode_length == 10
    assert env.compiled.layout.anchors == () and env._scene.track.length == 10 and env._scene.track.width == 3

    plank, platform = env.objects["seesaw"], env.objects["platform"]
    data.qpos[:] = states.data.qpos[0]
    mujoco.mj_kinematics(model, data)
    half, turn = model.geom_size[plank.geom], data.geom_xmat[plank.geom].reshape(3, 3)
    ends = data.geom_xpos[plank.geom] + np.array([[-half[0], 0, half[2]], [half[0], 0, half[2]]]) @ turn.T
    assert 2 * half == pytest.approx([4.123, 1.0, 0.03])
    assert ends[0] == pytest.approx([3.5, 0.0, 0.02], abs=0.01)  # the near end: a step of 2 cm
    assert ends[1] == pytest.approx([7.5, 0.0, 1.045], abs=0.01)  # the far end, just above the platform
    low, high = (data.geom_xpos[platform.geom] + side * model.geom_size[platform.geom] for side in (-1, 1))
    assert low == pytest.approx([7.5, -0.5, 0.97]) and high == pytest.approx([8.5, 0.5, 1.0])


def test_what_turns_has_its_centre_of_mass_in_its_hinge(env: Any) -> None:
    scenes = [(env.compiled, "seesaw", 100.0)]
    door = Door(position=(2.6, 0.3))
    scenes.append(
        (compile_scene(Scene(Track((SpawnArea(2.0), Plane(8.0))), num_robots=1, objects={"door": door})), "door", 4.0)
    )
    for compiled, name, mass in scenes:
        model, body = compiled.model, compiled.objects[name].body
        assert model.body_mass[body] == mass
        np.testing.assert_array_equal(model.body_ipos[body], [0, 0, 0])
    assert env.compiled.model.body_inertia[env.objects["seesaw"].body][1] == 100.0


def test_observation(env: Any, fresh: State) -> None:
    both = robot_state([[1.0, 2.0, 0.3], [4.0, 5.0, 0.6]], pitch=(-0.2, 0.0), yaw=(0.0, 0.4))
    obs = env.observation_layout.pack(env.observe(fresh, both))
    first, second = [1, 2, 0.3, 0, -0.2, 0], [4, 5, 0.6, 0, 0, 0.4]
    np.testing.assert_allclose(obs, [[1, 0, *first, *second], [0, 1, *second, *first]], atol=1e-6)
    assert env.observation_size == 14


def test_rewards_add_up_as_worked_out_by_hand(env: Any, fresh: State) -> None:
    no, yes = jnp.array(False), jnp.array(True)
    before = Moment(fresh, robot_state([[7.70, 0, 0.3], [3.90, 0, 0.3]]))

    def reward(after: RobotState, collision: Any = no) -> tuple[Any, Any]:
        terms = env.rewards(before, Moment(fresh, after), collision)
        total, logged = weigh(terms, env.params.rewards, 2)
        assert float(logged["average_step_reward"]) == float(total[0]) == float(total[1])
        return total[0], terms

    # One stands on the platform: heights 1.3 + 0.45 - 0.56; ways 0.02 - 0.01; squares 0.01 + 0.04 - 0.5.
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


def test_success_is_a_robot_on_the_platform_that_did_not_fail(env: Any, fresh: State) -> None:
    fine = jnp.array(False)
    up, below = robot_state([[3.9, 0, 0.45], [8.0, 0, 1.3]]), robot_state([[3.9, 0, 0.45], [8.0, 0, 0.3]])
    assert float(env.outcome(fresh, up, fine)["success"]) == 1
    assert float(env.outcome(fresh, up, ~fine)["success"]) == 0
    assert float(env.outcome(fresh, below, fine)["success"]) == 0
    assert float(env.outcome(fresh, up, fine)["success/height"]) == pytest.approx(1.3)


def test_endings(env: Any, step: Any, fresh: State) -> None:
    """A fall, a trunk too low, a collision and the time limit end an episode; standing, also high up, does not."""
    still = jnp.zeros((2, 12))
    stand = placed(env, SPAWN, state=fresh)
    after = step(stand, still)
    assert not after.terminated and not after.truncated
    late = step(dataclasses.replace(stand, step=jnp.int32(env.max_steps - 1)), still)
    assert late.truncated and not late.terminated
    high = [[1.0, -0.75, 1.6], SPAWN[1]]
    assert not step(placed(env, high, state=fresh), still).terminated
    assert not step(placed(env, high, angles(pitch=(1.2, 0.0)), state=fresh), still).terminated
    rolled = step(placed(env, high, angles(roll=(0.9, 0.0)), state=fresh), still)
    assert rolled.terminated and float(rolled.metrics["reward/fall"]) == -2
    turned = [[0.0, 0.0, np.pi], [0.0, 0.0, 0.0]]  # the head against the back wall
    at_wall = placed(env, [[0.33, -0.75, 0.31], SPAWN[1]], turned, state=fresh)
    bumped = step(moving(env, at_wall, [-1.5, 0.0, 0.0]), still)
    assert bumped.terminated and float(bumped.metrics["reward/collision"]) == -2
    # Legs upwards, so that nothing but the trunk is near the ground, which it does not touch yet.
    low = placed(env, [[1.0, -0.75, 0.075], SPAWN[1]], state=fresh)
    qpos = low.data.qpos.at[env.index.joint_qpos[0, 1::3]].set(np.pi)
    low = step(dataclasses.replace(low, data=low.data.replace(qpos=qpos)), still)
    assert low.terminated and float(low.metrics["collision"]) == 0 and float(low.metrics["reward/fall"]) == 0


def plank() -> Any:
    scene = compile_scene(
        Scene(Track((SpawnArea(2.0), Plane(8.0)), walled=False), num_robots=1, objects={"seesaw": Seesaw()})
    )
    return scene.model, scene.objects["seesaw"]


@pytest.mark.parametrize("start", [-0.25, 0.0, 0.1])
def test_an_untouched_plank_stays_as_it_is(start: float) -> None:
    model, index = plank()
    data = mujoco.MjData(model)
    data.qpos[index.qpos] = start
    mujoco.mj_step(model, data, 2000)
    assert data.qpos[index.qpos[0]] == pytest.approx(start, abs=1e-6)


@pytest.mark.parametrize("place", [-1.7, 0.5, 1.9])
def test_a_weight_beyond_the_hinge_tips_the_plank_slowly(place: float) -> None:
    """Damping 1000 N m s/rad: the weight of a Go1 1.9 m beyond the hinge turns it at 0.21 rad/s, which is its limit."""
    model, index = plank()
    data = mujoco.MjData(model)
    data.qpos[index.qpos] = -0.25
    speed = []
    for _ in range(600):  # 3 s
        lever = place * np.cos(data.qpos[index.qpos[0]])
        data.xfrc_applied[index.body] = [0, 0, -WEIGHT, 0, WEIGHT * lever, 0]
        mujoco.mj_step(model, data)
        speed.append(data.qvel[index.qvel[0]])
    if place < 0:
        assert data.qpos[index.qpos[0]] == pytest.approx(-0.254, abs=2e-3)
    else:
        assert max(speed) == pytest.approx(WEIGHT * place / 1000, rel=0.05) and max(speed) < 0.22
        assert data.qpos[index.qpos[0]] == pytest.approx(min(0.254, -0.25 + 3 * WEIGHT * place / 1000), abs=0.02)


def test_robots_hold_and_tip_the_plank_and_stand_on_the_platform(env: Any, step: Any, fresh: State) -> None:
    still = jnp.zeros((2, 12))

    def stand(first: Any, second: Any, pitch: Any) -> State:
        after = placed(env, [first, second], angles(pitch=pitch), state=fresh)
        for _ in range(30):
            after = step(after, still)
        return after

    held = stand(on_plank(7.0), on_plank(3.9), (-0.25, -0.25))
    assert angle(env, held) < -0.245
    tipped = stand(on_plank(7.0), SPAWN[1], (-0.25, 0.0))
    assert angle(env, tipped) > -0.22
    up = stand([8.0, 0.0, 1.31], SPAWN[1], (0.0, 0.0))
    assert float(up.metrics["success"]) == 1 and angle(env, up) == pytest.approx(-0.25, abs=1e-3)
    assert float(env.read(up.data).position_w[0, 2]) == pytest.approx(1.3, abs=0.03)


def test_the_planner_wins_with_a_partner_and_never_alone() -> None:
    """Through the walk policy, in a few environments; examples/alone.py measures many."""
    env, count = make("go1seesaw", impl="c", num_envs=20), 10
    partner = (jnp.arange(2 * count) < count)[:, None, None]
    layout = env.observation_layout

    def one_step(carry: Any, _: None) -> Any:
        state, over, won = carry
        blocks = layout.split(state.obs)
        action = jnp.where(partner, jax.vmap(plan_seesaw)(blocks), jax.vmap(plan_seesaw_alone)(blocks))
        state = jax.vmap(env.step)(state, action)
        ends = (state.terminated | state.truncated) & ~over
        return (state, over | ends, won | (ends & (state.metrics["success"] > 0))), None

    @jax.jit
    def play(key: jax.Array) -> Any:
        no = jnp.zeros(2 * count, bool)
        state = jax.vmap(env.reset)(jax.random.split(key, 2 * count))
        return jax.lax.scan(one_step, (state, no, no), None, env.max_steps)[0]

    _, over, won = play(jax.random.PRNGKey(0))
    assert np.asarray(over).all()
    assert np.asarray(won)[:count].mean() >= 0.7 and not np.asarray(won)[count:].any()
