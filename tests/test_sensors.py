"""Sensors against MuJoCo's rays on a model built from the declared shapes, and on every engine;
memory, mirrored frames, settings, drawings, messages.
"""

import dataclasses
import itertools
from typing import Any, Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mqe_jax.core.blocks import Block, Entities, image
from mqe_jax.core.settings import override, settings_class, to_mapping
from mqe_jax.envs import State, VectorEnv, make
from mqe_jax.envs.gate import GateParams
from mqe_jax.envs.observation import ObservationLayout, entities
from mqe_jax.envs.randomization import Randomization
from mqe_jax.envs.state import FINAL
from mqe_jax.names import load_policy
from mqe_jax.physics.robots.go1 import GO1
from mqe_jax.physics.robots.quadruped import MIRROR
from mqe_jax.sensors import Sensor, register
from mqe_jax.sensors.depth import Depth
from mqe_jax.sensors.detections import Detections
from mqe_jax.sensors.lidar import Lidar
from mqe_jax.sensors.marks import Marks
from mqe_jax.sensors.messages import Messages
from mqe_jax.sensors.pipeline import Pipeline
from mqe_jax.sensors.suite import Suite
from mqe_jax.viz import recording, render
from tests.inputs import refuses
from tests.sensing import EXACT, RANGE, SENSING, Shapes, rays, readings, scattered, sense
from tests.states import initial, made, placed

LIKE_OTHERS = ("go1sheep-easy", "go1football-1vs1", "go1football-defender")
EACH = [
    pytest.param(task, marks=pytest.mark.soak if task in LIKE_OTHERS else ()) for task in SENSING
]
COUNTS = [5, pytest.param(500, marks=pytest.mark.soak)]


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("task", EACH)
def test_the_lidar_agrees_with_mujoco_on_the_declared_shapes(task: str, count: int) -> None:
    env = made(task)
    states = scattered(task, count)
    read = readings(env, states, Lidar(range=RANGE))
    shapes = Shapes(env)
    for number in range(count):
        shapes.place(
            np.asarray(states.data.qpos[number], float), np.asarray(states.anchors[number], float)
        )
        for agent, origin, angles in rays(env, states, number):
            origin = np.array([*origin[:2], 0.0])
            body = env.index.trunk_body[agent]
            # Near an edge float32 may see either side of it.
            beside = [
                [shapes.ray(origin, angle + shift, body) for angle in angles]
                for shift in (-1e-5, 0.0, 1e-5)
            ]
            low = np.minimum(np.min(beside, axis=0), RANGE)
            high = np.minimum(np.max(beside, axis=0), RANGE)
            assert np.all((read[number, agent] > low - 1e-4) & (read[number, agent] < high + 1e-4))


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("task", EACH)
def test_visibility_agrees_with_mujoco_on_the_declared_shapes(task: str, count: int) -> None:
    """Outside of 1 cm of an edge: where no line of sight with its ends 1 cm beside differs."""
    env = made(task)
    states = scattered(task, count)
    shapes = Shapes(made(task))
    sensor = Detections()
    scene = env.suite.scene
    checked = set()

    def see(state: State) -> jax.Array:
        return sensor.visible(scene, env.snapshot(state, env.read(state.data)))

    seen = np.asarray(jax.jit(jax.vmap(see))(states))
    for number in range(count):
        anchors = np.asarray(states.anchors[number], float)
        shapes.place(np.asarray(states.data.qpos[number], float), anchors)
        names = [entity.place for entity in env.entities]
        bodies = [
            *env.index.trunk_body,
            *(-2 if isinstance(x, int) else env.objects[x].body for x in names),
        ]
        spots = [shapes.scene.xpos[body, :2] if body >= 0 else None for body in bodies]
        spots = [
            anchors[x] if at is None else at
            for x, at in zip([*env.index.trunk_body, *names], spots, strict=True)
        ]
        for agent, row in itertools.product(range(env.num_agents), range(len(spots))):
            if row == agent:
                continue
            base = np.asarray(states.data.qpos[number, env.index.base_qpos[agent]], float)
            views = []
            for near, far, along in itertools.product((-0.01, 0, 0.01), repeat=3):
                way = spots[row] - spots[agent]
                ahead = way / np.linalg.norm(way)
                side = np.array([-ahead[1], ahead[0]])
                start = spots[agent] + near * side
                end = spots[row] + far * side + along * ahead
                distance = np.linalg.norm(end - start)
                angle = np.arctan2(*(end - start)[::-1])
                bearing = np.abs(
                    (angle - 2 * np.arctan2(base[6], base[3]) + np.pi) % (2 * np.pi) - np.pi
                )
                free = (
                    shapes.ray(np.array([*start, 0.0]), angle, bodies[agent], bodies[row])
                    > distance
                )
                views.append(bool(free and distance < 6.0 and np.degrees(bearing) < 60))
            if len({*views}) == 1:
                checked |= {views[0]}
                assert seen[number, agent, row] == views[0]
    assert checked == {True, False}


