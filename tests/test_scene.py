"""Robots and motors: compiled models, robots as data, torque-speed curves and limits on every
engine, payloads.
"""

import dataclasses
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

from mqe_jax.envs import VectorEnv, make
from mqe_jax.envs.plane import Go1Plane
from mqe_jax.physics import robots
from mqe_jax.physics.engines import c
from mqe_jax.physics.kinematics import poses
from mqe_jax.physics.robots.go1 import GO1
from mqe_jax.physics.robots.motors import leg_response
from mqe_jax.physics.robots.quadruped import LEGS, CollisionShape
from mqe_jax.physics.robots.robot import Link, Robot, box, capsule, sphere
from mqe_jax.physics.scene import CompiledScene, Scene, compile_scene
from mqe_jax.terrain import Plane, Track
from tests.inputs import refuses
from tests.states import made
from tests.test_physics import QUICK

PLANE = Track(blocks=(Plane(4.0),), walled=False, num_robots=1)


def compiled(robot: Robot, num_robots: int = 1, contacts: str = "full") -> CompiledScene:
    each = (robot,) * num_robots
    return compile_scene(Scene(PLANE, num_robots=num_robots, robots=each, contacts=contacts))


def tensor(model: mujoco.MjModel, body: str) -> np.ndarray:
    """Inertia tensor of a body of the first robot in its link frame (3, 3)."""
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.body(f"robot0/{body}").iquat)
    turn = turn.reshape(3, 3)
    return turn @ np.diag(model.body(f"robot0/{body}").inertia) @ turn.T


@pytest.fixture
def lifted() -> Iterator[Robot]:
    trunk = dataclasses.replace(GO1.trunk, mass=6.0)
    joints = GO1.default_joints.reshape(4, 3) * [1.0, 0.8, 0.8]
    changes = {"trunk": trunk, "default_joints": joints.ravel(), "kp": 35.0, "stand_height": 0.34}
    robot = dataclasses.replace(GO1, name="lifted", **changes)
    yield robots.register(robot)
    del robots.ROBOTS["lifted"]


@pytest.mark.parametrize(("name", "mass"), [("go1", 11.31), ("go2", 15.21)])
def test_mass_is_the_published_one(name: str, mass: float) -> None:
    assert compiled(robots.get(name)).model.body_mass.sum() == pytest.approx(mass, abs=0.05)


def test_parts_have_the_masses_and_inertias_of_a_go1() -> None:
    model = compiled(GO1).model
    assert model.body("robot0/trunk").mass[0] == pytest.approx(4.8)
    np.testing.assert_allclose(tensor(model, "trunk"), GO1.trunk.matrix(), atol=1e-6)
    np.testing.assert_allclose(model.body("robot0/FL_thigh").ipos, [-0.0035, -0.0189, -0.0327])
    calf = model.body("robot0/RL_calf")
    assert calf.mass[0] == pytest.approx(0.158 + 0.06)
    assert calf.ipos[2] == pytest.approx((0.158 * -0.1223 + 0.06 * -0.213) / 0.218)


@pytest.mark.parametrize("name", list(robots.ROBOTS))
def test_legs_and_what_is_drawn_of_the_trunk_are_mirror_images(name: str) -> None:
    drawn = make("go1plane", impl="c", robot=name, control="position").mj_model
    across = drawn.geom_pos[drawn.geom_bodyid == drawn.body("robot0/trunk").id, 1]
    np.testing.assert_allclose(np.sort(across), np.sort(-across), atol=1e-9)
    model = compiled(robots.get(name)).model
    for leg in LEGS:
        for link in ("hip", "thigh", "calf"):
            signs = np.array(
                [
                    -1.0 if link == "hip" and leg[0] == "R" else 1.0,
                    1.0 if leg[1] == "L" else -1.0,
                    1.0,
                ]
            )
            com = model.body(f"robot0/FL_{link}").ipos
            np.testing.assert_allclose(
                model.body(f"robot0/{leg}_{link}").ipos, signs * com, atol=1e-12
            )
            reflected = np.outer(signs, signs) * tensor(model, f"FL_{link}")
            np.testing.assert_allclose(tensor(model, f"{leg}_{link}"), reflected, atol=1e-9)


