"""The environment core against plain numpy: what is drawn, what is observed, who has fallen, what
is rewarded.
"""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax.envs import VectorEnv, make, replay
from mqe_jax.envs.autoreset import KEPT, SEEN, autoreset
from mqe_jax.envs.observation import others
from mqe_jax.envs.reward import crowding
from mqe_jax.physics import rotation
from mqe_jax.physics.robots.fleet import Fleet
from mqe_jax.physics.robots.go1 import GO1
from mqe_jax.physics.robots.index import Proprioception
from mqe_jax.skills.control import Controller
from tests.states import initial, made, moment, placed, stepper

KEY = jax.random.PRNGKey(0)


DRAWN: dict[str, Any] = {
    "friction": (0.5, 1.25),
    "payload": (-1.0, 3.0),
    "center_of_mass": (-0.02, 0.04),
}
DRAWN |= {
    "motor_strength": (0.7, 1.2),
    "joint_mechanics": (0.5, 2.0),
    "action_lag": 3,
    "motor_offset": 0.1,
}
DRAWN |= {"observation_noise": 0.05, "push": 0.4, "push_period": 0.1}


@pytest.fixture(scope="module")
def box() -> Any:
    params: dict[str, Any] = {
        "joint_mechanics": True,
        "gate_random": (0.3, 0.5),
        "spawn_joint_scale": (0.5, 2.5),
    }
    return make(
        "go1pushbox", impl="c", control="position", num_envs=1, randomization=DRAWN, **params
    )


@pytest.fixture(scope="module")
def resets(box: Any) -> Any:
    """2048 initial states with half of the assistance."""
    reset = jax.jit(jax.vmap(box.reset, (0, None)))
    return jax.tree.map(np.asarray, reset(jax.random.split(KEY, 2048), 0.5))


def uniform(columns: np.ndarray, names: list[str]) -> None:
    """Checks that columns (K, C) are uniform in [0, 1] and independent."""
    assert columns.min() >= -1e-5 and columns.max() <= 1 + 1e-5
    for column, name in zip(columns.T, names, strict=True):
        shares = np.histogram(column, 8, (0.0, 1.0))[0] / len(column)
        assert np.all(np.abs(shares - 1 / 8) < 0.035), f"{name}: {shares}"
    relation = np.corrcoef(columns.T) - np.eye(len(names))
    worst = np.unravel_index(np.abs(relation).argmax(), relation.shape)
    assert np.abs(relation).max() < 0.13, (
        f"{names[worst[0]]} and {names[worst[1]]}: {relation[worst]}"
    )


def test_everything_drawn_at_a_reset_is_uniform_and_independent(box: Any, resets: Any) -> None:
    index = box.index
    robot = box.robots[0]
    params = box.params
    qpos = resets.data.qpos
    qvel = resets.data.qvel
    drawn = resets.randomized
    spawn = np.array([place[:2] for place in box.spawn_poses()])
    joints = qpos[:, index.joint_qpos] / robot.default_joints
    calves = qpos[:, index.joint_qpos[:, 2::3]]  # factors of 0.5 and 2.5 bring them to their limits
    for found, limit in (
        (calves.min(axis=0), robot.joint_lower),
        (calves.max(axis=0), robot.joint_upper),
    ):
        np.testing.assert_allclose(found, np.tile(limit[2::3], (2, 1)), rtol=1e-6)
    hips = np.arange(12) % 3 < 2
    parts = {
        "gate": (resets.anchors[:, 0] - [4.5, 0.0]) / np.array([0.3, 0.5]) / 2 + 0.5,
        "spawn": (qpos[:, index.base_qpos[:, :2]] - spawn) / params.spawn_noise / 2 + 0.5,
        "joint": (joints[..., hips] - 0.5) / 2.0,
        "velocity": qvel[:, index.base_qvel] / params.spawn_velocity / 2 + 0.5,
        "box": (qpos[:, box.objects["box"].qpos[:2]] - [2.5, 0.0]) / 0.5 / 2 + 0.5,
        "frozen": (resets.frozen_steps.max(axis=1) + 0.5) / (0.5 * params.frozen_time / box.dt),
        "lag": (drawn.action_lag + 0.5) / 4,
        "motor_offset": drawn.motor_offset / 0.1 / 2 + 0.5,
    }
    for name in ("friction", "payload", "center_of_mass", "motor_strength", "joint_mechanics"):
        low, high = DRAWN[name]
        parts[name] = (getattr(drawn, name) - low) / (high - low)
    flat = {name: part.reshape(len(qpos), -1) for name, part in parts.items()}
    smooth = {name: part for name, part in flat.items() if name != "lag"}
    names = [f"{name}{i}" for name, part in smooth.items() for i in range(part.shape[1])]
    uniform(np.concatenate(list(smooth.values()), axis=1), names)
    assert np.abs(np.bincount(drawn.action_lag) / len(qpos) - 0.25).max() < 0.04
    assert 0.45 < (resets.frozen_steps[:, 0] > 0).mean() < 0.55
    np.testing.assert_allclose(qpos[:, index.base_qpos[:, 2]], params.spawn_height, rtol=1e-6)