# ---------------------------------------------------------------- Memory, mirrored frames, settings


def test_a_detection_is_kept_with_its_age() -> None:
    env = made("go1gate")
    sensor = EXACT[1]
    layout = ObservationLayout(sensor.layout(env.suite.scene))
    see = sense(env, sensor)

    def mate(position: Any, yaw: float, memory: Any) -> tuple[list[float], bool, Any]:
        blocks, memory = see(
            placed(env, [position, [2.0, 0.5, 0.3]], [[0, 0, yaw], [0, 0, 0.5]]), memory
        )
        (entry,), (there,) = layout.entities(layout.pack(blocks)[0], "mates")
        return np.asarray(entry).round(5).tolist(), bool(there), memory

    entry, there, memory = mate([1.0, 0.5, 0.3], np.pi, sensor.init_memory(env.suite.scene))
    assert not there and entry == [0, 0, 0, 0, 0]  # behind
    entry, there, memory = mate([1.0, 0.5, 0.3], 0.5, memory)
    first = [np.cos(0.5), -np.sin(0.5), 1.0, 0.0]  # m and of no relative yaw
    assert there and entry == pytest.approx([*first, 0.0], abs=1e-5)
    for steps in (1, 2):
        entry, there, memory = mate([1.5, 0.5, 0.3], np.pi, memory)
        assert there and entry == pytest.approx([*first, steps * env.dt], abs=1e-5)
    entry, there, _ = mate([1.5, 0.5, 0.3], 0.0, memory)
    assert there and entry == pytest.approx([0.5, 0.0, np.cos(0.5), np.sin(0.5), 0.0], abs=1e-5)


@pytest.mark.parametrize("task", ["go1revolvingdoor", "go1bridge"])
def test_sensors_of_the_second_team_are_mirrored_as_its_frame(task: str) -> None:
    """The second robot is the image of the first: everything reads alike.

    Odometry follows the true pose.
    """
    env = made(task)
    rng = np.random.default_rng(0)
    state = initial(env)
    reflect = task == "go1revolvingdoor"
    joints = GO1.default_joints + rng.normal(0, 0.2, 12)
    speeds = rng.normal(size=12)

    def image(x):
        return MIRROR.reflect(x) if reflect else x

    spin = np.array([0.3, -0.4, 0.5])
    sign = np.array([-1, 1, -1]) if reflect else np.ones(3)
    position = np.array([1.1, 0.5, 0.3])
    euler = np.array([0.1, 0.2, 0.4])
    middle = np.array([*env.center, 0.0])
    other = position * [1, -1, 1] if reflect else 2 * middle - position + [0, 0, 0.6]
    turned = euler * sign if reflect else euler + np.array([0, 0, np.pi])
    state = placed(env, [position, other], [euler, turned])
    qpos = np.array(state.data.qpos)
    qvel = np.array(state.data.qvel)
    qpos[env.index.joint_qpos] = [joints, image(joints)]
    qvel[env.index.joint_qvel] = [speeds, image(speeds)]
    qvel[env.index.base_qvel[:, 3:]] = [spin, spin * sign]
    state = dataclasses.replace(
        state, data=state.data.replace(qpos=jnp.asarray(qpos), qvel=jnp.asarray(qvel))
    )
    for sensor in EXACT:
        blocks, _ = sense(env, sensor)(state, sensor.init_memory(env.suite.scene))
        for name, (first, second) in blocks.items():
            np.testing.assert_allclose(first, second, atol=1e-5, err_msg=name)
    for name, (first, second) in env.observe_group(
        "proprioception", state, env.read(state.data)
    ).items():
        np.testing.assert_allclose(first, second, atol=1e-5, err_msg=name)