def test_principal_inertia_is_turned_into_the_link_frame() -> None:
    """A quarter turn about z swaps x and y; the compiled model has the principal moments of the
    Go2's trunk.
    """
    turned = Link.from_principal(
        1.0, (0.0, 0.0, 0.0), (1.0, 2.0, 3.0), (0.5**0.5, 0.0, 0.0, 0.5**0.5)
    )
    np.testing.assert_allclose(turned.matrix(), np.diag([2.0, 1.0, 3.0]), atol=1e-12)
    trunk = compiled(robots.get("go2")).model.body("robot0/trunk")
    np.testing.assert_allclose(np.sort(trunk.inertia), [0.0245, 0.0981, 0.1070], rtol=1e-6)


@pytest.mark.parametrize("name", list(robots.ROBOTS))
def test_closed_form_feet_are_where_mujoco_puts_them(name: str) -> None:
    robot = robots.get(name)
    scene = compiled(robot)
    data = mujoco.MjData(scene.model)
    joints = np.random.default_rng(0).uniform(robot.joint_lower, robot.joint_upper)
    data.qpos[scene.index.base_qpos[0]] = [1.0, 2.0, 3.0, 1, 0, 0, 0]
    data.qpos[scene.index.joint_qpos[0]] = joints
    mujoco.mj_kinematics(scene.model, data)
    geoms = [scene.model.geom(f"robot0/{leg}_foot").id for leg in LEGS]
    feet = data.geom_xpos[geoms] - [1.0, 2.0, 3.0]
    np.testing.assert_allclose(robot.foot_positions(jnp.asarray(joints)), feet, atol=1e-5)
    knees = data.xpos[scene.index.bodies[0, 3::3]] - [1.0, 2.0, 3.0]
    np.testing.assert_allclose(robot.knee_positions(jnp.asarray(joints)), knees, atol=1e-5)


@pytest.mark.parametrize(
    "task", ["go1football-2vs2", "go1revolvingdoor", "go1seesaw", "go1pushbox"]
)
def test_poses_of_all_bodies_are_where_mujoco_puts_them(task: str) -> None:
    env = made(task)
    random = np.random.default_rng(0)
    model = env.compiled.model
    data = mujoco.MjData(model)
    mujoco.mj_integratePos(model, data.qpos, random.normal(size=model.nv), 1.0)
    data.mocap_pos += random.normal(size=data.mocap_pos.shape)
    mujoco.mj_kinematics(model, data)
    names = "qpos", "mocap_pos", "mocap_quat"
    state: Any = SimpleNamespace(
        **{name: jnp.asarray(getattr(data, name), jnp.float32) for name in names}
    )
    found = poses(model, state, range(model.nbody))
    np.testing.assert_allclose(found.position, data.xpos, atol=1e-5)
    np.testing.assert_allclose(
        np.abs(np.sum(found.quaternion * data.xquat, axis=1)), 1.0, atol=1e-5
    )


@pytest.mark.parametrize("name", list(robots.ROBOTS))
def test_stands_on_its_default_pose(name: str) -> None:
    robot = robots.get(name)
    env = make(
        "go1plane",
        impl="c",
        control="position",
        robot=name,
        spawn_velocity=0.0,
        spawn_joint_scale=(1.0, 1.0),
    )
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    step = jax.jit(env.step)
    for _ in range(100):
        state = step(state, np.zeros((env.num_agents, 12), np.float32))
    robot_state = jax.jit(env.read)(state.data)
    assert not bool(state.terminated)
    assert float(jnp.abs(robot_state.euler[:, :2]).max()) < 0.1
    assert float(jnp.abs(robot_state.linear_velocity_w).max()) < 0.1
    np.testing.assert_allclose(robot_state.position_w[:, 2], robot.stand_height, atol=0.04)
    assert float(robot_state.trunk_force.max()) == 0.0


def test_a_variant_of_ones_own_is_a_robot_of_every_task(lifted: Robot) -> None:
    env = make("go1gate", impl="c", robot="lifted")
    model = env.compiled.model
    assert env.robots[0] is lifted
    assert model.body("robot1/trunk").mass[0] == pytest.approx(6.0)
    assert model.actuator("robot0/FL_hip").gainprm[0] == pytest.approx(35.0)
    np.testing.assert_allclose(env.controller.neutral[0], lifted.default_joints, rtol=1e-6)
    state = jax.jit(env.step)(jax.jit(env.reset)(jax.random.PRNGKey(0)), jnp.zeros((2, 3)))
    assert bool(jnp.all(jnp.isfinite(state.obs)))