def test_noise_on_observations_is_normal_and_independent(box: Any, resets: Any) -> None:
    exact = jax.jit(
        jax.vmap(lambda s: box.observation_layout.pack(box.observe(s, box.read(s.data))))
    )(resets)
    # none on the one-hots
    np.testing.assert_array_equal(resets.obs[..., :2], np.asarray(exact)[..., :2])
    noise = (resets.obs - np.asarray(exact))[..., 2:].reshape(len(resets.obs), -1) / 0.05
    assert np.abs(noise.mean(0)).max() < 0.12 and np.abs(noise.std(0) - 1).max() < 0.08
    relation = np.corrcoef(noise.T) - np.eye(noise.shape[1])
    assert np.abs(relation).max() < 0.13
    np.testing.assert_array_equal(resets.final_obs, resets.obs)


def test_randomised_parameters_reach_their_fields_of_the_model(box: Any, resets: Any) -> None:
    model = box.compiled.model
    index = box.index
    drawn = jax.tree.map(lambda x: x[3], resets.randomized)
    expected = {
        name: getattr(model, name).astype(np.float64).copy()
        for name in (
            "geom_friction",
            "body_mass",
            "body_inertia",
            "body_ipos",
            "actuator_gainprm",
            "actuator_biasprm",
        )
    }
    joints = ("dof_armature", "dof_damping", "dof_frictionloss")
    expected |= {name: getattr(model, name).copy() for name in joints}
    for robot in range(2):

        def part_name(part, robot=robot):
            return f"robot{robot}/{part}"

        trunk = model.body(part_name("trunk")).id
        ratio = 1 + drawn.payload[robot] / model.body_mass[trunk]
        expected["body_mass"][trunk] += drawn.payload[robot]
        expected["body_inertia"][trunk] *= ratio
        expected["body_ipos"][trunk] += drawn.center_of_mass[robot]
        for geom in range(model.ngeom):
            if model.geom(geom).name.startswith(part_name("")):
                expected["geom_friction"][geom, 0] = drawn.friction[robot]
        for number in range(model.nu):
            if model.actuator(number).name.startswith(part_name("")):
                expected["actuator_gainprm"][number] *= drawn.motor_strength[robot]
                expected["actuator_biasprm"][number] *= drawn.motor_strength[robot]
        for field in joints:
            expected[field][index.joint_qvel[robot]] *= drawn.joint_mechanics[robot]
    fields = box.randomizer.fields(drawn)
    assert set(fields) == set(expected)
    for name, value in expected.items():
        np.testing.assert_allclose(fields[name], value, rtol=1e-5, atol=1e-9, err_msg=name)


def test_pushes_are_uniform_and_independent(box: Any, resets: Any) -> None:
    """A fifth of the robots in a step of 0.02 s, as the period is 0.1 s."""
    start = jax.tree.map(lambda x: x[0], resets.data).replace(qvel=jnp.zeros(box.compiled.model.nv))
    push = jax.jit(jax.vmap(lambda key: box.randomizer.push(start, jnp.array(0.4), key, 0.02).qvel))
    qvel = np.asarray(push(jax.random.split(KEY, 1 << 16)))
    columns = box.index.base_qvel[:, :2]
    assert not np.delete(qvel, columns.ravel(), axis=1).any()
    change: np.ndarray = qvel[:, columns]
    pushed: Any = change.any(axis=-1)
    np.testing.assert_allclose(pushed.mean(axis=0), 0.2, atol=0.01)
    assert pushed.all(axis=1).mean() == pytest.approx(0.04, abs=0.005)  # each by chance
    both = change[pushed.all(axis=1)]
    uniform(both.reshape(len(both), 4) / 0.4 / 2 + 0.5, ["x0", "y0", "x1", "y1"])


