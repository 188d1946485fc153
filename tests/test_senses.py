"""Sensors on every engine, what is drawn of them, and messages."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mqe_jax.envs import State, VectorEnv, make
from mqe_jax.names import load_policy
from mqe_jax.sensors.depth import Depth
from mqe_jax.sensors.detections import Detections
from mqe_jax.sensors.lidar import Lidar
from mqe_jax.sensors.marks import Marks
from mqe_jax.sensors.messages import Messages
from mqe_jax.sensors.pipeline import Pipeline
from mqe_jax.viz import render
from tests.inputs import refuses
from tests.sensing import EXACT, SENSING, readings, scattered
from tests.states import made, placed


@pytest.mark.parametrize("impl", ["jax", pytest.param("warp", marks=pytest.mark.gpu)])
@pytest.mark.parametrize(
    ("task", "count"),
    [(task, 20) for task in ("go1gate", "go1revolvingdoor", "go1sheep-hard")]
    + [pytest.param(task, 500, marks=pytest.mark.soak) for task in SENSING],
)
def test_engines_agree_on_lidar_and_detections(task: str, count: int, impl: str) -> None:
    """In states in which the C engine agrees with MuJoCo's rays (`test_sensors.py`)."""
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