def test_senses_add_a_group_and_change_nothing_else() -> None:
    """Their memory advances once a step, with or without final observations, and restarts with the
    episode.
    """
    options: Any = {"impl": "c", "control": "position", "num_envs": 2}
    senses = (*EXACT[:2], Lidar(pipeline={"all": Pipeline(history=2)}))
    blind = make("go1bridge", **options)
    env = make("go1bridge", **options, senses=senses)
    batches = [VectorEnv(blind, 2), VectorEnv(env, 2).with_groups(["onboard"])]
    batches.append(VectorEnv(env, 2, final=()).with_groups(["onboard"]))
    states = [jax.jit(batch.reset)(jax.random.PRNGKey(0)) for batch in batches]
    steps = [jax.jit(batch.step) for batch in batches]
    action = np.full((2, 2, 12), 0.3, np.float32)

    @jax.jit
    def sensed(state: State) -> tuple[dict[str, jax.Array], jax.Array]:
        x, y, _, _, _, yaw = jnp.moveaxis(
            jax.vmap(env.own_frame)(jax.vmap(env.read)(state.data).base_info), -1, 0
        )
        return env.layouts["onboard"].split(state.groups["onboard"]), jnp.stack(
            [x, y, jnp.cos(yaw), jnp.sin(yaw)], -1
        )

    for count in range(4):
        if count == 2:
            late = jnp.array([env.max_steps - 1, 0])
            states = [dataclasses.replace(state, step=late) for state in states]
        states = [step(state, action) for step, state in zip(steps, states, strict=True)]
        plain, seeing, lean = states
        for name in ("data", "key"):
            jax.tree.map(np.testing.assert_array_equal, getattr(plain, name), getattr(seeing, name))
        for name in ("obs", "reward"):  # programs that compute more may round differently
            np.testing.assert_allclose(getattr(plain, name), getattr(seeing, name), atol=1e-6)
        np.testing.assert_allclose(seeing.groups["onboard"], lean.groups["onboard"], atol=1e-5)
        read, pose = sensed(seeing)
        np.testing.assert_allclose(read["odometry"], pose, atol=1e-4)
        np.testing.assert_allclose(read["action"][0], 0.0 if count == 2 else 0.3)
        assert seeing.final_groups["onboard"].shape == (2, 2, env.group_sizes["onboard"])
    assert states[0].senses == () and "onboard" not in blind.layouts


def test_noise_is_drawn_once_a_step_from_the_state() -> None:
    """Where no episode ends, the final observation is the observation, noise and readings included.
    The same numbers are drawn without final observations.
    """
    noise = Randomization(observation_noise=0.1)
    options: Any = {"impl": "c", "control": "position", "num_envs": 2, "randomization": noise}
    env = make("go1plane", **options, senses="onboard")
    batches = [VectorEnv(env, 2, final=final).with_groups(["onboard"]) for final in (FINAL, ())]
    states = [jax.jit(batch.reset)(jax.random.PRNGKey(0)) for batch in batches]
    steps = [jax.jit(batch.step) for batch in batches]
    action = np.zeros((2, 2, 12), np.float32)
    for count in range(4):
        if count == 3:
            late = jnp.array([env.max_steps - 1, 0])
            states = [dataclasses.replace(state, step=late) for state in states]
        states = [step(state, action) for step, state in zip(steps, states, strict=True)]
        both, lean = states
        goes_on = ~np.asarray(both.truncated)
        assert goes_on.tolist() == [count < 3, True]
        for name in ("policy", "onboard"):
            now = np.asarray(both.groups[name])
            apart = np.abs(now - np.asarray(both.final_groups[name])).max((1, 2))
            same = apart < 1e-5  # XLA may compute it twice
            np.testing.assert_array_equal(same, goes_on)
            np.testing.assert_allclose(now, lean.groups[name], atol=1e-5)
    # from a copy of a state the same readings follow, and others after another key
    both = states[0]
    copied = jax.device_put(jax.tree.map(np.array, both))
    other = dataclasses.replace(both, key=both.key + 1)
    first, again, changed = (steps[0](x, action).groups["onboard"] for x in (both, copied, other))
    np.testing.assert_array_equal(first, again)
    assert np.mean(np.asarray(first != changed)) > 0.5