def test_the_privileged_observation_has_everything_in_its_place() -> None:
    env: Any = make("go1pushbox", impl="c", num_envs=1, privileged_contact_forces=True)
    random = np.random.default_rng(0)
    model = env.compiled.model

    def normal(*shape):
        return jnp.asarray(random.normal(size=shape), jnp.float32)

    state = initial(env)
    data = state.data.replace(
        qpos=normal(model.nq), qvel=normal(model.nv), sensordata=normal(model.nsensordata)
    )
    drawn = jax.tree.map(lambda x: normal(*x.shape), state.randomized)
    drawn = dataclasses.replace(drawn, action_lag=jnp.int32(2))
    anchors = normal(1, 2)
    clock = normal(2, 2)
    state = dataclasses.replace(state, data=data, anchors=anchors, randomized=drawn)
    observe = jax.jit(lambda state: env.privileged.observe(env.read(state.data), state, clock))
    found = env.privileged_layout.split(observe(state))
    q = np.asarray(data.qpos)
    v = np.asarray(data.qvel)
    sensors = np.asarray(data.sensordata)
    expected: dict[str, Any] = {}

    def force(name):
        return np.linalg.norm(sensors[model.sensor(name + "_force").adr[0] :][:3])

    forces = []
    for robot in range(2):
        base = model.joint(f"robot{robot}/base")
        at = base.qposadr[0]
        of = base.dofadr[0]
        legs = [
            f"robot{robot}/{leg}_{joint}"
            for leg in ("FL", "FR", "RL", "RR")
            for joint in ("hip", "thigh", "calf")
        ]
        values = {
            "position": q[at : at + 3],
            "quaternion": q[at + 3 : at + 7],
            "linear_velocity": v[of : of + 3],
            "angular_velocity": v[of + 3 : of + 6],
            "joint_position": [q[model.joint(name).qposadr[0]] for name in legs]
            - env.robots[0].default_joints,
            "joint_velocity": [v[model.joint(name).dofadr[0]] for name in legs],
        }
        expected |= {f"robot{robot}/{name}": value for name, value in values.items()}
        trunk = [
            n
            for n in (model.sensor(i).name for i in range(model.nsensor))
            if n.startswith(f"robot{robot}/")
        ]
        trunk = [name.removesuffix("_force") for name in trunk if "foot" not in name]
        forces.append(max(force(name) for name in trunk))
        forces += [force(f"robot{robot}/{leg}_foot") for leg in ("FL", "FR", "RL", "RR")]
    item = env.objects["box"]
    expected |= {"objects/qpos": q[item.qpos], "objects/qvel": v[item.qvel]}
    expected |= {
        "anchors": anchors[0],
        "action_lag": [2.0],
        "gait_phase": np.ravel(clock),
        "contact_force": forces,
    }
    for name in ("friction", "payload", "center_of_mass", "motor_strength"):
        expected[name] = np.ravel(getattr(drawn, name))
    assert set(found) == set(expected)
    for name, value in expected.items():
        np.testing.assert_allclose(found[name], value, rtol=1e-5, atol=1e-6, err_msg=name)


def test_robots_fall_by_roll_and_pitch_of_either_sign_and_by_height() -> None:
    env: Any = make(
        "go1gate", impl="c", num_envs=1, max_roll=0.6, max_pitch=0.4, min_height=0.2, max_height=0.9
    )
    fallen = jax.jit(lambda data: env.fallen(env.read(data)))
    rows = (
        (0.59, 0.39, 0.21, False),
        (0.61, 0, 0.3, True),
        (-0.61, 0, 0.3, True),
        (0, 0.41, 0.3, True),
    )
    for roll, pitch, height, falls in (
        *rows,
        (0, -0.41, 0.3, True),
        (0, 0, 0.19, True),
        (0, 0, 0.91, True),
    ):
        position = [[1.0, 0.0, 0.5], [2.0, 0.0, height]]
        state = placed(env, position, [[0, 0, 0], [roll, pitch, 2.0]], state=initial(env))
        assert fallen(state.data).tolist() == [False, falls], (roll, pitch, height)


def test_a_state_diverges_beyond_1000_in_either_direction() -> None:
    env = made("go1plane")
    state = initial(env)
    x = int(env.index.base_qpos[1, 0])
    for size, wrong in ((999.0, False), (1001.0, True), (np.inf, True), (np.nan, True)):
        for sign in (1, -1):
            for field, place in (("qpos", x), ("qvel", 3), ("qvel", 17)):
                values = getattr(state.data, field).at[place].set(sign * size)
                assert bool(env._diverged(state.data.replace(**{field: values}))) == wrong, (
                    field,
                    size,
                )