def test_collision_sets_are_swapped_as_data() -> None:
    shapes = (
        CollisionShape("trunk", box((0.188, 0.047, 0.057)), name="body"),
        CollisionShape("trunk", sphere(0.05, (0.27, 0.0, 0.0)), name="head"),
        CollisionShape("thigh", capsule(0.017, (0, 0, -0.02), (0, 0, -0.19))),
        CollisionShape("foot", sphere(0.02, (0, 0, -0.213))),
    )
    scene = compiled(dataclasses.replace(GO1, collision=shapes), 2)
    assert scene.index.trunk_force.shape == (2, 2, 3) and scene.index.geoms.shape == (2, 2 + 4 + 4)
    model = scene.model
    thigh, foot, own = (
        model.geom(f"robot{i}/{name}")
        for i, name in ((0, "FL_thigh"), (1, "RR_foot"), (0, "RL_foot"))
    )

    def touch(a: mujoco.MjModel, b: mujoco.MjModel) -> bool:
        return bool(a.contype[0] & b.conaffinity[0] or b.contype[0] & a.conaffinity[0])

    assert touch(thigh, foot) and not touch(thigh, own)
    slim = compiled(dataclasses.replace(GO1, collision=shapes), 2, "minimal")
    assert slim.index.geoms.shape == (2, 2 + 4)
    assert touch(slim.model.geom("robot0/FL_foot"), slim.model.geom("robot1/head"))


def test_wrong_data_is_refused_by_name() -> None:
    refuses(
        r"Robot\.torque_limit: shape \(3,\); expected \(12,\)",
        dataclasses.replace,
        GO1,
        torque_limit=np.ones(3),
    )
    refuses(r"Robot\.default_joints", dataclasses.replace, GO1, default_joints=np.zeros(12))
    refuses(
        r"Robot\.collision: duplicate names foot",
        dataclasses.replace,
        GO1,
        collision=(*GO1.collision, GO1.collision[-1]),
    )
    refuses(r"unknown part 'tail'", CollisionShape, "tail", sphere(0.02))


def test_a_scene_has_as_many_robots_as_numbers() -> None:
    go2 = robots.get("go2")
    assert compiled(go2, 2).robots == (go2, go2)
    refuses(r"Scene\.robots: 1 robots; expected 2, num_robots", Scene, PLANE, robots=(GO1,))


def test_the_parameter_robot_says_which_robots_a_task_has(monkeypatch: pytest.MonkeyPatch) -> None:
    own = Scene(PLANE, num_robots=1, robots=(GO1,))
    monkeypatch.setattr(Go1Plane, "scene", lambda self: own)
    refuses(r"scene: Scene\.robots is not empty", make, "go1plane", impl="c", num_agents=1)


def test_a_mirror_exchanges_the_values_of_left_and_right_joints() -> None:
    values = jnp.arange(1.0, 13.0)
    reflected = dict(zip(GO1.joint_names, GO1.mirror.reflect(values), strict=True))
    assert GO1.num_joints == 12
    assert (reflected["FL_hip"], reflected["FL_thigh"], reflected["RR_calf"]) == (-4.0, 5.0, 9.0)


def test_missing_walk_weights_say_how_to_make_them() -> None:
    def new(weights: str) -> Robot:
        walk = dataclasses.replace(GO1.walk, weights=weights)
        return dataclasses.replace(GO1, name="new", walk=walk)

    robots.register(new("go3"))
    said = "new: weights: 'go3' is not allowed; it must be one of go1, go2"
    refuses(said, make, "go1gate", impl="c", robot="new")
    del robots.ROBOTS["new"]
    robots.register(new(""))
    try:
        said = r"no weights are shipped for new; .*mqe skill train agile --robot new.*'position'"
        refuses(said, make, "go1gate", impl="c", robot="new")
        for control in ("position", "torque"):
            make("go1gate", impl="c", robot="new", control=control)
    finally:
        del robots.ROBOTS["new"]


@pytest.mark.parametrize("name", ["go1", "go2"])
def test_idle_motors_keep_their_control_and_have_no_armature(name: str) -> None:
    motors = compiled(robots.get(name)).motors
    random = np.random.default_rng(0)
    scale = random.uniform(0.0, 1.2, (2, 4000, 1))
    shares = (scale * random.uniform(-1.0, 1.0, (2, 4000, 12))).astype(np.float32)
    asked = shares[0] * motors.torque
    velocity = shares[1] * motors.speed
    arguments = (
        asked,
        np.zeros_like(asked),
        velocity,
        np.ones(12, np.float32),
        np.zeros((12, 3), np.float32),
    )
    ctrl, armature = motors.limit(np, *arguments)
    acts = (ctrl != asked).any(axis=1) | armature.any(axis=1)
    idle = motors.idle(*arguments)
    assert not np.any(idle & acts)
    assert idle.sum() > 0.5 * (~acts).sum() and acts.any()
    asked[0, 0] = np.nan
    assert not motors.idle(*arguments)[0]


