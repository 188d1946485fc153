"""Teams of unlike robots: each has its own body, motors and skill; like robots are as before."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mqe_jax
from mqe_jax.core.errors import InputError
from mqe_jax.envs import make
from mqe_jax.physics import robots
from mqe_jax.physics.robots.fleet import Fleet
from mqe_jax.physics.robots.go1 import GO1
from mqe_jax.physics.robots.go2 import GO2
from tests.inputs import refuses

KEY = jax.random.PRNGKey(0)
BIPED = str(Path(__file__).parents[1] / "examples" / "robots" / "biped.xml")
SMALL: dict[str, Any] = {
    "num_envs": 4,
    "rollout_steps": 8,
    "total_steps": 96,
    "ppo.minibatches": 1,
    "ppo.epochs": 1,
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


def test_engines_agree_on_unlike_robots() -> None:
    states = []
    for impl in ("c", "jax"):
        env = make("go1gate", impl=impl, control="torque", contacts="minimal",
                   robots=("go1", "go2"), spawn_joint_scale=(1.0, 1.0))  # fmt: skip
        states.append(stepped(env, 1).data)
    np.testing.assert_allclose(states[0].qpos, states[1].qpos, atol=2e-4)


def test_a_name_for_each_of_like_robots_is_the_robot_to_the_last_bit() -> None:
    runs = []
    for given in ({"robot": "go1"}, {"robots": ("go1", "go1")}):
        runs.append(mqe_jax.learn("go1gate", SMALL, env=given, impl="c"))
    one, two = (run.policy for run in runs)
    assert one.actor.digest == two.actor.digest
    assert one.needs == two.needs and one.needs.robot == "go1"


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


def test_a_team_of_unlike_robots_is_trained_and_evaluated(tmp_path: Path) -> None:
    unlike = {"robots": ["go1", "go2"]}
    run = mqe_jax.learn("go1gate", SMALL, env=unlike, impl="c", run_dir=tmp_path / "run")
    assert run.policy.needs.robot == "go1, go2"
    result = mqe_jax.evaluate(tmp_path / "run", episodes=2, impl="c", env={"episode_length": 0.5})
    assert result.episodes == 2
    with pytest.raises(InputError, match="needs robot 'go1, go2'; the environment has 'go2, go1'"):
        mqe_jax.load_policy(tmp_path / "run", make("go1gate", impl="c", robots=("go2", "go1")))


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