def test_a_frozen_agent_acts_from_its_first_free_step_on() -> None:
    env = made("go1gate")
    step = stepper("go1gate")
    state = dataclasses.replace(initial(env), frozen_steps=jnp.array([0, 2], jnp.int32))
    neutral = np.asarray(env.controller.neutral)
    for number in range(4):
        state = step(state, jnp.ones((2, 12)))
        moved = np.abs(np.asarray(state.data.ctrl)[env.index.actuator] - neutral).max(axis=1) > 0.1
        assert moved.tolist() == [True, number >= 2]


def test_shaping_fades_with_the_assistance() -> None:
    weights: dict[str, Any] = {"rewards.approach": 2.0}
    env: Any = make(
        "go1wrestling", impl="c", control="position", num_envs=1, shaping_floor=0.2, **weights
    )
    for assistance in (0.0, 0.5, 1.0):
        state = dataclasses.replace(initial(env), assistance=jnp.float32(assistance))
        far = placed(env, [[3.1, -0.6, 0.7], [3.1, 0.6, 0.7]], state=state)
        near = placed(env, [[3.1, -0.5, 0.7], [3.1, 0.5, 0.7]], state=state)
        after = env.judge(moment(env, far), moment(env, near))
        assert float(after.metrics["reward/approach"]) == pytest.approx(
            0.4 * (0.2 + 0.8 * assistance), rel=1e-3
        )


@pytest.mark.parametrize("mode", ["position", "torque"])
def test_targets_are_scaled_actions_delayed_by_the_lag(mode: str) -> None:
    skill: Any = SimpleNamespace()
    controller = Controller(
        skill, (), np.zeros(0), {}, mode, Fleet([GO1] * 3), 2, (), lag=2, position_scale=1.5
    )
    still = Proprioception(jnp.zeros((3, 3)), jnp.zeros((3, 12)), jnp.zeros((3, 12)))
    actions = jax.random.uniform(KEY, (4, 2, 12), minval=-1.0)
    scale, offset = (
        (GO1.torque_limit, 0.0)
        if mode == "torque"
        else (1.5 * GO1.action_scale, GO1.default_joints)
    )
    for lag in (0, 1, 2):
        state = controller.reset()
        for number, action in enumerate(actions):
            target, state = controller.targets(state, action, still, lag=lag)
            given = np.asarray(actions[number - lag]) if number >= lag else np.zeros((2, 12))
            np.testing.assert_allclose(target[:2], offset + scale * given, rtol=1e-5, atol=1e-6)
            # an NPC robot keeps its joints
            np.testing.assert_allclose(target[2], GO1.default_joints, rtol=1e-6)


def test_rotations_are_those_of_matrices() -> None:
    random = np.random.default_rng(0)
    euler = random.uniform([-3, -1.5, -3], [3, 1.5, 3], (20, 3))
    quaternion = rotation.euler_to_quaternion(jnp.asarray(euler, jnp.float32))
    np.testing.assert_allclose(rotation.quaternion_to_euler(quaternion), euler, atol=1e-4)
    vectors = random.normal(size=(20, 3))
    for angles, q, vector in zip(euler, np.asarray(quaternion), vectors, strict=True):
        (a, b, c) = np.cos(angles)
        (s, t, u) = np.sin(angles)
        about_x = np.array([[1, 0, 0], [0, a, -s], [0, s, a]])
        about_y = np.array([[b, 0, t], [0, 1, 0], [-t, 0, b]])
        matrix = np.array([[c, -u, 0], [u, c, 0], [0, 0, 1]]) @ about_y @ about_x
        np.testing.assert_allclose(
            rotation.rotate(jnp.asarray(q), jnp.asarray(vector)), matrix @ vector, atol=1e-5
        )
        back = rotation.rotate_inverse(jnp.asarray(q), jnp.asarray(vector))
        np.testing.assert_allclose(back, matrix.T @ vector, atol=1e-5)


def test_an_ended_episode_is_replaced_whole_and_another_one_left_alone() -> None:
    env = made("go1tug")
    state = initial(env)
    other = jax.tree.map(
        lambda x: x + np.float32(0.5) if x.dtype == np.float32 else x, jax.device_get(state)
    )
    fresh = dataclasses.replace(
        jax.tree.map(jnp.asarray, other), step=jnp.int32(3), key=jax.random.PRNGKey(9)
    )
    for ended in (True, False):
        now = dataclasses.replace(state, truncated=jnp.array(ended), step=jnp.int32(7))
        after = autoreset(env, now, lambda key, assistance: fresh)
        seen = env.with_observations(after)  # what is left is observed
        for field in dataclasses.fields(after):
            source = (
                seen if field.name in SEEN else fresh if ended and field.name not in KEPT else now
            )
            expected = getattr(source, field.name)
            if field.name == "data":
                for (
                    name
                ) in "qpos qvel qacc_warmstart ctrl mocap_pos sensordata xfrc_applied time".split():
                    np.testing.assert_array_equal(
                        getattr(after.data, name), getattr(expected, name), err_msg=name
                    )
            elif field.name != "key":
                jax.tree.map(np.testing.assert_array_equal, getattr(after, field.name), expected)
        assert after.key.tolist() != now.key.tolist() and float(after.assistance) == float(
            now.assistance
        )


