"""Command ranges: from actions to commands, scripted policies under other ranges, NPC robots, refusals."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax import VectorEnv, learn, make
from mqe_jax.core.errors import InputError
from mqe_jax.export.task import TaskFunctions
from mqe_jax.physics.robots.go1 import GO1
from mqe_jax.policies import load_as, load_policy
from mqe_jax.skills import agile
from mqe_jax.skills import make as make_skill
from mqe_jax.skills.control import Commander
from mqe_jax.train.networks import EnvDims
from mqe_jax.train.policy import TrainedPolicy
from mqe_jax.walk_policy import WalkPolicy
from tests.inputs import refuses

WIDE = {"vx": (-1.5, 2.5), "vy": (-1.0, 1.0), "yaw_rate": (-2.5, 2.5)}
NAMES = ("vx", "vy", "yaw_rate")


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("weights") / "agile.safetensors"
    agile.NETWORKS.save(agile.NETWORKS.init(jax.random.PRNGKey(0)), path)
    return str(path)


def controller(skill: str = "walk", commands: tuple[str, ...] = NAMES, **ranges: Any) -> Commander:
    made = make_skill(skill, GO1)
    return Commander(made, commands, made.default_commands(), ranges)


@pytest.mark.parametrize(
    ("skill", "ranges", "action", "commands"),
    [
        ("walk", {}, (0.25, -1.0, 0.5), (0.5, -0.5, 0.25)),
        ("walk", WIDE, (0.5, 1.0, 1.0), (2.5, 1.0, 2.5)),
        ("walk", WIDE, (1.0, 0.5, -0.5), (2.5, 0.5, -1.25)),
        ("walk", WIDE, (-0.25, -1.0, 0.0), (-0.75, -1.0, 0.0)),
        ("walk", {"vx": (0.0, 2.0)}, (-1.0, 1.0, 1.0), (0.0, 0.5, 0.5)),
        ("walk", {"vy": (-0.2, 0.4)}, (0.0, -0.5, 0.5), (0.0, -0.1, 0.25)),
        ("agile", WIDE, (0.5, 0.0, 1.0), (2.5, 0.0, 1.2)),  # |vx x yaw rate| is at most 3
        ("agile", WIDE, (-0.5, 0.0, -1.0), (-1.5, 0.0, -2.0)),
        ("agile", WIDE, (0.1, 0.0, -1.0), (0.5, 0.0, -2.5)),
    ],
)
def test_actions_are_scaled_to_the_range_on_their_side(skill: str, ranges: Any, action: Any, commands: Any) -> None:
    given = controller(skill, **ranges).skill_commands(jnp.array([action]))
    np.testing.assert_allclose(given[0, :3], commands, rtol=1e-6)


@pytest.mark.parametrize("commands", [NAMES, ("body_height", "gait_frequency", "pitch", "roll", "stance_width")])
def test_the_default_ranges_change_nothing(commands: tuple[str, ...]) -> None:
    walk = WalkPolicy(GO1)
    gain, limit = (walk.column(field, commands) for field in ("gain", "limit"))
    action = jax.random.uniform(jax.random.PRNGKey(0), (500, len(commands)), minval=-1.0, maxval=1.0)
    expected = walk.default_commands()[walk.index(commands)] + jnp.clip(gain * action, -limit, limit)
    given = controller(commands=commands).skill_commands(action)[:, walk.index(commands)]
    np.testing.assert_array_equal(given, expected)


def test_a_range_is_of_the_command_not_of_its_change() -> None:
    commands = controller(commands=("gait_frequency",), gait_frequency=(2.0, 5.0)).skill_commands(
        jnp.array([[-1.0], [0.0], [1.0]])
    )
    np.testing.assert_allclose(commands[:, 4], [2.0, 3.0, 5.0])


@pytest.mark.parametrize(
    "parameters",
    [{}, {"command_ranges": {"vx": (-0.5, 1.2)}}, {"commands": ("gait_frequency", "body_height"), "gait": "pace"}],
)
def test_the_ranges_shown_are_those_of_actions(parameters: Any) -> None:
    env = make("go1plane", impl="c", num_envs=1, **parameters)
    names, columns = env.params.commands, env.controller.skill.index(env.params.commands)
    ends = [env.controller.skill_commands(jnp.full((1, len(names)), end))[0, columns] for end in (-1.0, 1.0)]
    shown = env.params.action_ranges()
    assert tuple(shown) == names
    np.testing.assert_allclose(np.stack(ends, axis=-1), list(shown.values()), rtol=1e-5)


@pytest.mark.parametrize("task", ["go1football-1vs1", "go1football-2vs2", "go1revolvingdoor"])
def test_scripted_policies_command_the_same_in_other_ranges(task: str, weights: str) -> None:
    plain = make(task, impl="c", num_envs=1)
    wide = make(task, impl="c", num_envs=1, skill="agile", skill_weights=weights, command_ranges=WIDE)
    obs = 3.0 * jax.random.normal(jax.random.PRNGKey(1), (40, len(plain.teams[0]), plain.observation_size))
    first, second = (
        np.asarray(
            env.controller.skill_commands(
                load_policy("scripted", env).act(obs, (), jax.random.PRNGKey(0))[0].reshape(-1, 3)
            )
        )
        for env in (plain, wide)
    )
    np.testing.assert_allclose(second, first[:, :3], atol=1e-6)
    assert np.abs(first[:, :3]).max(0) == pytest.approx([1.0, 0.5, 0.5])


@pytest.mark.parametrize(("control", "size"), [("command", 3), ("position", 12)])
def test_npc_robots_keep_the_walk_policy(control: str, size: int, weights: str) -> None:
    """The defender's joint targets are those beside agents that walk."""
    parameters: dict[str, Any] = {"impl": "c", "num_envs": 1, "control": control}
    agile_env = make("go1football-defender", skill="agile", skill_weights=weights, command_ranges=WIDE, **parameters)
    targets = []
    for env in (make("go1football-defender", **parameters), agile_env):
        state = jax.jit(env.reset)(jax.random.PRNGKey(0))
        assert env.controller.clock(state.control).shape == (3, 2)
        sensed = env.read(state.data)
        act = jax.jit(env.controller.targets)
        target, control_state, commands = None, state.control, env.npc_commands(state, sensed)
        for _ in range(3):
            target, control_state = act(control_state, jnp.ones((2, size)), sensed.proprioception, commands)
        targets.append(np.asarray(target))
    np.testing.assert_allclose(targets[0][2], targets[1][2], atol=1e-5)
    assert (np.abs(targets[0][:2] - targets[1][:2]).max() > 0.05) == (control == "command")