def test_steps_without_limits_are_taken_only_where_limits_have_no_effect(monkeypatch: Any) -> None:
    """Twenty steps under actions of 0 to 100% are the same when the limits are evaluated in all
    environments.
    """
    params = {"control": "torque", "num_agents": 1, "randomization": {"motor_strength": (0.7, 1.3)}}
    env: Any = make("go1plane", impl="c", num_envs=32, **params)
    vector = VectorEnv(env, 32)
    keys = jax.random.split(jax.random.PRNGKey(1), 20)
    start = jax.jit(vector.reset)(jax.random.PRNGKey(0))
    step = jax.jit(vector.step)
    scale = jnp.linspace(0.0, 1.0, 32)[:, None, None]
    states = []
    rollouts = []
    rollout = Batch.rollout
    monkeypatch.setattr(
        Batch,
        "rollout",
        lambda *a, ids, **k: rollouts.append(len(ids)) or rollout(*a, ids=ids, **k),
    )
    for share in (0.0, 1.0):
        monkeypatch.setattr(c, "SHARE", share)
        state = start
        for key in keys:
            state = step(
                state, scale * jax.random.uniform(key, (32, 1, env.action_size), minval=-1.0)
            )
        states.append(jax.tree.map(np.asarray, state))
    assert len(rollouts) == 20 and 0 < sum(rollouts) < 20 * 32
    jax.tree.map(np.testing.assert_array_equal, *states)


def test_a_step_that_is_interrupted_leaves_no_armature(monkeypatch: Any) -> None:
    env: Any = make("go1plane", impl="c", control="torque", num_agents=1, num_envs=2)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 2))
    data = state.data.replace(
        qvel=state.data.qvel.at[:, env.index.joint_qvel[0]].set(env.robots[0].joint_speed_limit)
    )
    arrays = [
        np.asarray(x)
        for x in (
            data.qpos,
            data.qvel,
            data.qacc_warmstart,
            np.tile(env.robots[0].torque_limit, (2, 1)),
        )
    ]

    def call():
        return env.physics._stepper.call((), False, env.physics.num_substeps, *arrays)

    expected = call()

    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Batch, "step", interrupted)
        call()
    np.testing.assert_array_equal(call(), expected)


def test_the_clamp_keeps_angle_and_speed_consistent() -> None:
    motors = compiled(GO1).motors
    velocity = np.where(np.arange(12) == 2, 3.0, 0.5) * motors.speed
    position, clamped = motors.clamp(np.zeros(12), velocity)
    assert clamped[2] == pytest.approx(1.09 * motors.speed[2]) and np.all(
        np.delete(clamped == velocity, 2)
    )
    assert (
        position[2] == pytest.approx(-0.005 * (3.0 - 1.09) * motors.speed[2])
        and np.count_nonzero(position) == 1
    )


def test_joints_in_the_air_start_along_their_torque_line() -> None:
    """From rest, with the torque limit: the first two physics steps of 5 ms against those of a free
    joint.

    Explicit integration of a physics step exceeds the line, an implicit one stays below.
    """
    env: Any = make("go1plane", impl="c", robot="go2", num_agents=1, control="torque", num_envs=3)
    robot = env.robots[0]
    data = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 3)).data
    qpos = np.array(data.qpos)
    qpos[:, env.index.base_qpos[0, 2]] = 2.0
    qpos[:, env.index.joint_qpos[0]] = robot.default_joints
    data = data.replace(qpos=jnp.asarray(qpos), qvel=jnp.zeros_like(data.qvel))
    step = jax.jit(jax.vmap(lambda data, torque: env.physics.step(data, torque, num_substeps=1)[0]))
    for joint in range(3):
        torque = np.where(np.arange(12) == joint, robot.torque_limit, np.zeros((3, 12)))
        gain = 5e-6 * leg_response(robot)[joint, joint]
        state = data
        speed = 0.0
        for _ in range(2):
            state = step(state, torque.astype(np.float32))
            for _ in range(1000):
                limit = robot.stall_torque[joint] * (1 - speed / robot.joint_speed_limit[joint])
                speed += gain * min(robot.torque_limit[joint], limit)
            found = float(state.qvel[0, env.index.joint_qvel[0, joint]])
            assert 0.75 < found / speed < 1.35, joint