def test_other_agents_rows_follow_in_order() -> None:
    rows = jnp.arange(8.0).reshape(4, 2)
    expected = [
        [x for other in range(4) if other != agent for x in (2 * other, 2 * other + 1)]
        for agent in range(4)
    ]
    np.testing.assert_array_equal(others(rows), expected)


def test_crowding_by_hand() -> None:
    """Pairs at 0.3 m and at 0.49 m, one at 0.05 m, which counts as 0.1 m, and one at 0.51 m, which
    does not.
    """
    place = jnp.array([[0.0, 0.0], [0.3, 0.0], [0.3, 0.49], [5.0, 0.0], [5.05, 0.0], [5.56, 0.0]])
    active = jnp.arange(7) < 6
    place = jnp.concatenate([place, place[:1]])  # the last one takes no part
    assert float(crowding(place, active)) == pytest.approx(
        2 * (1 / 0.09 + 1 / 0.49**2 + 100), rel=1e-4
    )


def test_places_behind_the_box_are_one_for_each_robot() -> None:
    env = made("go1pushbox")
    random = np.random.default_rng(0)
    for _ in range(5):
        position = random.uniform([1, -1, 0.3], [3, 1, 0.3], (2, 3))
        box = random.uniform([2, -1], [4, 1])
        state = placed(env, position, objects={"box": [*box, 0.5, 1, 0, 0, 0]})
        state = dataclasses.replace(state, anchors=jnp.array([[4.5, 0.3]]))
        behind, aside = env.distances(moment(env, state))
        places = box + np.array([[-0.8, -0.25], [-0.8, 0.25]])
        assert float(behind) == pytest.approx(
            np.linalg.norm(position[:, :2] - places, axis=1).sum(), rel=1e-4
        )
        assert float(aside) == pytest.approx(abs(box[1] - 0.3), abs=1e-5)


def test_a_robot_below_the_opponents_platform_is_not_across() -> None:
    env = made("go1bridge")
    for height, across in ((1.3, True), (1.0, False)):
        state = placed(env, [[7.5, 0.0, height], [6.0, 0.0, 1.3]])
        assert env.across(env.read(state.data)).tolist() == [across, False]


def test_time_limits_are_whole_steps() -> None:
    """0.58 s are 28.99999 steps of 0.02 s in floating point."""
    lengths = (0.58, 0.57, 0.05)
    assert [
        make("go1plane", impl="c", num_envs=1, episode_length=x).max_steps for x in lengths
    ] == [29, 28, 2]


def test_a_recording_has_the_steps_of_the_last_episode(tmp_path: Path) -> None:
    env = made("go1plane")
    for steps, kept in (
        ([3, 4, 0, 1, 0, 1, 2], 3),
        ([5, 6, 7], 3),
        ([0, 1], 2),
        ([7, 8, 9, 3, 4, 5], 3),
    ):
        states = jax.tree.map(lambda x: np.broadcast_to(x, (len(steps), *x.shape)), initial(env))  # noqa: B023
        states = dataclasses.replace(states, step=jnp.array(steps))
        actions = jnp.arange(len(steps) * 24.0).reshape(len(steps), 2, 12)
        replay.save_recording(tmp_path / "some.npz", env, states, actions[:, : env.num_agents])
        found = replay.load_recording(tmp_path / "some.npz")
        np.testing.assert_array_equal(found.states["step"], steps[-kept:])
        np.testing.assert_array_equal(found.actions, actions[-kept:, : env.num_agents])


def test_environments_of_a_batch_start_differently() -> None:
    env = VectorEnv(made("go1plane"), 64)
    state = jax.jit(env.reset)(KEY)
    qpos = np.asarray(state.data.qpos)[:, env.env.index.base_qpos[0, :2]]
    assert (
        len(np.unique(qpos[:, 0])) == 64
        and abs(np.corrcoef(qpos[:-1, 0], qpos[1:, 0])[0, 1]) < 0.45
    )
    assert len({tuple(key) for key in state.key.tolist()}) == 64
