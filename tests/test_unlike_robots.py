"""Teams of unlike robots: each has its own body, motors and skill; like robots are as before."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mqe_jax
from mqe_jax import cli
from mqe_jax.envs import VectorEnv, make
from mqe_jax.export.policy import input_shapes
from mqe_jax.export.scene import scene_settings, scene_xml
from mqe_jax.export.task import TaskFunctions
from mqe_jax.physics import robots
from mqe_jax.physics.robots.fleet import Fleet
from mqe_jax.physics.robots.go1 import GO1
from mqe_jax.physics.robots.go2 import GO2
from mqe_jax.skills import agile
from mqe_jax.train.config import TrainConfig
from tests.inputs import refuses
from tests.training import export_error, untrained

KEY = jax.random.PRNGKey(0)
BIPED = str(Path(__file__).parents[1] / "examples" / "robots" / "biped.xml")
SMALL: dict[str, Any] = {
    "num_envs": 4,
    "rollout_steps": 8,
    "total_steps": 96,
    "ppo.minibatches": 1,
    "ppo.epochs": 1,
    "network": {"recurrent": False, "hidden_sizes": [8]},
}


def stepped(env: Any, steps: int = 2) -> Any:
    """The state after some steps with random actions."""
    state = jax.jit(env.reset)(KEY)
    step = jax.jit(env.step)
    shape = (env.num_agents, env.action_size)
    for number in range(steps):
        action = jax.random.uniform(jax.random.PRNGKey(number), shape, minval=-1.0)
        state = step(state, action)
    return state


def test_each_robot_has_its_own_mass_motors_and_gains() -> None:
    env = make("go1gate", impl="c", robots=("go1", "go2"))
    model = env.compiled.model
    for number, robot in enumerate((GO1, GO2)):
        rows = env.index.actuator[number]
        mass = model.body_mass[env.index.bodies[number]].sum()
        assert mass == pytest.approx(sum(body.link.mass for body in robot.tree))
        np.testing.assert_allclose(model.actuator_gainprm[rows, 0], robot.kp)
        np.testing.assert_allclose(model.actuator_biasprm[rows, 2], -robot.kd)
        motors = env.compiled.motors
        np.testing.assert_allclose(motors.speed[rows], robot.joint_speed_limit)
        np.testing.assert_allclose(motors.torque[rows], robot.torque_limit)
        np.testing.assert_allclose(env.robots.table("joint_lower")[number], robot.joint_lower)
    one, two = env.controller.groups
    assert (one.skill.robot, one.robots, two.skill.robot, two.robots) == (GO1, (0,), GO2, (1,))
    width = env.controller.skill.index(["stance_width"])
    assert two.shift[width] == pytest.approx(GO2.walk.stance_width - GO1.walk.stance_width)


@pytest.mark.soak
def test_engines_agree_on_unlike_robots() -> None:
    states = []
    for impl in ("c", "jax"):
        env = make("go1gate", impl=impl, control="torque", contacts="minimal",
                   robots=("go1", "go2"), spawn_joint_scale=(1.0, 1.0))  # fmt: skip
        states.append(stepped(env, 1).data)
    np.testing.assert_allclose(states[0].qpos, states[1].qpos, atol=2e-4)


def test_a_name_for_each_of_like_robots_is_the_robot_to_the_last_bit() -> None:
    one = make("go1gate", impl="c")
    two = make("go1gate", impl="c", robots=("go1", "go1"))
    jax.tree.map(np.testing.assert_array_equal, stepped(one), stepped(two))
    needs = [untrained(VectorEnv(env, 2), TrainConfig()).needs for env in (one, two)]
    assert needs[0] == needs[1] and needs[0].robot == "go1"


def test_robots_see_which_bodies_they_and_others_have() -> None:
    env = make("go1football-2vs2", impl="c", robots=("go1", "go2"))
    assert [robot.name for robot in env.robots] == ["go1", "go1", "go2", "go2"]
    seen = env.layouts["policy"].split(jax.jit(env.reset)(KEY).obs)["bodies"]
    np.testing.assert_array_equal(seen[0], [1, 0, 1, 0, 0, 1, 0, 1])
    np.testing.assert_array_equal(seen[3], [0, 1, 0, 1, 1, 0, 1, 0])
    assert "bodies" not in make("go1football-2vs2", impl="c").layouts["policy"].names
    guarded = make("go1football-defender", impl="c", robots=("go1", "go1", "go2"))
    assert guarded.controller.groups[1].robots == (2,)
    assert guarded.layouts["policy"].blocks[-1].width == 6


@pytest.mark.soak
def test_a_team_of_unlike_robots_is_trained_and_evaluated(tmp_path: Path) -> None:
    unlike = {"robots": ["go1", "go2"]}
    run = mqe_jax.learn("go1gate", SMALL, env=unlike, impl="c", run_dir=tmp_path / "run")
    assert run.policy.needs.robot == "go1, go2"
    result = mqe_jax.evaluate(tmp_path / "run", episodes=2, impl="c", env={"episode_length": 0.5})
    assert result.episodes == 2
    with pytest.warns(UserWarning, match="on the robot go1, go2, it acts on go2, go1"):
        mqe_jax.load_policy(tmp_path / "run", make("go1gate", impl="c", robots=("go2", "go1")))


@pytest.mark.soak
def test_both_sides_of_a_match_of_unlike_robots_are_evaluated() -> None:
    match = make("go1tug", impl="c", robots=("go1", "go2"), episode_length=0.5)
    result = mqe_jax.evaluate(match, "scripted", "forward", episodes=4, sides="both")
    assert result.episodes == 4
    assert match.layouts["policy"].slice("bodies").stop == match.observation_size


def test_wrong_robots_are_named_in_a_line() -> None:
    for given, said in {
        ("go1",) * 3: r"robots: \('go1', 'go1', 'go1'\) is not allowed; it must be 2 names, one",
        ("go1", "go3"): r"unknown name 'go3'",
        "go1": r"robots: 'go1' is not allowed; it must be a list",
        ("go1", 2): r"robots.1: 2 is not allowed",
    }.items():
        refuses(said, make, "go1gate", impl="c", robots=given)
    refuses(
        r"robot: 'go2' is not allowed; it must be left out beside robots",
        make, "go1gate", impl="c", robot="go2", robots=("go1", "go2"),
    )  # fmt: skip
    refuses(
        r"needs four legs of three joints; biped",
        make, "go1gate", impl="c", robots=("go1", BIPED),
    )  # fmt: skip


def test_parameters_follow_the_largest_robot_and_return() -> None:
    unlike = make("go1gate", impl="c", control="position", robots=("go1", BIPED))
    alone = make("go1gate", impl="c", control="position", robot=BIPED)
    usual = make("go1gate", impl="c").params
    assert unlike.params.gate_width == usual.gate_width > alone.params.gate_width
    assert unlike.params.spawn_height == alone.params.spawn_height > usual.spawn_height
    assert unlike.changed({"robot": "go1"}).params == make("go1gate", control="position").params
    assert unlike.digests["robot"] == robots.get(BIPED).digest
    heights = unlike.by_height(unlike.params.spawn_height)
    np.testing.assert_allclose(heights, [usual.spawn_height, alone.params.spawn_height], atol=2e-3)


@pytest.fixture(scope="module")
def uneven() -> Any:
    """A Go1 and a robot of two legs with nine joints."""
    return make("go1gate", impl="c", num_envs=8, control="position", robots=("go1", BIPED),
                senses=["proprioception"], spawn_velocity=0.0)  # fmt: skip


def test_robots_of_other_joint_counts_act_together(uneven: Any, tmp_path: Path) -> None:
    assert (uneven.action_size, uneven.num_agents) == (12, 2)
    np.testing.assert_array_equal(uneven.used.sum(axis=1), [12, 9])
    state = stepped(uneven, 3)
    assert bool(jnp.all(jnp.isfinite(state.obs))) and bool(jnp.all(jnp.isfinite(state.reward)))
    found = uneven.read(state.data)
    np.testing.assert_array_equal(found.joint_position[1, 9:], 0.0)
    assert not jnp.any(found.joint_position[1, :9] == 0.0)
    step = jax.jit(uneven.step)
    one, other = (step(state, jnp.zeros((2, 12)).at[1, 9:].set(x)) for x in (0.0, 1.0))
    np.testing.assert_array_equal(one.data.qpos, other.data.qpos)
    np.testing.assert_array_equal(one.groups["policy"], other.groups["policy"])
    xml = mujoco.MjModel.from_xml_string(scene_xml(uneven))
    assert xml.nu == 21 and uneven.mj_model.nbody == uneven.compiled.model.nbody
    runs = scene_settings(uneven)["motors"]["runs"]
    assert [(first, last, len(of)) for first, last, of in runs] == [(0, 12, 3), (12, 21, 9)]
    clip = mqe_jax.render(uneven, "idle", seconds=0.1, width=160)
    clip.save(tmp_path / "two.png")
    assert (tmp_path / "two.png").stat().st_size > 1000


@pytest.mark.soak
def test_entries_of_joints_that_a_robot_lacks_teach_nothing(uneven: Any) -> None:
    own = {**SMALL["network"], "share_policy": False, "log_std_init": 0.0}
    config = {**SMALL, "num_envs": 8, "network": own, "ppo.entropy_coef": 0.1}
    policy = mqe_jax.learn(uneven, config).policy
    moved = np.asarray(policy.params["log_std"]) != 0.0  # where it begins
    np.testing.assert_array_equal(moved, uneven.used)
    weights = np.asarray(policy.params["actor"]["head"]["bias"])
    np.testing.assert_array_equal(weights != 0.0, uneven.used)


def test_a_policy_of_unlike_robots_is_exported(uneven: Any) -> None:
    walkers = make("go1gate", impl="c", robots=("go2", "go1"))
    for env in (uneven, walkers):
        policy = untrained(VectorEnv(env, 2), TrainConfig())
        assert export_error(policy, env) < 1e-4
    shapes = input_shapes(policy, walkers)
    assert shapes["walk_0_action"] == shapes["walk_1_action"] == (1, 12)
    refuses("robots: go2, go1 are not allowed; graphs of tasks", TaskFunctions, walkers)


def test_agents_of_pettingzoo_have_the_actions_of_their_robots(uneven: Any) -> None:
    pettingzoo = pytest.importorskip("mqe_jax.adapters.pettingzoo")
    env = pettingzoo.parallel_env(uneven)
    shapes = [env.action_space(agent).shape for agent in env.possible_agents]
    assert shapes == [(12,), (9,)]
    env.reset(seed=0)
    env.step({agent: env.action_space(agent).sample() for agent in env.agents})
    wrong = {agent: np.zeros(12) for agent in env.agents}
    refuses(r"actions.robot_1: .* it must be 9 numbers", env.step, wrong)


def test_each_kind_has_its_own_weights_of_the_skill(tmp_path: Path) -> None:
    file = str(tmp_path / "own.safetensors")
    agile.NETWORKS.save(agile.NETWORKS.init(KEY), file)
    given = {"skill": "agile", "robots": ("go1", "go2"), "impl": "c"}
    env = make("go1gate", skill_weights=(None, file), **given)
    shipped, own = env.controller.groups
    usual = agile.AgileSkill(GO1).load_params()["body"]["0"]["weight"]
    np.testing.assert_array_equal(shipped.params["body"]["0"]["weight"], usual)
    assert not np.array_equal(own.params["body"]["0"]["weight"], usual)
    assert env.digests["skill_weights"].startswith("shipped ")
    for files in (file, (file,), (None, None, file)):
        refuses(r"skill_weights: .* is not allowed", make, "go1gate", skill_weights=files, **given)


def test_the_card_of_a_task_shows_each_kind(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["tasks", "go1gate", "--robots", "go1", "go2", "--impl", "c"]) == 0
    shown = capsys.readouterr().out
    for text in ("Unitree Go1", "Unitree Go2", "bodies (4)", "one-hot of go1, go2"):
        assert text in shown, text


def test_tables_of_unlike_robots_end_with_zeros() -> None:
    biped: Any = robots.get(BIPED)
    fleet = Fleet((GO1, biped))
    assert fleet.num_joints == 12 and fleet.identity == f"go1, {biped.identity}"
    np.testing.assert_array_equal(fleet.has_joint.sum(axis=1), [12, 9])
    targets = fleet.joint_targets(jnp.ones((2, 12)))
    np.testing.assert_allclose(targets[0], GO1.default_joints + GO1.action_scale, rtol=1e-6)
    np.testing.assert_array_equal(targets[1, 9:], 0.0)
    values = jnp.arange(24.0).reshape(2, 12)
    reflected = fleet.reflect(values)
    np.testing.assert_allclose(reflected[0], GO1.mirror.reflect(values[0]))
    np.testing.assert_allclose(reflected[1, :9], biped.mirror.reflect(values[1, :9]))