def test_a_pipeline_delays_drops_and_keeps_readings() -> None:
    block = entities("mates", "robot", 2, 1, masked=True)
    pipeline = Pipeline(noise=0.1, clip=(0.0, 3.0), scale=2.0, delay=2, dropout=0.3, history=2)
    assert pipeline.block(block) == dataclasses.replace(
        block, width=8, entities=Entities("robot", 4, 1, True)
    )
    assert pipeline.block(image("depth", 2, 3)) == Block("depth", 12, image=(2, 2, 3))

    def play(pipeline: Pipeline, readings: np.ndarray) -> np.ndarray:
        def step(memory: Any, given: Any) -> Any:
            out, memory = pipeline.apply(block, given[0], memory, *given[1:])
            return memory, out

        rng = np.random.default_rng(0)
        noise = rng.normal(size=readings.shape)
        lost = rng.uniform(size=(len(readings), 2, 1)) < pipeline.dropout
        given = readings, np.float32(noise), lost
        return np.asarray(jax.lax.scan(step, pipeline.init_memory(block, 2), given)[1])

    steps = 400
    rows = np.stack(
        [np.arange(steps) % 7.0, np.arange(steps) % 3 > 0, np.ones(steps), np.ones(steps)], axis=-1
    )
    readings = np.stack([rows, rows + 0.5], axis=1).astype(np.float32)
    exact = play(Pipeline(delay=2, history=2), readings)
    np.testing.assert_array_equal(exact[:3, :, :4], readings[[0, 0, 0]])
    np.testing.assert_array_equal(exact[3:, :, :4], readings[1:-2])
    np.testing.assert_array_equal(exact[1:, :, 4:], exact[:-1, :, :4])
    lossy = play(Pipeline(dropout=0.3), readings)
    kept = np.all(lossy == readings, axis=-1)
    assert 0.6 < kept.mean() < 0.8 and np.any(kept[:, 0] != kept[:, 1]) and kept[0].all()
    np.testing.assert_array_equal(lossy[1:][~kept[1:]], lossy[:-1][~kept[1:]])
    noisy = play(Pipeline(noise=0.1, clip=(0.0, 3.0), scale=2.0), readings)
    np.testing.assert_array_equal(noisy[..., [1, 3]], readings[..., [1, 3]])  # masks
    assert noisy[..., 0].max() == 6.0 and noisy[..., 0].min() == 0.0
    assert np.std(noisy[:, 0, 2]) == pytest.approx(0.2, rel=0.2)


class Watcher:
    """A policy that acts only if the last two readings of its lidar differ."""

    task = "go1gate"
    agents = 2
    groups = ("onboard",)

    def initial_memory(self, num_envs: int) -> Any:
        return ()

    def act(self, obs: Any, memory: Any, key: Any = None) -> Any:
        now, before = jnp.split(obs.groups["onboard"], 2, axis=-1)
        return jnp.tile((now != before).astype(jnp.float32), 3), memory


def test_a_recorded_policy_has_sensors_with_memory() -> None:
    senses = [Lidar(rays=4, pipeline={"all": Pipeline(history=2)})]
    env = make("go1gate", impl="c", control="position", num_envs=1, senses=senses)
    key = jax.random.PRNGKey(0)
    policies: list[Any] = [Watcher(), lambda obs, memory, key: (jnp.zeros((1, 2, 12)), memory)]
    watched, still = (
        recording.record_episodes(env, each, key, seconds=0.2)[0].qpos for each in policies
    )
    assert np.abs(watched - still).max() > 0.01