@pytest.mark.soak
@pytest.mark.parametrize("robot", ["go1", "go2"])
def test_engines_agree_where_motors_saturate(robot: str) -> None:
    states = {}
    for impl in ("c", "jax"):
        env: Any = make(
            "go1plane", impl=impl, control="torque", robot=robot, num_agents=1, num_envs=4
        )
        state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 4))
        speed = (
            0.9
            * env.robots[0].joint_speed_limit
            * jax.random.uniform(jax.random.PRNGKey(1), (4, 12), minval=-1.0)
        )
        qvel = np.array(state.data.qvel)
        qvel[:, env.index.joint_qvel[0]] = speed
        data = state.data.replace(qvel=jnp.asarray(qvel))
        torque = jnp.where(speed > 0, 1.0, -1.0) * env.robots[0].torque_limit
        step = jax.jit(jax.vmap(lambda d, t, env=env: env.physics.step(d, t)[0]))
        states[impl] = step.lower(data, torque).compile(compiler_options=QUICK)(data, torque)
    for field, atol in (("qpos", 1e-4), ("qvel", 0.02)):
        expected = np.asarray(getattr(states["c"], field))
        other = np.asarray(getattr(states["jax"], field))
        np.testing.assert_allclose(other, expected, atol=atol, err_msg=field)
    # of the step, not of its last physics step
    assert np.all(np.asarray(states["c"].ctrl) == np.asarray(torque))


def test_joint_mechanics_are_in_the_model() -> None:
    env: Any = make("go1plane", impl="c", num_agents=1, joint_mechanics=True)
    joints = env.index.joint_qvel[0]
    model = env.compiled.model
    np.testing.assert_allclose(model.dof_armature[joints], env.robots[0].rotor_inertia)
    np.testing.assert_allclose(model.dof_damping[joints], env.robots[0].joint_damping)
    assert not model.dof_dampingpoly.any()
    np.testing.assert_allclose(model.dof_frictionloss[joints], env.robots[0].friction_loss)
    plain: Any = make("go1plane", impl="c", num_agents=1)
    assert (
        not plain.compiled.model.dof_armature.any()
        and not plain.compiled.model.dof_frictionloss.any()
    )


@pytest.mark.parametrize("robot", ["go1", "go2"])
def test_legs_with_joint_mechanics_stay_finite(robot: str) -> None:
    settings: dict[str, Any] = {
        "num_agents": 2,
        "num_envs": 8,
        "control": "position",
        "robot": robot,
    }
    env: Any = make("go1plane", impl="c", joint_mechanics=True, **settings)
    step = jax.jit(jax.vmap(env.step))
    key = jax.random.PRNGKey(0)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(key, 8))
    fastest = 0.0
    for each in jax.random.split(key, 50):
        state = step(state, 0.3 * jax.random.normal(each, (8, 2, env.action_size)))
        fastest = max(fastest, float(jnp.abs(state.data.qvel[:, env.index.joint_qvel]).max()))
    assert 1.0 < fastest < 35.0


@pytest.mark.parametrize(
    "impl",
    ["c", pytest.param("jax", marks=pytest.mark.soak), pytest.param("warp", marks=pytest.mark.gpu)],
)
def test_payloads_act_as_in_models_compiled_with_them(impl: str) -> None:
    env = make(
        "go1plane", impl=impl, control="position", num_envs=2, randomization={"payload": (0.0, 6.0)}
    )
    model = env.compiled.model
    trunk = env.index.trunk_body
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 2))
    start = state.data.replace(qpos=state.data.qpos.at[:, env.index.base_qpos[:, 2]].set(2.0))
    fields = jax.vmap(env.randomizer.fields)(state.randomized)

    def fall(data: Any, fields: dict[str, jax.Array]) -> jax.Array:
        return env.physics.step(data, data.ctrl, fields=fields, num_substeps=20)[0].qvel

    after = np.asarray(jax.jit(jax.vmap(fall))(start, fields))
    for number in (0, 1):
        payload = np.asarray(state.randomized.payload[number])
        compiled = model.__copy__()
        compiled.body_mass[trunk] += payload
        compiled.body_inertia[trunk] *= (1 + payload / model.body_mass[trunk])[:, None]
        data = mujoco.MjData(compiled)
        mujoco.mj_setConst(compiled, data)
        qvel = []
        for used in (compiled, model):
            mujoco.mj_resetData(used, data)
            data.qpos[:] = start.qpos[number]
            data.qvel[:] = start.qvel[number]
            data.ctrl[:] = start.ctrl[number]
            mujoco.mj_step(used, data, 20)
            qvel.append(data.qvel.copy())
        np.testing.assert_allclose(after[number], qvel[0], atol=1e-3)
        assert np.abs(after[number] - qvel[1]).max() > 0.01