def test_graphs_of_tasks_need_the_skill_of_npc_robots(weights: str) -> None:
    env = make("go1football-defender", impl="c", num_envs=1, skill="agile", skill_weights=weights)
    refuses("skill: 'agile' is not allowed", TaskFunctions, env)


def test_ranges_beyond_training_warn() -> None:
    with pytest.warns(UserWarning, match=r"'walk' was not trained for vx \[-1.5, 2\] outside \[-1.2, 1.2\]$") as found:
        make("go1gate", impl="c", num_envs=1, command_ranges={"vx": (-1.5, 2), "vy": (-0.6, 0.6)})
    assert found[0].filename == __file__


@pytest.mark.parametrize("field", ["policy", "opponent"])
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"command_ranges": {"vx": (-1.0, 1.2)}}, r"command_ranges .*'vx': \(-1.0, 1.0\).* has .*'vx': \(-1.0, 1.2\)"),
        ({"commands": ("yaw_rate", "vy", "vx")}, r"commands \('vx', 'vy', .* has \('yaw_rate', 'vy', 'vx'\)"),
        ({"robot": "go2"}, "robot 'go1'; .* has 'go2'"),
        ({"control": "position"}, "control 'command'; .* has 'position'"),
        ({"skill": "agile"}, "skill 'walk'; .* has 'agile'"),
        ({"gait": "pace"}, "gait 'trot'; .* has 'pace'"),
        ({"needs.task": "go1tug"}, "task 'go1tug'; .* has 'go1football-1vs1'"),
        ({"needs.version": 7}, "version 7; .* has 1"),
        ({"needs.group": "camera"}, "group 'camera'; .* has 'policy, proprioception'"),
        ({"needs.layout": "base 19 = 19"}, "layout 'base 19 = 19'; .* has 'one_hot 1 "),
        ({"needs.dims": EnvDims(2, 19, 108, 3, 1)}, "agents 2; .* has 1"),
        ({"needs.dims": EnvDims(1, 18, 108, 3, 1)}, "observation 18; .* has 19"),
    ],
)
def test_policies_that_need_something_else_are_refused(
    field: str, changes: dict[str, Any], said: str, weights: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each by name with both values, whether the policy is an object, a name or a file."""
    monkeypatch.setattr(TrainedPolicy, "__post_init__", lambda self: None)  # which checks the shapes of weights
    own = {name.removeprefix("needs."): value for name, value in changes.items() if name.startswith("needs.")}
    others = {name: value for name, value in changes.items() if not name.startswith("needs.")}
    if "skill" in others:
        others["skill_weights"] = weights
    env = make("go1football-1vs1", impl="c", num_envs=1, **others)
    policy = load_policy("go1football-1vs1")
    policy = dataclasses.replace(policy, needs=dataclasses.replace(policy.needs, **own))
    for source in (policy, *([] if own else ["go1football-1vs1"])):
        refuses(rf"{field}: .* needs {said}", load_as, field, source, env)


def test_a_policy_that_learns_in_a_batch_knows_its_parameters() -> None:
    batch = VectorEnv(make("go1plane", impl="c", num_envs=2, control="position", position_scale=2.0), 2)
    small = {"total_steps": 16, "rollout_steps": 8, "ppo.minibatches": 1}
    policy = learn(batch, small).policy
    assert policy.config.env == {"control": "position", "position_scale": 2.0}
    load_as("policy", policy, batch.env)
    with pytest.raises(InputError, match=r"policy: .* needs position_scale 2.0; the environment has 1.0"):
        load_as("policy", policy, make("go1plane", impl="c", num_envs=1, control="position"))