def test_senses_are_settings() -> None:
    senses = [{"name": "lidar", "rays": 8, "pipeline": {"all": {"noise": 0.1}}}, "detections"]
    params = make("go1gate", impl="c", senses=senses).params
    assert params.senses == (Lidar(rays=8, pipeline={"all": Pipeline(noise=0.1)}), Detections())
    assert override(GateParams(), {"senses": to_mapping(params)["senses"]}) == params


@pytest.mark.parametrize(
    ("task", "senses", "message"),
    [
        ("go1gate", "onbord", r"^senses: 'onbord' .*full, onboard.*did you mean 'onboard'"),
        ("go1gate", ["lidr"], r"^senses: 'lidr' .*lidar.*did you mean 'lidar'"),
        ("go1gate", [{"name": "lidar", "rays": 0}], r"^senses\.lidar\.rays: 0 .*greater than 0"),
        ("go1gate", [{"name": "lidar", "beams": 8}], r"^senses\.lidar\.beams: unknown name"),
        ("go1gate", ["lidar", "lidar"], r"^senses: .*sensors of different names"),
        ("go1gate", 3, r"^senses: 3 .*full, onboard"),
        (
            "go1gate",
            [{"name": "lidar", "pipeline": {"lida": {}}}],
            r"senses.lidar.pipeline: 'lida' .*one of all, lidar",
        ),
        (
            "go1gate",
            [{"name": "lidar", "pipeline": {"all": {"nose": 0.1}}}],
            r"senses\.lidar\.pipeline\.all\.nose: unknown name .*did you mean 'noise'",
        ),
        ("go1tug", ["messages"], r"senses: 'messages' .*no robot has teammates"),
        ("go1gate", [{"name": "messages", "numbers": 0}], r"senses.*numbers: 0 .*greater than 0"),
        ("go1gate", ["depth"], r"senses: 'depth' needs impl warp or warp-mjx; .* here is c"),
    ],
)
def test_bad_senses_are_named(task: str, senses: Any, message: str) -> None:
    refuses(message, make, task, impl="c", senses=senses)


@settings_class
class Faulty(Sensor):
    """A sensor with one of several mistakes."""

    name: Literal["faulty"] = "faulty"
    mistake: str = ""

    def layout(self, scene: Any) -> tuple[Block, ...]:
        return (Block("lidar" if self.mistake == "block" else "yaw", 1),)

    def init_memory(self, scene: Any) -> Any:
        return jnp.zeros(3)

    def observe(self, scene: Any, snapshot: Any, memory: Any, key: Any) -> Any:
        yaw = snapshot.pose[:, 2:]
        readings = {"name": {"jaw": yaw}, "shape": {"yaw": yaw[:, 0]}}.get(
            self.mistake, {"yaw": yaw}
        )
        return readings, jnp.broadcast_to(memory, (2, 3)) if self.mistake == "memory" else memory


@pytest.mark.parametrize(
    ("mistake", "message"),
    [
        ("name", r"^Faulty.observe: \['jaw'\]; .*\['yaw'\]"),
        ("shape", r"^Faulty.observe: yaw: \(2,\) .*\(2, 1\)"),
        ("memory", r"^Faulty.observe: memory: \(2, 3\) .*\(3,\)"),
        ("block", r"^senses: \['lidar', 'lidar'\] .*different names"),
    ],
)
def test_mistakes_of_a_sensor_are_named(mistake: str, message: str) -> None:
    env = made("go1gate")
    suite = Suite(
        env.suite.scene,
        (Lidar(rays=1), Faulty(mistake=mistake, pipeline={"all": Pipeline(delay=1)})),
    )

    def read(state: State) -> Any:
        return suite.observe(env.snapshot(state, env.read(state.data)), suite.reset(), state.key)

    with pytest.raises(ValueError, match=message):
        suite.check()
        jax.eval_shape(read, initial(env))


