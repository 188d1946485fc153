"""The agile skill at run time and in training: inputs, gait, symmetry, commands, shoves, errors over a gait cycle."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax import make
from mqe_jax.core.settings import override
from mqe_jax.physics.robots.go1 import GO1
from mqe_jax.physics.robots.index import Proprioception
from mqe_jax.physics.robots.robot import MIRRORED_JOINTS, MIRRORED_SIGNS
from mqe_jax.skills import agile
from mqe_jax.train.networks import EnvDims
from mqe_jax.walk import trainees
from mqe_jax.walk.env import SHOVED, WalkEnv
from mqe_jax.walk.evaluation import _cycles
from mqe_jax.walk.network import AGILE_FORM, AgileNetwork
from mqe_jax.walk.task import sample_spec
from mqe_jax.walk.training import AGILE_TASK

SKILL = agile.AgileSkill(GO1)
PARAMS = agile.NETWORKS.init(jax.random.PRNGKey(0))
STILL = override(AGILE_TASK, {"randomize": False})


def sensed(seed: int) -> Proprioception:
    random = np.random.default_rng(seed)
    return Proprioception(*(jnp.asarray(random.normal(size=n), jnp.float32) for n in (3, 12, 12)))


def test_the_network_sees_frames_of_five_steps_the_commands_and_the_clock() -> None:
    assert sum(w.size for w in jax.tree.leaves(PARAMS)) <= 155_000
    act, memory, action = jax.jit(SKILL.targets), SKILL.init_memory(), np.zeros(12, np.float32)
    command, frames, gait = jnp.array([1.0, -0.5, 0.4]), [np.zeros(39)] * 8, 0.0
    for step in range(10):
        now = sensed(step)
        parts = (now.gravity_b, now.joint_position - GO1.default_joints, 0.05 * now.joint_velocity, action)
        frames.append(np.concatenate(parts))
        x = np.concatenate(
            [*(frames[-1 - back] for back in (8, 4, 2, 1, 0)), [2.0, -1.0, 0.4],
             [np.sin(2 * np.pi * gait), np.cos(2 * np.pi * gait)]]
        )  # fmt: skip
        action = np.asarray(agile.infer(PARAMS, jnp.asarray(x, jnp.float32)))
        target, memory = act(PARAMS, memory, command, now)
        np.testing.assert_allclose(target, GO1.joint_targets(jnp.asarray(action)), atol=1e-5)
        gait = (gait + 0.02 * float(agile.frequency(command))) % 1.0
        assert float(memory.gait) == pytest.approx(gait, abs=1e-5)


@pytest.mark.parametrize(
    ("velocity", "hertz", "stands"),
    [((0, 0, 0), 3.0, True), ((0.04, 0, 0), 3.0192, True), ((0.1, 0, 0), 3.048, False), ((-2.5, 1, 2), 4.2, False)],
)
def test_the_trot_is_faster_with_the_velocity_and_rests_without_one(velocity: Any, hertz: float, stands: bool) -> None:
    velocity = jnp.array(velocity, jnp.float32)
    assert float(agile.frequency(velocity)) == pytest.approx(hertz, abs=0.01)
    expected = [0.25] * 4 if stands else [0.6, 0.1, 0.1, 0.6]
    np.testing.assert_allclose(agile.foot_phases(jnp.float32(0.1), velocity), expected, atol=1e-6)
    assert bool(np.any(agile.now(jnp.float32(0.1), velocity)[3:])) != stands


def test_a_mirrored_input_is_that_of_the_mirrored_robot() -> None:
    """Half a cycle later: the trot's other feet."""
    trainee, side = trainees.make("agile", GO1), jnp.array([1.0, -1.0, -1.0])

    def inputs(mirror: bool) -> jax.Array:
        rows = []
        for step in range(5):
            now, action = sensed(step), sensed(step + 9).joint_position
            if mirror:
                flip = lambda x: x[MIRRORED_JOINTS] * MIRRORED_SIGNS  # noqa: E731
                gravity = now.gravity_b * jnp.array([1.0, -1.0, 1.0])
                position = flip(now.joint_position - GO1.default_joints) + GO1.default_joints
                now, action = Proprioception(gravity, position, flip(now.joint_velocity)), flip(action)
            rows.append(agile.frame(GO1, now, action))
        velocity = jnp.array([1.0, 0.5, -2.0]) * (side if mirror else 1.0)
        return jnp.concatenate([*rows, agile.now(jnp.float32(0.7 if mirror else 0.2), velocity)])

    np.testing.assert_allclose(AGILE_FORM.reflect(inputs(False)), inputs(True), atol=1e-5)
    flipped = trainee.foot_phases(jnp.float32(0.7), jnp.array([1.0, 0.0, 0.0]))
    straight = trainee.foot_phases(jnp.float32(0.2), jnp.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(flipped, straight[jnp.array([1, 0, 3, 2])], atol=1e-6)


def test_the_trained_network_acts_as_the_skill() -> None:
    env = WalkEnv(GO1, STILL, skill="agile", impl="c", num_envs=1)
    network = AgileNetwork().build(EnvDims(1, env.observation_size, env.privileged_observation_size, 12, 1))
    params = network.init(jax.random.PRNGKey(1))
    state, seen, memory = (
        jax.jit(env.reset)(jax.random.PRNGKey(2)),
        network.initial_memory(1).actor,
        SKILL.init_memory(),
    )

    @jax.jit
    def step(state: Any, seen: Any, memory: Any) -> Any:
        action, _, seen = network.act(network.policy_params(params), seen, state.obs[None], None)
        robot = env.read(state.data)
        now = Proprioception(state.obs[0, :3], robot.joint_position[0], robot.joint_velocity[0])
        target, memory = SKILL.targets(params["policy"], memory, state.task.spec.commands[:3], now)
        return env.step(state, action[0]), seen, memory, GO1.joint_targets(action[0, 0]) - target

    for _ in range(12):
        state, seen, memory, difference = step(state, seen, memory)
        np.testing.assert_allclose(difference, 0.0, atol=1e-5)


@pytest.mark.parametrize(("assistance", "share"), [(1.0, 0.5), (0.0, 1.0)])
def test_commands_fill_the_ranges_that_the_assistance_leaves(assistance: float, share: float) -> None:
    trainee = trainees.make("agile", GO1)
    keys = jax.random.split(jax.random.PRNGKey(0), 4000)
    spec = jax.vmap(lambda key: sample_spec(key, AGILE_TASK, trainee, assistance))(keys)
    velocity = np.asarray(spec.commands[:, :3])
    for i, (low, high) in enumerate(SKILL.trained_ranges(("vx", "vy", "yaw_rate"))):
        assert share * low <= velocity[:, i].min() < 0.95 * share * low
        assert share * high >= velocity[:, i].max() > 0.95 * share * high
    assert np.abs(velocity[:, 0] * velocity[:, 2]).max() <= 3.0 + 1e-4
    assert 0.05 < np.mean(~velocity.any(axis=1)) < 0.15
    assert float(spec.shove[0]) == 100.0 * (1.0 - assistance)


def test_a_shove_acts_at_one_point_of_the_trunk_for_its_time() -> None:
    task = override(STILL, {"shove_period": 0.02, "shove_length": (0.1, 0.1)})  # one after the other
    env = WalkEnv(GO1, task, skill="agile", impl="c", num_envs=1)
    state, shoves, orientations = jax.jit(env.reset)(jax.random.PRNGKey(0)), [], []
    step = jax.jit(env.step)
    for _ in range(20):
        orientations.append(np.asarray(state.data.qpos[3:7]))
        state = step(state, jnp.zeros((1, 12)))
        shoves.append(np.asarray(state.task.shove))
    starts = [i for i in range(20) if i == 0 or (shoves[i] != shoves[i - 1]).any()]
    assert starts == [0, 5, 10, 15]
    for i in starts:
        force, torque = shoves[i][:3], shoves[i][3:]
        assert 0.0 < np.linalg.norm(force[:2]) <= 100.0 and abs(force @ torque) < 1e-3
        assert np.linalg.norm(torque) <= np.linalg.norm(SHOVED) * np.linalg.norm(force)


def test_errors_are_means_over_a_gait_cycle_a_second_after_a_change_of_command() -> None:
    steps, hertz = 200, 5.0  # cycles of ten steps
    errors = np.zeros((steps, 1, 3))
    errors[:, 0, 0] = np.where(np.arange(steps) % 10 < 5, 1.0, -1.0)
    errors[:, 0, 1] = 0.3
    errors[:50, 0, 2] = errors[100:150, 0, 2] = errors[180:, 0, 2] = 9.0
    alive = np.arange(steps)[:, None] < 180
    commands = np.zeros((2, 1, 15))
    commands[..., 4] = hertz
    found = _cycles(errors, alive, commands, 100)
    assert found == pytest.approx({"vx": 0.0, "vy": 0.3, "yaw": 0.0}, abs=1e-9)


@pytest.mark.parametrize("robot", ["go1", "go2"])
def test_the_shipped_weights_run_as_commanded(robot: str) -> None:
    ranges = {"vx": (-1.5, 2.0), "vy": (-1.0, 1.0), "yaw_rate": (-2.5, 2.5)}
    params: dict[str, Any] = {"robot": robot, "skill": "agile", "command_ranges": ranges, "num_agents": 1}
    env = make("go1plane", impl="c", num_envs=1, **params)

    def step(state: Any, _: None) -> Any:
        state = env.step(state, jnp.array([[1.0, 0.0, 0.0]]))
        return state, env.read(state.data).position_w[0, :2]

    position = jax.lax.scan(step, jax.jit(env.reset)(jax.random.PRNGKey(0)), None, 151)[1]
    assert float(jnp.linalg.norm(position[150] - position[100])) == pytest.approx(2.0, abs=0.2)  # m in 1 s
