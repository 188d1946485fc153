"""Robots, motors, the C engine, tracks and the flock against plain numpy and MuJoCo."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mqe_jax.envs import make
from mqe_jax.npc import flock
from mqe_jax.physics import engines, robots
from mqe_jax.physics.engines import c
from mqe_jax.physics.objects import GRAVITY, Ball, Box, Cylinder, Door, Platform, Seesaw, Sheep
from mqe_jax.physics.robots import motors as motor
from mqe_jax.physics.robots.build import build_robot
from mqe_jax.physics.robots.go1 import GO1
from mqe_jax.physics.robots.motors import Motors
from mqe_jax.physics.robots.quadruped import JOINT_NAMES
from mqe_jax.physics.scene import Scene, compile_scene
from mqe_jax.terrain import EndWall, Gate, Plane, SpawnArea, Track
from tests.states import initial

KEY = jax.random.PRNGKey(0)


def limited(motors: Motors, force: float, joint: int, speeds: np.ndarray) -> float:
    """The torque of a motor that is asked for a force, N m, at the speeds of all joints."""
    v, top, most, stall = (
        speeds[joint],
        *(float(x[joint]) for x in (motors.speed, motors.torque, motors.stall)),
    )
    along = 1.0 if v >= 0 else -1.0
    pace = abs(v)
    bound = (
        min(stall * (1 - pace / top), most) if pace <= top else -most * (pace - top) / (0.15 * top)
    )
    return along * min(max(along * force, -most), max(bound, -most))


def armature(motors: Motors, torque: np.ndarray, joint: int, speeds: np.ndarray) -> float:
    """The armature of a joint, kg m^2, at the speeds of all joints under torques."""
    response = motors.runs[0].response
    leg = slice(3 * (joint // 3), 3 * (joint // 3) + 3)
    own = joint % 3
    top = float(motors.speed[joint])
    full = motors.timestep * float(motors.torque[joint]) / (0.15 * top)
    fast = np.abs(speeds[leg]).max() / motors.speed[leg].min()
    share = min(max((fast - 0.85) / 0.15, 0.0), 1.0)
    reach = (abs(speeds[joint]) + motors.timestep * response[own] @ np.abs(torque[leg])) / top
    needed = min(4.0 / response[own, own] * (reach - 1.0), full) if reach > 1.25 else 0.0
    inertia = 1.0 / response[own, own]
    line = float(motors.stall[joint]) / top
    if motors.timestep * line > 2.0 * inertia:
        most = line * (top - speeds[joint] * np.sign(torque[joint]))
        needed = max(abs(torque[joint]) / most * (inertia + motors.timestep * line) - inertia, 0.0)
    return max(share * full, needed)


@pytest.mark.parametrize("name", ["go1", "go2"])
def test_motors_are_those_of_a_plain_implementation(name: str) -> None:
    robot = robots.get(name)
    scene = compile_scene(
        Scene(
            Track(blocks=(Plane(4.0),), walled=False, num_robots=1), num_robots=1, robots=(robot,)
        )
    )
    motors = scene.motors
    random = np.random.default_rng(0)
    rows = 60
    assert (motor.SLOW, motor.FAST, motor.REACH, motor.GAIN, motor.STEEP) == (
        0.85,
        1.0,
        1.25,
        4.0,
        2.0,
    )
    velocity = (
        random.uniform(-1.3, 1.3, (rows, 12)) * motors.speed * np.linspace(0, 1, rows)[:, None]
    )
    position, target = random.normal(size=(2, rows, 12))
    gain = np.full(12, robot.kp)
    bias = np.tile([0.3, -robot.kp, -robot.kd], (12, 1))
    ctrl, added = motors.limit(np, target, position, velocity, gain, bias)
    asked = robot.kp * (target - position) - robot.kd * velocity + 0.3
    given = robot.kp * (ctrl - position) - robot.kd * velocity + 0.3
    expected = [
        [limited(motors, asked[row, j], j, velocity[row]) for j in range(12)] for row in range(rows)
    ]
    np.testing.assert_allclose(given, expected, rtol=1e-4, atol=1e-4)
    expected = [
        [armature(motors, given[row], j, velocity[row]) for j in range(12)] for row in range(rows)
    ]
    np.testing.assert_allclose(added, expected, rtol=1e-3, atol=1e-6)
    again = motors.limit(jnp, *(jnp.asarray(x) for x in (target, position, velocity, gain, bias)))
    np.testing.assert_allclose(again[0], ctrl, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(again[1], added, rtol=1e-3, atol=1e-5)


def test_an_environment_step_of_the_c_engine_is_that_of_plain_mujoco() -> None:
    scene = compile_scene(
        Scene(Track(blocks=(Plane(4.0),), walled=False, num_robots=1), num_robots=1)
    )
    model = scene.model
    motors = scene.motors
    index = scene.index
    count = 8
    engine = engines.make(model, motors=motors, impl="c", num_envs=count)
    random = np.random.default_rng(0)
    qpos = np.tile(model.qpos0, (count, 1))
    qpos[:, index.base_qpos[0]] = [0, 0, 0.4, 1, 0, 0, 0]
    qpos[:, index.joint_qpos[0]] = GO1.default_joints + 0.1 * random.normal(size=(count, 12))
    qvel = 0.3 * random.normal(size=(count, model.nv))
    qvel[:, index.joint_qvel[0]] = (
        random.uniform(-1.2, 1.2, (count, 12)) * np.linspace(0, 1, count)[:, None] * motors.speed
    )
    ctrl = GO1.default_joints + np.linspace(0, 2, count)[:, None] * random.normal(size=(count, 12))
    forces = np.zeros((count, model.nbody, 6))
    forces[:, index.trunk_body[0]] = 20 * random.normal(size=(count, 6))
    mass = model.body_mass * random.uniform(1.0, 1.5, (count, 1))
    arrays = [jnp.asarray(x, jnp.float32) for x in (qpos, qvel, ctrl, forces, mass)]

    @jax.jit
    @jax.vmap
    def run(qpos: Any, qvel: Any, ctrl: Any, forces: Any, mass: Any) -> Any:
        data = engine.init(qpos, qvel, jnp.zeros((0, 3)), ctrl)
        for _ in range(2):
            data, _ = engine.step(data, ctrl, fields={"body_mass": mass}, xfrc_applied=forces)
        return data

    after = run(*arrays)
    angles = index.joint_qpos[0]
    speeds = index.joint_qvel[0]
    gain = model.actuator_gainprm[:, 0]
    bias = model.actuator_biasprm[:, :3]
    for n in range(count):
        own = model.__copy__()
        data = mujoco.MjData(model)
        own.body_mass[:] = arrays[4][n]
        data.qpos[:] = arrays[0][n]
        data.qvel[:] = arrays[1][n]
        data.xfrc_applied[:] = arrays[3][n]
        for number in range(8):
            if number == 4:  # an environment step ends in single precision
                data.qpos[:] = np.float32(data.qpos)
                data.qvel[:] = np.float32(data.qvel)
                data.qacc_warmstart[:] = np.float32(data.qacc_warmstart)
            joints = ctrl[n], data.qpos[angles], data.qvel[speeds], gain, bias
            data.ctrl[:], own.dof_armature[speeds] = motors.limit(
                np, *(np.float32(x) for x in joints)
            )
            mujoco.mj_step(own, data)
            data.qpos[angles], data.qvel[speeds] = motors.clamp(
                data.qpos[angles], data.qvel[speeds]
            )
        np.testing.assert_allclose(after.qpos[n], data.qpos, atol=2e-4, err_msg=str(n))
        np.testing.assert_allclose(after.qvel[n], data.qvel, atol=2e-2, err_msg=str(n))
        np.testing.assert_allclose(
            after.qacc_warmstart[n], data.qacc_warmstart, rtol=0.02, atol=2.0
        )


def test_a_step_that_the_engine_warns_of_is_made_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    env: Any = make("go1plane", impl="c", control="position", num_agents=1, num_envs=3)
    start = jax.vmap(lambda _: initial(env).data)(jnp.arange(3))
    qvel = jnp.zeros_like(start.qvel).at[1, env.index.base_qvel[0, 0]].set(1e11)
    start = start.replace(qvel=qvel, qpos=start.qpos.at[:, env.index.base_qpos[0, 2]].set(1.0))
    step = jax.jit(jax.vmap(lambda data: env.physics.step(data, data.ctrl)[0]))
    found = []
    for share in (0.0, 1.0):
        monkeypatch.setattr(c, "SHARE", share)
        found += [jax.tree.map(np.asarray, step(start)) for _ in range(2)]
    for other in found[:3]:
        for name in ("qpos", "qvel"):
            np.testing.assert_array_equal(
                getattr(other, name), getattr(found[3], name), err_msg=name
            )


def test_blocks_follow_each_other_along_the_track() -> None:
    blocks = (SpawnArea(3.0), Gate(2.0, width=0.8, random=(0.1, 0.3), depth=0.2), Plane(1.5))
    track = Track(
        (*blocks, Gate(4.0, width=1.0), EndWall()), width=4.0, num_robots=3, wall_height=0.6
    )
    layout = track.layout()
    np.testing.assert_allclose(
        np.array(layout.spawn), [[1.5, -4 / 3, 0], [1.5, 0, 0], [1.5, 4 / 3, 0]], atol=1e-9
    )
    assert [(a.name, a.position, a.spread) for a in layout.anchors] == [
        ("gate1", (pytest.approx(4.0), 0.0), (0.1, 0.3)),
        ("gate3", (pytest.approx(8.5), 0.0), (0.0, 0.0)),
    ]
    assert [wall.anchor for wall in layout.walls] == [0, 0, 1, 1]
    for wall, side in zip(layout.walls[:2], (-1, 1), strict=True):
        assert wall.size == (0.2, pytest.approx(1.9), 0.6)  # (4.0 - 0.8) / 2 + 0.3
        assert wall.center == (0.0, pytest.approx(side * 1.35), 0.3)
    assert {b.name: (b.point, b.normal, b.length) for b in layout.barriers} == {
        "back0": ((0.0, 0.0), (1.0, 0.0), 4.0),
        "end4": ((10.5, 0.0), (-1.0, 0.0), 4.0),
        "side_right": ((5.25, -2.0), (0.0, 1.0), 10.5),
        "side_left": ((5.25, 2.0), (0.0, -1.0), 10.5),
    }
    spaced = Track((Plane(1.0), SpawnArea(2.0, spawn_x=0.5, spacing=0.7)), num_robots=2).layout()
    np.testing.assert_allclose(np.array(spaced.spawn), [[1.5, -0.35, 0], [1.5, 0.35, 0]])


@pytest.mark.parametrize("name", list(robots.ROBOTS))
def test_a_compiled_robot_has_the_constants_of_its_data(name: str) -> None:
    robot = robots.get(name)
    track = Track(blocks=(Plane(4.0),), walled=False, num_robots=2)
    scene = compile_scene(
        Scene(track, num_robots=2, robots=(robot,) * 2, friction=0.7, torque_robots=1)
    )
    model = scene.model
    kp = robot.kp
    kd = robot.kd
    assert model.opt.timestep == 0.005 and model.nu == 24
    for number in range(2):
        for index, joint in enumerate(JOINT_NAMES):
            actuator, hinge = (of(f"robot{number}/{joint}") for of in (model.actuator, model.joint))
            torques = number == 0
            assert actuator.gainprm[0] == (1.0 if torques else kp) and actuator.trnid[0] == hinge.id
            np.testing.assert_allclose(
                actuator.biasprm[:3], [0, 0, 0] if torques else [0, -kp, -kd]
            )
            limit = robot.torque_limit[index]
            np.testing.assert_allclose(actuator.forcerange, [-limit, limit])
            np.testing.assert_allclose(
                hinge.range, [robot.joint_lower[index], robot.joint_upper[index]]
            )
            np.testing.assert_allclose(hinge.axis, [1, 0, 0] if index % 3 == 0 else [0, 1, 0])
            assert model.jnt_margin[hinge.id] == robot.joint_margin
            np.testing.assert_allclose(model.jnt_solref[hinge.id], [0.01, 1.0])
        for geom in scene.index.geoms[number]:
            assert model.geom_margin[geom] == 0.003 and model.geom_priority[geom] == 2
            np.testing.assert_allclose(model.geom_friction[geom], [0.7, 0.005, 0.0001])
            np.testing.assert_allclose(model.geom_solref[geom], [0.01, 1.0])
            np.testing.assert_allclose(model.geom_solimp[geom], [0.9, 0.95, 0.001, 0.5, 2.0])
    trunk = build_robot(robot, 0).body("trunk")
    assert trunk.pos[2] == robot.stand_height


def test_the_flock_is_that_of_a_plain_implementation() -> None:
    """Five sheep and three robots; one of each, near (at the top speed) and about as far as a sheep
    sees.
    """
    random = np.random.default_rng(0)
    several = (
        random.normal(size=(5, 2)),
        random.normal(size=(5, 2)),
        1.5 * random.normal(size=(3, 2)),
    )
    pairs = [
        (np.zeros((1, 2)), np.zeros((1, 2)), np.array([[-apart, 0.0]]))
        for apart in (0.1, 0.5, 2.9, 3.1)
    ]

    def slowed(v: np.ndarray, friction: float) -> np.ndarray:
        return v * max(1 - friction * GRAVITY * 0.1 / 2 / max(np.linalg.norm(v), 1e-9), 0.0)

    def plain(
        sheep: np.ndarray, speed: np.ndarray, dogs: np.ndarray, s: float, friction: float
    ) -> np.ndarray:
        result = np.zeros_like(sheep)
        noise = np.asarray(jax.random.normal(KEY, sheep.shape))
        for i in range(len(sheep)):
            v = slowed(speed[i], friction) + 2 * s * noise[i]
            inward = sheep.mean(0) - sheep[i]
            v = v + s / 1.5 * inward / max(np.linalg.norm(inward), 1e-9)
            for dog in dogs:
                away = sheep[i] - dog
                near = math.hypot(*(away**2))
                v = v + (0.2 * away / near**1.4 if near <= 9 else 0.0)
            result[i] = slowed(np.clip(v, -2, 2), friction)
        return result

    for numbers, s, friction in (
        (several, 0.0, 0.8),
        (several, 0.3, 0.8),
        *((pair, 0.0, 0.0) for pair in pairs),
    ):
        arrays = [jnp.asarray(x, jnp.float32) for x in numbers]
        found = flock(KEY, *arrays, restlessness=s, step=0.1, friction=friction)
        np.testing.assert_allclose(found, plain(*numbers, s, friction), atol=1e-4)


def test_objects_have_the_masses_and_inertias_of_their_shapes() -> None:
    items = {
        "box": Box(size=(0.6, 0.8, 1.0), mass=6.0, friction=0.3),
        "ball": Ball(radius=0.2, mass=0.5, damping=0.2, angular_damping=0.01),
        "can": Cylinder(x=9.0, mass=2.0, friction=0.5, reach=1.5),
        "sheep": Sheep(mass=4.0, radius=0.3, height=0.7),
        "plank": Seesaw(inertia=50.0, limit=0.2, damping=800.0),
        "door": Door(inertia=1.4, damping=0.7, size=(0.1, 1.6, 0.9)),
        "block": Platform(center=(20.0, 1.0, 1.2), size=(2.0, 1.0, 0.4)),
    }
    scene = compile_scene(
        Scene(Track((SpawnArea(2.0),), walled=False), num_robots=1, objects=items)
    )
    model = scene.model
    index = scene.objects
    mass = {name: model.body_mass[index[name].body] for name in ("box", "ball", "can", "sheep")}
    assert mass == {"box": 6.0, "ball": 0.5, "can": 2.0, "sheep": 4.0}
    inertia = {name: sorted(model.body_inertia[index[name].body]) for name in items}
    np.testing.assert_allclose(
        inertia["box"], 0.5 * np.array([0.6**2 + 0.8**2, 0.6**2 + 1, 0.8**2 + 1])
    )
    np.testing.assert_allclose(inertia["ball"], [2 / 3 * 0.5 * 0.04] * 3)
    np.testing.assert_allclose(inertia["door"], [0.5, 1.0, 1.4])
    np.testing.assert_allclose(model.dof_damping[index["ball"].qvel], [0.2] * 3 + [0.01] * 3)
    assert (
        model.dof_damping[index["plank"].qvel[0]] == 800.0
        and model.dof_damping[index["door"].qvel[0]] == 0.7
    )
    assert model.dof_frictionloss[index["can"].qvel[0]] == pytest.approx(0.5 * 2.0 * GRAVITY)
    for name, limit in (("can", 1.5), ("plank", 0.2)):
        np.testing.assert_allclose(
            model.jnt_range[model.body_jntadr[index[name].body]], [-limit, limit]
        )
    sizes = {name: model.geom_size[index[name].geom] for name in items}
    np.testing.assert_allclose(sizes["box"], [0.3, 0.4, 0.5])
    np.testing.assert_allclose(sizes["sheep"][:2], [0.3, 0.2])
    np.testing.assert_allclose(sizes["block"], [1.0, 0.5, 0.2])
    np.testing.assert_allclose(model.body_pos[index["block"].body], [20.0, 1.0, 1.0])
    assert model.geom_friction[index["box"].geom, 0] == 0.3
    assert all(model.geom_condim[index[name].geom] == 3 for name in items)


def test_sheep_follow_the_law_with_the_parameters_of_their_task() -> None:
    herd: dict[str, Any] = {"restlessness": 0.2, "sheep_friction": 0.3, "flock": (2, 1)}
    env: Any = make("go1sheep-hard", impl="c", control="position", num_envs=1, **herd)
    state = initial(env)
    speed = jax.random.normal(KEY, (2, 2))
    columns = np.stack([env.objects[f"sheep{number}"].qvel for number in range(2)])
    data = state.data.replace(qvel=state.data.qvel.at[columns].set(speed))
    robots_xy = env.read(data).position_w[:, :2]
    expected = flock(
        KEY, env.sheep(data), speed, robots_xy, restlessness=0.2, step=0.02, friction=0.3
    )
    after = env.step_npcs(data, env.read(data), KEY)
    np.testing.assert_allclose(after.qvel[columns], expected, rtol=1e-5)
    assert not np.delete(np.asarray(after.qvel - data.qvel), columns.ravel()).any()