def test_a_sensor_needs_a_name_and_both_decorators() -> None:
    class Bare(Sensor):
        pass

    refuses(r"^sensor: .*Bare.* below @register and @settings_class", register, Bare)
    refuses(r"^sensor Bare: the field name has no default", register, settings_class(Bare))


# -- every engine


@pytest.mark.parametrize("impl", ["jax", pytest.param("warp", marks=pytest.mark.gpu)])
@pytest.mark.parametrize(
    ("task", "count"),
    [("go1sheep-hard", 20)] + [pytest.param(task, 500, marks=pytest.mark.soak) for task in SENSING],
)
def test_engines_agree_on_lidar_and_detections(task: str, count: int, impl: str) -> None:
    """In states in which the C engine agrees with MuJoCo's rays (above)."""
    env = made(task)
    states = scattered(task, count)
    other = make(task, impl=impl, control="position", num_envs=count)
    given = (states.data.qpos, states.data.qvel, states.data.mocap_pos, states.data.ctrl)
    moved = dataclasses.replace(states, data=jax.vmap(other.physics.init)(*given))

    def see(env: Any, states: State) -> np.ndarray:
        sensor = Detections()

        def seen(state):
            return sensor.visible(env.suite.scene, env.snapshot(state, env.read(state.data)))

        return np.asarray(jax.jit(jax.vmap(seen))(states))

    np.testing.assert_allclose(
        readings(other, moved, Lidar()), readings(env, states, Lidar()), atol=1e-4
    )
    seen = see(env, states)
    np.testing.assert_array_equal(see(other, moved), seen)
    assert seen.any() and not seen.all()


# ---------------------------------------------------------------- Drawing


def drawn(
    env: Any, state: State, odometry: tuple[float, float]
) -> tuple[dict[str, Marks], np.ndarray]:
    """What is drawn where odometry is wrong by a way ahead and to the left in each agent's own
    frame, m, and the distances that the lidar measures."""
    own = jnp.asarray(env.snapshot(state, env.read(state.data)).pose)
    cosine = jnp.cos(own[:, 2])
    sine = jnp.sin(own[:, 2])
    ahead, left = odometry
    off = jnp.stack([cosine * ahead - sine * left, sine * ahead + cosine * left], axis=-1)

    def sense(state: State) -> Any:
        return env.suite.observe(
            env.snapshot(state, env.read(state.data)), env.suite.reset(), state.key
        )

    def draw(state: State, senses: Any, blocks: Any) -> Any:
        blocks |= {"odometry": blocks["odometry"].at[:, :2].add(off)}
        return env.suite.draw(env.snapshot(state, env.read(state.data)), senses, blocks)

    blocks, senses = jax.jit(sense)(state)
    marks = jax.device_get(jax.jit(draw)(state, senses, blocks))
    return {mark.label: mark for mark in marks}, np.asarray(blocks["lidar"])[:, :32] / 2


def sighted(env: Any, state: State) -> list[np.ndarray]:
    """Where those are whom each agent sights (S, 2), m."""

    def see(state: State) -> Any:
        snapshot = env.snapshot(state, env.read(state.data))
        return env.params.senses[1].visible(env.suite.scene, snapshot), snapshot.places[:, :2]

    seen, places = jax.device_get(jax.jit(see)(state))
    return [
        places[[row for row in np.flatnonzero(each) if row != agent]]
        for agent, each in enumerate(seen)
    ]


@pytest.mark.soak
def test_marks_show_what_is_sensed_in_the_frame_of_the_scene() -> None:
    """Also of the second team, whose left is its robot's right."""
    senses = (*EXACT[:2], Lidar(pipeline={"all": Pipeline(scale=2.0, history=2)}))
    env = make("go1revolvingdoor", impl="c", control="position", senses=senses)
    yaws = np.array([0.4, -0.3])
    spots = np.array([[1.0, 0.5, 0.3], [1.9, 0.8, 0.3]])
    state = placed(env, spots, np.c_[0 * yaws, 0 * yaws, yaws])
    marks, distances = drawn(env, state, (0.3, 0.1))
    for agent, mirror in enumerate((1, -1)):
        angle = yaws[agent] + mirror * np.arange(32) * 2 * np.pi / 32
        hits = spots[agent, :2] + distances[agent][:, None] * np.c_[np.cos(angle), np.sin(angle)]
        np.testing.assert_allclose(marks["lidar"].points[agent, :, :2], hits, atol=1e-4)
        c = np.cos(yaws[agent])
        s = np.sin(yaws[agent])
        estimate = spots[agent, :2] + [0.3 * c - mirror * 0.1 * s, 0.3 * s + mirror * 0.1 * c]
        np.testing.assert_allclose(marks["odometry"].points[agent, 0, :2], estimate, atol=1e-4)
        np.testing.assert_allclose(marks["odometry"].lines[agent, 0, 0, :2], estimate, atol=1e-4)
    now = marks["seen now"]
    view = marks["in view"].area
    seen = sighted(env, state)
    for agent in range(2):
        ends = now.lines[agent, now.line_opacity[agent] > 0, 1, :2]
        np.testing.assert_allclose(sorted(ends.tolist()), sorted(seen[agent].tolist()), atol=1e-5)
    assert [len(each) for each in seen] == [2, 1]
    assert not marks["seen before"].line_opacity.any()
    distance = np.linalg.norm(view[:, 1:, :2] - view[:, :1, :2], axis=-1)
    assert distance.max() <= 6.0 + 1e-4 and distance.min() < 1.0  # walls end it
    np.testing.assert_allclose(view[:, 0], spots, atol=1e-5)


# ---------------------------------------------------------------- Messages


def test_teammates_in_range_receive_messages_one_step_later() -> None:
    """What is said moves nobody; a new episode starts in silence."""
    senses = [Messages(numbers=2, range=3.0)]
    options: Any = {"impl": "c", "control": "position", "num_envs": 2}
    quiet = make("go1gate", **options)
    env = make("go1gate", **options, senses=senses)
    assert env.action_size == 14 and env.action_space.shape == (2, 14)
    batch = VectorEnv(env, 2).with_groups(["onboard"])
    plain = VectorEnv(quiet, 2)
    state = jax.jit(batch.reset)(jax.random.PRNGKey(0))
    other = jax.jit(plain.reset)(jax.random.PRNGKey(0))
    assert not np.any(state.groups["onboard"])
    said = jnp.linspace(-1.0, 1.0, 2 * 2 * 14).reshape(2, 2, 14)
    step = jax.jit(batch.step)
    late = jnp.array([env.max_steps - 1, 0])
    state = step(state, said)
    other = jax.jit(plain.step)(other, said[..., :12])
    np.testing.assert_array_equal(state.data.qpos, other.data.qpos)
    heard = state.groups["onboard"]
    np.testing.assert_array_equal(
        heard, np.c_[said[:, ::-1, 12:].reshape(4, 2), np.ones(4)].reshape(2, 2, 3)
    )
    heard = step(dataclasses.replace(state, step=late), said).groups["onboard"]
    assert not np.any(heard[0]) and np.all(heard[1, :, 2] == 1)
    refuses(r"action: shape .*expected \(2, 2, 14\)", batch.step, state, said[..., :12])


def test_messages_get_lost_and_do_not_reach_far() -> None:
    env = made("go1gate")
    sensor = Messages(numbers=12, range=1.5, loss=0.3)
    near = placed(env, [[1.0, 0, 0.3], [1.0 + 1.4, 0, 0.3]])
    far = placed(env, [[1.0, 0, 0.3], [1.0 + 1.6, 0, 0.3]])

    def hear(state: State) -> jax.Array:
        snapshot = env.snapshot(state, env.read(state.data))
        memory = sensor.init_memory(env.suite.scene)
        _, memory = sensor.observe(env.suite.scene, snapshot, memory, state.key)
        keys = jax.random.split(jax.random.PRNGKey(0), 400)

        def listen(key):
            return sensor.observe(env.suite.scene, snapshot, memory, key)[0]["messages"]

        return jax.vmap(listen)(keys)[..., -1]

    hear = jax.jit(hear)
    assert not np.any(hear(far)) and np.mean(hear(near)) == pytest.approx(0.7, abs=0.06)


def test_teams_of_different_sizes_are_padded() -> None:
    scene = dataclasses.replace(made("go1gate").suite.scene, teams=((0, 1, 2), (3,)))
    mates, there = scene.mates
    np.testing.assert_array_equal(mates, [[1, 2], [0, 2], [0, 1], [3, 3]])
    np.testing.assert_array_equal(there, [[True] * 2] * 3 + [[False] * 2])


def test_scripted_robots_are_silent() -> None:
    env = make("go1gate", impl="c", senses=["messages"])
    policy = load_policy("scripted", env)
    action = jax.eval_shape(
        policy.act, jnp.zeros((3, 2, env.observation_size)), (), jax.random.PRNGKey(0)
    )[0]
    assert action.shape == (3, 2, env.action_size) == (3, 2, 5)


def test_a_group_without_its_sensors_is_named() -> None:
    refuses(
        r"group: 'onboard' .*the task parameter senses adds onboard",
        VectorEnv(made("go1gate"), 2).with_groups,
        ["onboard"],
    )


@pytest.mark.gpu
@pytest.mark.parametrize("task", ["go1gate", "go1revolvingdoor"])
def test_depth_agrees_with_mujocos_renderer(task: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """But for pixels at edges; the second batch is of another size.

    At the door the second team's image is mirrored.

    The points that are drawn are where rays from the camera end.
    """
    if (backend := render.gl_backend()) is None:
        pytest.skip("no GL library")
    monkeypatch.setattr(
        "mujoco.rendering.classic.gl_context.GLContext", render._gl_context(backend)
    )
    env = make(task, impl="warp", control="position", num_envs=4, senses=["depth"])
    states = scattered(task, 4)
    sensor = Depth()
    given = (states.data.qpos, states.data.qvel, states.data.mocap_pos, states.data.ctrl)
    moved = dataclasses.replace(states, data=jax.vmap(env.physics.init)(*given))
    read = readings(env, moved, sensor).reshape(4, 2, sensor.height, sensor.width)
    few = readings(env, jax.tree.map(lambda x: x[:3], moved), sensor).reshape(3, *read.shape[1:])
    assert np.mean(np.abs(few - read[:3]) > 1e-5) < 1e-3  # a GPU's rounding differs between sizes

    def draw(state, x):
        return sensor.draw(
            env.suite.scene, env.snapshot(state, env.read(state.data)), {"depth": x}, ()
        )

    (drawn,) = jax.device_get(jax.jit(jax.vmap(draw))(moved, read.reshape(4, 2, -1)))
    model = env.compiled.model
    option = mujoco.MjvOption()
    apart = []
    beside = []
    option.geomgroup[:] = 1
    option.sitegroup[:] = 0
    data = mujoco.MjData(model)
    with mujoco.Renderer(model, sensor.height, sensor.width) as renderer:
        renderer.enable_depth_rendering()
        for number in range(4):
            data.qpos = states.data.qpos[number]
            data.mocap_pos = states.data.mocap_pos[number]
            mujoco.mj_forward(model, data)
            for agent in range(2):
                renderer.update_scene(data, f"robot{agent}/depth", option)
                seen = np.minimum(renderer.render() / sensor.range, 1)[
                    :, :: int(env.suite.scene.mirror[agent])
                ]
                apart.append(np.abs(seen - read[number, agent]))
                place = data.cam(f"robot{agent}/depth").xpos
                for point in drawn.points[number, agent][drawn.point_opacity[number, agent] > 0][
                    ::7
                ]:
                    way = point - place
                    length = np.linalg.norm(point - place)
                    struck = mujoco.mj_ray(
                        model, data, place, way / length, None, True, -1, np.zeros(1, np.int32)
                    )
                    beside.append(abs(struck - length))
    assert np.std(read) > 0.1 and np.median(apart) < 1e-3 and np.mean(np.array(apart) > 0.02) < 0.05
    assert len(beside) > 40 and np.median(beside) < 1e-3 and np.mean(np.array(beside) > 0.02) < 0.2
